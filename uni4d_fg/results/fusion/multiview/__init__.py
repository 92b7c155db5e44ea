"""Depth of the static scene from several views, with the solved cameras."""
