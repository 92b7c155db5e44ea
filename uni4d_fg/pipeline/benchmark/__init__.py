"""Experiments over whole datasets: independent runs with results on disk, scores by named protocols, tables."""
