"""Casual videos of made-up worlds with their truth: street, car, table, rooms, park, drone, stairs, market.

    python -m benchmarks.worlds OUT [--only NAME ...] [--frames N] [--check]

Triangle meshes are met by rays (Open3D, Embree) at several times within the exposure of each frame, shaded with sun or
lamps, cast shadows and partly mirroring panes, given noise, encoded as H.264, and stored beside cameras, depth and
masks of the middle of each exposure.
"""
