"""What networks and sensors do to exact cues: noise on tracks, depth, masks and the focal length."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.config.cue_noise import CueNoise
from uni4d_fg.frontend.synthetic.tracks import ExactTracks
from uni4d_fg.frontend.track_model import Tracks

# One independent stream per cue: switching the noise of one off leaves the others as they were.
_TRACK_STREAM, _DEPTH_STREAM, _MASK_STREAM = 1, 2, 3
# Nodes across a map: the depth error varies over a third of the image, holes are smaller blobs.
_FIELD_NODES, _HOLE_NODES = 4, 9


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
    """Return whether pixels (..., 2) lie between the centers of the outermost pixels; NaN does not."""
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
        depths: (T, H, W) exact z-depth, meters, NaN where missing.
        noise: Its amounts.
        seed: Seed of the random choices.

    Returns:
        (T, H, W) float32 depth cue, meters, NaN where missing, and (T,) the frames' true log-scales: the
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
