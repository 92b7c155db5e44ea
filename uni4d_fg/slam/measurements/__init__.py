"""Measurements of other sensors as factors of the stages."""
