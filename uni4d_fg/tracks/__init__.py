"""Long 2D point tracks: their model, the built-in tracker, and static/dynamic labels."""
