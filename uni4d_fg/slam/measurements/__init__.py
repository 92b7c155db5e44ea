"""Measurements of other sensors as factors that join the stages: one source per kind."""
