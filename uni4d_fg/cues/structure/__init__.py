"""Up-to-scale structure from motion: cameras and static points from tracks alone."""
