"""Batch reconstruction in overlapping windows that are joined by the cameras they share."""
