"""Long 2D point tracks: the built-in tracker, files of tracks, and static/dynamic labels."""
