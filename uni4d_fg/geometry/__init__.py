"""Rigid transforms, the pinhole camera and trajectory alignment."""
