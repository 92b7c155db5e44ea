r"""Does a pixel look in other frames as a static scene would have it?

Frame j is compared with frame i at the pixel where i's depth and the cameras put each of its points
(:mod:`uni4d_fg.cues.static_scene`). The difference of colors ``e`` in a small window has, for a static point,
the variance of the intensities plus what an error of the predicted pixel makes of the image gradient ``g``,

    s^2 = sigma_I^2 + g^T S g,    S = sigma_u^2 I + (sigma_z du')(sigma_z du')^T,

and for one that has moved also the variance ``c^2`` of the image around it. The evidence is the log of the ratio of
two normal densities with these variances. It vanishes where the image is flat, where depth is unknown and where the
point is hidden in frame j, and it forgives depth that is off along the epipolar line.

What lies in a shadow in frame i and not in frame j has its colors there times one gain ``a <= 1``, which changes less
from pixel to pixel than texture does: with ``a`` fitted to a window, the texture that is left tells a shadow from
another thing. Where there is none, nothing does (plain clothes before a plain wall differ by one gain, too).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.depth_range import DepthRange, depth_range
from uni4d_fg.cues.evidence_numpy import moved_evidence_numpy
from uni4d_fg.cues.guided_filter import sum_colors
from uni4d_fg.cues.static_scene import StaticPrediction
from uni4d_fg.optim.extension import find_extension

_SAMPLE = 4
"""Medians over an image take every fourth pixel in x and y."""
_LIT = 0.97
"""What is at least so bright, as a part of what it was, is not in a shadow."""


@dataclass(frozen=True)
class ComparedFrame:
    """What others are compared with of a frame at working size; arrays (h, w)."""

    color: Float32Array | ImageArray
    """(h, w, 3), slightly blurred, gray levels."""
    nearest: Float32Array
    """Least depth around, in the unit of the cameras; infinite where none is known."""


@dataclass(frozen=True)
class FrameAppearance:
    """One frame at working size, with what its comparisons need; arrays (h, w), intensities in gray levels."""

    color: Float32Array
    """(h, w, 3), slightly blurred."""
    gradient: tuple[Float32Array, Float32Array, Float32Array]
    """Sums over colors of gx gx, gx gy, gy gy."""
    contrast: Float32Array
    """Variance of the colors around, summed over them."""
    depth: DepthRange
    """With the frame's depth scale."""
    z: Float32Array
    """The depth itself."""
    sigma_depth: Float32Array
    """Standard deviation of log depth."""
    variance: Float32Array
    """Of a difference of colors, but for what an error of depth does."""

    @cached_property
    def compared(self) -> ComparedFrame:
        """What others are compared with; many pairs of frames ask for it."""
        return ComparedFrame(self.color, _nearest(self.depth))


def frame_appearance(
    image: ImageArray, depth: Float32Array, log_scale: float, edge_window_px: int, config: MotionMaskConfig
) -> FrameAppearance:
    """Prepare a frame.

    Args:
        image: (h, w, 3) uint8 RGB at working size.
        depth: (h, w) meters, NaN where missing.
        log_scale: Log of the factor that makes the depth agree with the cameras.
        edge_window_px: Side of the window in which depth may be displaced.
        config: Blur and windows.
    """
    color = _blurred(image, config).astype(np.float32)
    gx, gy = (cv2.Sobel(color, -1, 1 - axis, axis, ksize=3) / 8 for axis in (0, 1))
    window = (config.contrast_window_px, config.contrast_window_px)
    variance = cv2.boxFilter(color * color, -1, window) - cv2.boxFilter(color, -1, window) ** 2
    gxx, gyy = sum_colors(gx * gx), sum_colors(gy * gy)
    return FrameAppearance(
        color,
        (gxx, sum_colors(gx * gy), gyy),
        sum_colors(np.maximum(variance, 0)),
        *_depth_arrays(depth, log_scale, edge_window_px, config),
        3 * config.intensity_sigma**2 + config.prediction_sigma_px**2 * (gxx + gyy),
    )


def compared_frame(
    image: ImageArray, depth: Float32Array, log_scale: float, edge_window_px: int, config: MotionMaskConfig
) -> ComparedFrame:
    """Prepare only what others are compared with; the arguments are those of :func:`frame_appearance`."""
    return ComparedFrame(_blurred(image, config), _nearest(_depth_around(depth, log_scale, edge_window_px)))


def _blurred(image: ImageArray, config: MotionMaskConfig) -> ImageArray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), config.blur_px), np.uint8)


def _depth_around(depth: Float32Array, log_scale: float, edge_window_px: int) -> DepthRange:
    return depth_range(depth * np.float32(np.exp(log_scale)), edge_window_px)


def _nearest(around: DepthRange) -> Float32Array:
    return np.where(around.known, np.exp(around.nearest), np.float32(np.inf))


def with_other_depth(
    frame: FrameAppearance, depth: Float32Array, log_scale: float, edge_window_px: int, config: MotionMaskConfig
) -> FrameAppearance:
    """Return a frame with another depth map (h, w); the other arguments are those of :func:`frame_appearance`."""
    around, z, sigma_depth = _depth_arrays(depth, log_scale, edge_window_px, config)
    return replace(frame, depth=around, z=z, sigma_depth=sigma_depth)


def _depth_arrays(
    depth: Float32Array, log_scale: float, edge_window_px: int, config: MotionMaskConfig
) -> tuple[DepthRange, Float32Array, Float32Array]:
    around = _depth_around(depth, log_scale, edge_window_px)
    return around, np.exp(around.log_depth), config.depth_sigma + 0.5 * around.spread


def moved_evidence(
    source: FrameAppearance,
    target: ComparedFrame,
    static: StaticPrediction,
    config: MotionMaskConfig,
    texture: Float32Array | None = None,
) -> Float32Array:
    """Return the log odds (h, w) that a pixel of ``source`` is not where a static scene has it in ``target``.

    Args:
        source: Frame the evidence is for.
        target: Frame it is compared with.
        static: Where a static scene has its pixels (h, w), px at working size.
        config: Sigmas.
        texture: Variance of the colors (h, w) around, where a pixel may also be one of the target's in a shadow; None
            does not look for shadows.
    """
    u, v, du, dv, z = (
        np.ascontiguousarray(part, np.float32) for part in (static.u, static.v, static.du, static.dv, static.z)
    )
    seen = cv2.remap(target.color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    core, _ = find_extension()
    compare = moved_evidence_numpy if core is None else core.moved_evidence
    evidence: Float32Array = compare(
        source.color, seen.astype(np.float32, copy=False), u, v, du, dv, z, source.sigma_depth, *source.gradient,
        source.variance, source.contrast, texture, target.nearest, patch=config.patch_px,
        shadow_window=config.shadow_window_px, deepest_shadow=config.deepest_shadow, lit=_LIT,
        nearer=float(np.exp(-config.occlusion_margin)), limits=config.evidence_limits, step=_SAMPLE,
    )  # fmt: skip
    return evidence
