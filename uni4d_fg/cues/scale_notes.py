"""What users are told where lengths are not in meters."""

NOT_METRIC = (
    "depth is not metric: no depth was given, so it was found from the motion of the camera, which leaves the scale "
    "unknown; all lengths are in a unit of its own"
)
NOT_METRIC_GIVEN = (
    "depth is not metric, as a note beside it says (depth_cue.json); all lengths are in a unit of its own"
)
NOT_METRIC_RELATIVE = (
    "depth is not metric: the depth network gives relative depth, which was scaled to the motion of the camera; all "
    "lengths are in a unit of its own"
)
