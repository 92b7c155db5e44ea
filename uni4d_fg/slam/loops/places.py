r"""Which frames look alike: SIFT features, and one vector per frame that sums them.

The vocabulary is made of the video's own features. A frame's vector is the sum, per word, of the differences between
the word and the features nearest to it (VLAD, Jegou et al. 2010), its square roots taken and normalized; features are
compared by their square roots too (RootSIFT, Arandjelovic and Zisserman 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.loops import LoopsConfig
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.geometry.camera import project, unproject
from uni4d_fg.geometry.lens import Lens

_SAMPLED_FEATURES = 6000
_ITERATIONS = 10
_SAMPLES = 8
"""Points per side of the grid that tells what a frame has in view."""


@dataclass(frozen=True)
class Place:
    """Features of the static part of one frame."""

    frame: int
    uv: FloatArray
    """(n, 2) ideal pixels."""
    point: FloatArray
    """(n, 3) in the camera's axes, m; NaN without depth."""
    descriptor: npt.NDArray[np.uint8]
    """(n, 128) SIFT."""

    def roots(self) -> Float32Array:
        """Return the square roots of the descriptors (n, 128), of unit length."""
        values = self.descriptor.astype(np.float32)
        return np.asarray(np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)), dtype=np.float32)


def describe(
    sequence: Sequence, frame: int, intrinsics: FloatArray, lens: Lens, log_scale: float, config: LoopsConfig
) -> Place:
    """Return the features of a frame where its mask says static.

    Args:
        sequence: Images, depth and masks.
        frame: Which.
        intrinsics: (4,) px.
        lens: Of the images.
        log_scale: Logarithm of what the frame's depth is scaled by.
        config: Number of features.
    """
    gray = cv2.cvtColor(np.ascontiguousarray(sequence.images[frame]), cv2.COLOR_RGB2GRAY)
    static: BoolArray = np.asarray(sequence.masks[frame] == 0)
    if sequence.content is not None:
        inside = np.zeros_like(static)
        inside[sequence.content.slices] = True
        static &= inside
    detector = cv2.SIFT_create(nfeatures=config.features)  # type: ignore[attr-defined]
    points, descriptor = detector.detectAndCompute(gray, static.astype(np.uint8))
    if descriptor is None:
        return Place(frame, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 128), np.uint8))
    uv = np.array([point.pt for point in points], dtype=np.float64)
    z = depth_at(sequence.depths[frame], uv) * np.exp(log_scale)
    ideal = lens.ideal_pixels(intrinsics, uv)
    return Place(frame, ideal, np.asarray(unproject(intrinsics, ideal, z)), descriptor.astype(np.uint8))


def depth_at(depth: Float32Array, uv: FloatArray) -> FloatArray:
    """Return the depth (n,) at the pixels nearest to (n, 2)."""
    height, width = depth.shape
    column = np.clip(np.rint(uv[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(uv[:, 1]).astype(int), 0, height - 1)
    return np.asarray(depth[row, column], dtype=np.float64)


def lost_from_sight(
    sequence: Sequence,
    frames: IntArray,
    world_T_cam: FloatArray,
    intrinsics: FloatArray,
    log_scale: FloatArray,
    config: LoopsConfig,
) -> BoolArray:
    """Return which pairs (P, P) of frames, the earlier one first, have one between them that sees nothing of it.

    Args:
        sequence: Its depth is read.
        frames: (P,) compared frames, ascending.
        world_T_cam: (T, 4, 4) as solved so far.
        intrinsics: (4,) px.
        log_scale: (T,).
        config: What out of sight means.
    """
    height, width = sequence.image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, _SAMPLES + 2)[1:-1], np.linspace(0, height - 1, _SAMPLES + 2)[1:-1])
    uv = np.stack((u.ravel(), v.ravel()), axis=-1)
    lost = np.zeros((len(frames), len(frames)), dtype=bool)
    for row, frame in enumerate(frames.tolist()):
        z = depth_at(sequence.depths[frame], uv) * np.exp(log_scale[frame])
        known = np.isfinite(z)
        if not known.any():
            continue
        x = np.asarray(unproject(intrinsics, uv[known], z[known]))
        later = np.linalg.inv(world_T_cam[frames[row:]]) @ world_T_cam[frame]
        seen = x @ np.swapaxes(later[:, :3, :3], 1, 2) + later[:, None, :3, 3]
        pixel = np.asarray(project(intrinsics, seen))
        inside = (seen[..., 2] > 0) & (pixel >= 0).all(-1) & (pixel[..., 0] < width) & (pixel[..., 1] < height)
        away = inside.mean(axis=1) < config.out_of_sight
        # A frame is away from itself when an earlier one between was; the frame compared is not asked.
        lost[row, row + 1 :] = np.logical_or.accumulate(away)[:-1]
    return lost


def alike(places: list[Place], words: int) -> FloatArray:
    """Return how alike all pairs (P, P) of frames look, at most 1."""
    roots = [place.roots() for place in places]
    stacked = np.concatenate(roots)
    if len(stacked) < words:
        return np.zeros((len(places), len(places)))
    vocabulary = _vocabulary(stacked, words)
    vectors = np.stack([_vector(root, vocabulary) for root in roots])
    return np.asarray(vectors @ vectors.T, dtype=np.float64)


def _vocabulary(features: Float32Array, words: int) -> Float32Array:
    """Return the centers (words, D) of features (n, D) by k-means."""
    rng = np.random.default_rng(0)
    sample = features[rng.permutation(len(features))[:_SAMPLED_FEATURES]]
    centers = sample[:words].copy()
    for _ in range(_ITERATIONS):
        nearest = _nearest(sample, centers)
        for word in range(words):
            mine = sample[nearest == word]
            if len(mine):
                centers[word] = mine.mean(axis=0)
    return centers


def _nearest(features: Float32Array, centers: Float32Array) -> IntArray:
    return np.asarray(np.argmin((centers**2).sum(axis=1) - 2.0 * features @ centers.T, axis=1))


def _vector(features: Float32Array, vocabulary: Float32Array) -> Float32Array:
    out = np.zeros_like(vocabulary)
    if len(features):
        nearest = _nearest(features, vocabulary)
        np.add.at(out, nearest, features - vocabulary[nearest])
    signed = np.sign(out) * np.sqrt(np.abs(out))
    return np.asarray(signed.ravel() / max(float(np.linalg.norm(signed)), 1e-12), dtype=np.float32)
