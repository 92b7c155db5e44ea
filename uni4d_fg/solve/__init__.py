"""Levenberg-Marquardt and its linear solvers. Nothing here knows of cameras, stages or files."""
