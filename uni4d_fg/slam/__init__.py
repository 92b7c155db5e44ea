"""From labeled tracks to cameras, landmarks and moving points, in one batch, in windows or frame by frame.

The exact energy, by which results of different solvers are compared, and the reconstruction as plain data are here too.
"""
