"""Measurements of other sensors that came with a video."""
