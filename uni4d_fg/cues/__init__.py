"""Cues that a video did not bring: depth, tracks, masks and intrinsics, made frame by frame."""
