"""Places seen again: found by their looks, verified by geometry, closed by relative poses.

places: features of some frames, and which earlier frames look like a later one;
links: the relative pose of two frames from matched features with depth;
closing: what is searched for when, which links are believed, and the factors of bundle adjustment.
"""
