"""What comes in: frames, depth, masks, tracks, calibration and ground truth of one video."""
