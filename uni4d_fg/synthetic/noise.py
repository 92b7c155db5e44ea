"""What networks and sensors do to exact cues: noise on tracks, depth, masks and the focal length."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import model_validator

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.config.base import Section, setting
from uni4d_fg.synthetic.tracks import ExactTracks
from uni4d_fg.tracks.model import Tracks

# One independent stream per cue: switching the noise of one off leaves the others as they were.
_TRACK_STREAM, _DEPTH_STREAM, _MASK_STREAM = 1, 2, 3
# Nodes across a map: the depth error varies over a third of the image, holes are smaller blobs.
_FIELD_NODES, _HOLE_NODES = 4, 9


class CueNoise(Section):
    """Noise of the cues; every field at zero leaves the cues exact."""

    track_sigma_px: float = setting(0.5, "Standard deviation of each track coordinate, px.", ge=0, le=20)
    outlier_fraction: float = setting(0.02, "Part of the visible observations that are displaced.", ge=0, le=1)
    outlier_min_px: float = setting(4.0, "Smallest displacement of an outlier, px.", ge=0, le=100)
    outlier_max_px: float = setting(20.0, "Largest displacement of an outlier, px.", ge=0, le=200)
    visibility_drop_fraction: float = setting(0.05, "Part of the visible observations that are lost.", ge=0, le=1)
    false_visibility_fraction: float = setting(
        0.002, "Part of the hidden observations inside the image that are reported as visible.", ge=0, le=1
    )
    depth_flicker: float = setting(0.04, "Standard deviation of each frame's depth log-scale.", ge=0, le=1)
    depth_field: float = setting(
        0.02, "Standard deviation of a smooth relative depth error, independent per frame.", ge=0, le=0.5
    )
    depth_pixel: float = setting(0.01, "Standard deviation of each pixel's relative depth error.", ge=0, le=0.5)
    hole_fraction: float = setting(0.01, "Part of each depth map that is missing, in blobs.", ge=0, lt=1)
    mask_error_px: int = setting(
        2,
        "Each instance's mask is grown, shrunk and shifted by up to this, anew in each frame, px.",
        ge=0,
        le=50,
    )
    focal_error: float = setting(
        0.05, "Relative error of the sequence's focal lengths: 0.05 gives them 5 % too long.", gt=-0.9, le=1
    )

    @model_validator(mode="after")
    def _outlier_range_is_ordered(self) -> CueNoise:
        if self.outlier_min_px > self.outlier_max_px:
            raise ValueError(f"outlier_min_px {self.outlier_min_px:g} exceeds {self.outlier_max_px:g}")
        return self

    @classmethod
    def none(cls) -> CueNoise:
        """Return exact cues."""
        return cls(
            track_sigma_px=0.0,
            outlier_fraction=0.0,
            visibility_drop_fraction=0.0,
            false_visibility_fraction=0.0,
            depth_flicker=0.0,
            depth_field=0.0,
            depth_pixel=0.0,
            hole_fraction=0.0,
            mask_error_px=0,
            focal_error=0.0,
        )


def noisy_tracks(exact: ExactTracks, noise: CueNoise, image_size: tuple[int, int], seed: int) -> Tracks:
    """Observe exact tracks.

    The observation in a track's query frame gets noise but is neither displaced nor lost. Whatever noise
    pushes out of the image is not visible.

    Args:
        exact: K tracks over T frames.
        noise: Its amounts.
        image_size: (height, width), px.
        seed: Seed of the random choices.
    """
    rng = np.random.default_rng([seed, _TRACK_STREAM])
    height, width = image_size
    shape = exact.visible.shape
    # Every draw is made, whatever the amounts, so that the same seed hits the same observations.
    jitter = rng.standard_normal((*shape, 2))
    outlier, dropped, false_positive = (rng.random(shape) for _ in range(3))
    magnitude = noise.outlier_min_px + (noise.outlier_max_px - noise.outlier_min_px) * rng.random(shape)
    direction = 2.0 * np.pi * rng.random(shape)

    later = np.arange(shape[1]) != exact.query_frame[:, None]
    hidden = ~exact.visible & _inside(exact.uv, height, width)
    visible = exact.visible & ~(later & (dropped < noise.visibility_drop_fraction))
    visible |= hidden & (false_positive < noise.false_visibility_fraction)
    displacement = magnitude[..., None] * np.stack((np.cos(direction), np.sin(direction)), axis=-1)
    displaced = later & (outlier < noise.outlier_fraction)
    noisy = exact.uv + noise.track_sigma_px * jitter + np.where(displaced[..., None], displacement, 0.0)
    uv: Float32Array = noisy.astype(np.float32)
    visible &= _inside(uv, height, width)
    uv[~visible] = np.nan
    return Tracks(uv, visible, exact.query_frame.copy())


def _inside(uv: FloatArray | Float32Array, height: int, width: int) -> BoolArray:
    """Return whether pixels (..., 2) lie between the centres of the outermost pixels; NaN does not."""
    u, v = uv[..., 0], uv[..., 1]
    return np.asarray((u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1))


def _smooth_field(rng: np.random.Generator, height: int, width: int, nodes: int) -> FloatArray:
    """Return (H, W) low-frequency noise of zero mean and unit deviation."""
    coarse = rng.standard_normal((nodes, nodes + 1))
    field = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float64)
    spread = float(field.std())
    result: FloatArray = (field - field.mean()) / (spread if spread > 0 else 1.0)
    return result


def noisy_depths(depths: Float32Array, noise: CueNoise, seed: int) -> tuple[Float32Array, FloatArray]:
    """Degrade exact depth maps: a log-scale per frame, a smooth field, noise per pixel, and holes.

    Args:
        depths: (T, H, W) exact z-depth, metres, NaN where missing.
        noise: Its amounts.
        seed: Seed of the random choices.

    Returns:
        (T, H, W) float32 depth cue, metres, NaN where missing, and (T,) the frames' true log-scales: the
        cue of frame t times ``exp(log_scale[t])`` is the true depth, up to field and pixel noise.
    """
    rng = np.random.default_rng([seed, _DEPTH_STREAM])
    num_frames, height, width = depths.shape
    flicker = np.asarray(noise.depth_flicker * rng.standard_normal(num_frames))
    cue = np.empty_like(depths)
    for t in range(num_frames):
        log_error = flicker[t] + noise.depth_field * _smooth_field(rng, height, width, _FIELD_NODES)
        log_error = log_error + noise.depth_pixel * rng.standard_normal((height, width), dtype=np.float32)
        cue[t] = depths[t] * np.exp(log_error)
        blobs = _smooth_field(rng, height, width, _HOLE_NODES)
        if noise.hole_fraction > 0:
            cue[t][blobs > np.quantile(blobs, 1.0 - noise.hole_fraction)] = np.nan
    return cue, -flicker


def noisy_masks(masks: Int32Array, noise: CueNoise, seed: int) -> Int32Array:
    """Let masks leak: grow or shrink each instance and shift it, by up to ``mask_error_px``, per frame.

    Args:
        masks: (T, H, W) exact instance ids.
        noise: Its amounts.
        seed: Seed of the random choices.

    Returns:
        (T, H, W) int32 instance ids. What an instance leaves uncovered becomes 0; where two overlap, the
        greater id wins.
    """
    rng = np.random.default_rng([seed, _MASK_STREAM])
    if noise.mask_error_px == 0:
        return masks.copy()
    limit = noise.mask_error_px
    height, width = masks.shape[1:]
    instances = [int(i) for i in np.unique(masks) if i > 0]
    leaking = np.zeros_like(masks)
    for t in range(len(masks)):
        for instance in instances:
            growth, shift_x, shift_y = (int(n) for n in rng.integers(-limit, limit + 1, size=3))
            mask = (masks[t] == instance).astype(np.uint8)
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(growth) + 1,) * 2)
            mask = (cv2.dilate if growth > 0 else cv2.erode)(mask, kernel)
            shift = np.array([[1.0, 0.0, shift_x], [0.0, 1.0, shift_y]])
            mask = cv2.warpAffine(
                mask, shift, (width, height), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
            )
            leaking[t][mask > 0] = instance
    return leaking
