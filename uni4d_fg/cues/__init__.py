"""Cues that a video did not bring: depth, tracks, masks and intrinsics, made by networks or from motion alone."""
