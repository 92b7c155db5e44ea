"""Looking at a finished run: what of it can be shown, and an interactive view of it in a browser."""
