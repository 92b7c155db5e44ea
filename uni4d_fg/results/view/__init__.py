"""An interactive view of a finished run in a browser."""
