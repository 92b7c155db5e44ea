"""The configuration that depth and intrinsics from camera motion ask for."""

from __future__ import annotations

import math

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.slam.stages import bundle_adjustment

OPEN_FOCAL_SIGMA = 0.03
"""Standard deviation of the log focal length beyond which camera motion leaves it open."""


def settings_for_depth(config: Config, sequence: Sequence) -> Config:
    """Return the configuration with which to reconstruct from a depth cue.

    Stages measure the noise of depth from motion like that of any other. But moving things have depth only where they
    stand, and the noise of the static scene says nothing of that (``geometric_depth.moving_depth_sigma`` does, unless
    ``nonrigid.depth_sigma`` is set). Without parallax, depth is a convention that would bend the focal lengths: they
    are kept, and no lens is sought. So are those that the motion leaves open.

    Args:
        config: Of the run.
        sequence: Its fields ``depth_parallax`` and ``focal_sigma`` say where depth and intrinsics are from.
    """
    update: dict[str, object] = {}
    if sequence.depth_parallax is not None and config.nonrigid.depth_sigma is None:
        sigma = config.geometric_depth.moving_depth_sigma
        update["nonrigid"] = config.nonrigid.model_copy(update={"depth_sigma": sigma})
    if sequence.depth_parallax is False or (sequence.focal_sigma or 0.0) > OPEN_FOCAL_SIGMA:
        update["input"] = config.input.model_copy(update={"intrinsics": "fixed"})
    return config.model_copy(update=update)


def settings_behind_lens(config: Config, sequence: Sequence, *, depth_is_needed: bool) -> Config:
    """Return the configuration of stages 1 to 3, once lens and zoom are known.

    Intrinsics of cameras from motion are kept, as a stage that takes all tracks for independent would go to the focal
    length that their common errors ask for. And depth from motion is no cue for the cameras: what
    is interpolated between points that were found with them knows nothing that the tracks do not know, and is wrong
    behind every edge. Nor is it judged as a cue that was given, and a cue that the scale hangs on is not given up.

    Args:
        config: Of the run, as :func:`settings_for_depth` returns it.
        sequence: Its fields ``depth_parallax`` and ``focal_sigma`` say where depth and intrinsics are from.
        depth_is_needed: Whether what the run does relies on a depth prior for the scale of the world.
    """
    if sequence.focal_sigma is not None:
        config = settings_of_motion(config)
    if sequence.depth_parallax and not (config.geometric_depth.depth_prior or depth_is_needed):
        config = without_depth_prior(config)
    return settings_of_judgment(config, sequence, depth_is_needed=depth_is_needed)


def settings_of_judgment(config: Config, sequence: Sequence, *, depth_is_needed: bool) -> Config:
    """Return the configuration with which no depth cue is judged that was not given, or cannot be given up."""
    if sequence.depth_parallax is None and not depth_is_needed:
        return config
    stage_1 = config.camera_init.model_copy(update={"max_depth_spread": None})
    return config.model_copy(update={"camera_init": stage_1})


def settings_of_motion(config: Config) -> Config:
    """Return the configuration of stage 2 for cameras that structure from motion found.

    Their intrinsics are held, and fewer tracks may depart from most others than beside a depth cue.
    """
    trim = {"trim_sigmas": config.geometric_depth.stage_trim_sigmas}
    return config.model_copy(
        update={
            "input": config.input.model_copy(update={"intrinsics": "fixed"}),
            "bundle_adjustment": config.bundle_adjustment.model_copy(update=trim),
        }
    )


def without_depth_prior(config: Config) -> Config:
    """Return the configuration with which the depth cue says nothing of the cameras."""
    stage = bundle_adjustment.without_depth_prior(config.bundle_adjustment)
    return config.model_copy(update={"bundle_adjustment": stage})


def without_rolling_shutter(config: Config) -> Config:
    """Return the configuration with which all rows are taken to be read at once, as those of tracks that were moved."""
    return config.model_copy(update={"camera": config.camera.model_copy(update={"rolling_shutter": "off"})})


def with_smaller_angles(config: Config, focal_px: float) -> Config:
    """Return the configuration with which points take part in finding cameras whose rays meet at less of an angle.

    Args:
        config: Its field ``geometric_depth.min_angle_px`` says at which.
        focal_px: Focal length, px.
    """
    settings = config.geometric_depth
    angle = min(settings.min_angle_deg, math.degrees(settings.min_angle_px / focal_px))
    return config.model_copy(update={"geometric_depth": settings.model_copy(update={"min_angle_deg": angle})})
