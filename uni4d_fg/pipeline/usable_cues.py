"""What given depth and masks must hold for cameras to be found from them: said before hours of other work."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array
from uni4d_fg.config.cues import InputConfig
from uni4d_fg.cues.plan import CuePlan
from uni4d_fg.frontend.sequence.frame_checks import outside_limits, usable_depth
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem

_ALL_GIVEN = CuePlan()


def check_given_cues(video: Video | Sequence, config: InputConfig, plan: CuePlan = _ALL_GIVEN) -> None:
    """Check that some frame has depth, some has static pixels, and that what is to be kept is there.

    As a rule only the first frame is decoded.

    Args:
        video: With the cues that it brings.
        config: Limits of depth, and whether cameras are to be found at all.
        plan: Which of the cues are used as they are given.

    Raises:
        InputError: If no frame has any; if intrinsics are to be kept and none are given; or if a frame cannot be read.
    """
    if config.intrinsics == "fixed" and plan.depth != "card" and _lacks_intrinsics(video):
        raise SequenceProblem(
            video.root or video.name,
            "brings no intrinsics, and input.intrinsics is 'fixed'",
            "add K.npy, give --intrinsics FILE, or leave input.intrinsics 'free'",
        )
    if config.poses == "fixed":
        return  # cameras that are given need neither
    if plan.depth == "given":
        _check_depth(video, config)
    if plan.masks == "given":
        _check_masks(video)


def _lacks_intrinsics(video: Video | Sequence) -> bool:
    if isinstance(video, Video):
        return video.intrinsics is None
    # Without parallax those of depth from motion are kept, guessed or not.
    return video.intrinsics_are_guessed and video.depth_parallax is None


def _check_depth(video: Video | Sequence, config: InputConfig) -> None:
    if video.depths is None:
        return
    medians: list[float] = []
    for frame in range(video.num_frames):
        depth: Float32Array = video.depths[frame]
        known = depth[np.isfinite(depth) & (depth > 0.0)]
        if usable_depth(known, config).any():
            return
        if known.size:
            medians.append(float(np.median(known)))
    where = f"the depth of {video.name}"
    if not medians:
        raise SequenceProblem(
            where, "is missing everywhere: no frame has a positive, finite value", "check how it was exported"
        )
    unit = "m" if video.depth_is_metric else "units"
    raise SequenceProblem(where, *outside_limits(float(np.median(medians)), config, unit, "in every frame"))


def _check_masks(video: Video | Sequence) -> None:
    if video.masks is None:
        return
    for frame in range(video.num_frames):
        static: BoolArray = video.masks[frame] == 0
        if static.any():
            return
    raise SequenceProblem(
        f"the masks of {video.name}",
        "mark every pixel of every frame as moving, and the camera cannot be found from moving things",
        "mark what is static with 0",
    )
