"""Tracks that are fragments of one static point: found by geometry, verified by appearance.

candidates: pairs of landmarks that may be one point, by their positions and uncertainty;
appearance: patches of both, compared under the solved geometry;
fragments: pairs that no other contends, joined to groups.
"""
