"""Cuts of an edited video: hard ones and dissolves."""
