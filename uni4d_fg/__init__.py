"""Factor-graph reconstruction of moving scenes: camera poses, intrinsics, static geometry and 3D motion.

The way through: :mod:`uni4d_fg.sequence` (what comes in), :mod:`uni4d_fg.tracks`, :mod:`uni4d_fg.stages`
(camera initialisation, bundle adjustment, non-rigid points), :mod:`uni4d_fg.fusion`,
:mod:`uni4d_fg.reconstruction` (what comes out), :mod:`uni4d_fg.evaluate`. :mod:`uni4d_fg.pipeline` runs it.
"""
