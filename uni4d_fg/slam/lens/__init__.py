"""The lens of a video: found with the cameras, and applied to tracks."""
