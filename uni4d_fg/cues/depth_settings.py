"""The configuration that depth from camera motion asks for."""

from __future__ import annotations

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence


def settings_for_depth(config: Config, sequence: Sequence) -> Config:
    """Return the configuration with which to reconstruct from a depth cue.

    Stages 1 and 2 take depth from motion like any other: they measure its noise. But moving things have depth only
    where they stand, and the noise of the static scene says nothing of that (``geometric_depth.moving_depth_sigma``
    does, unless ``nonrigid.depth_sigma`` is set). Without parallax, depth is a convention that would bend the focal
    lengths: they are kept. So are those that the motion leaves open: stage 2 takes the tracks for independent, and
    would go to the focal length that their common errors ask for.

    Args:
        config: Of the run.
        sequence: Its fields ``depth_parallax`` and ``focal_is_open`` say where depth and intrinsics are from.
    """
    update: dict[str, object] = {}
    if sequence.depth_parallax is not None and config.nonrigid.depth_sigma is None:
        sigma = config.geometric_depth.moving_depth_sigma
        update["nonrigid"] = config.nonrigid.model_copy(update={"depth_sigma": sigma})
    if sequence.depth_parallax is False or sequence.focal_is_open:
        update["input"] = config.input.model_copy(update={"intrinsics": "fixed"})
    return config.model_copy(update=update)
