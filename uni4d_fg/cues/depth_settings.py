"""The configuration that depth from camera motion asks for."""

from __future__ import annotations

from uni4d_fg.config.models import Config


def settings_for_depth(config: Config, parallax: bool | None) -> Config:
    """Return the configuration with which to reconstruct from a depth cue.

    Stages 1 and 2 take depth from motion like any other: they measure its noise. But moving things have depth only
    where they stand, and the noise of the static scene says nothing of that (``geometric_depth.moving_depth_sigma``
    does, unless ``nonrigid.depth_sigma`` is set). Without parallax, depth is a convention that would bend the focal
    lengths: they are kept.

    Args:
        config: Of the run.
        parallax: See :attr:`~uni4d_fg.frontend.sequence.model.Sequence.depth_parallax`.
    """
    if parallax is None:
        return config
    update: dict[str, object] = {}
    if config.nonrigid.depth_sigma is None:
        sigma = config.geometric_depth.moving_depth_sigma
        update["nonrigid"] = config.nonrigid.model_copy(update={"depth_sigma": sigma})
    if not parallax:
        update["input"] = config.input.model_copy(update={"intrinsics": "fixed"})
    return config.model_copy(update=update)
