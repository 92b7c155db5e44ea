"""Rigid transforms, the pinhole camera and the alignment of trajectories; arrays in, arrays out."""
