"""Depth cues as networks make them: wrong by scale, shift and a smooth field, and bleeding across edges."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence


def hardened_depth(
    sequence: Sequence, seed: int, shift: float = 0.04, field: float = 0.06, patch: int = 14
) -> FloatArray:
    """The true depth (T, H, W) as a network would give it: shifted in disparity, with a smooth error, of patches."""
    rng = np.random.default_rng(seed)
    height, width = sequence.image_size
    out = []
    for depth in sequence.ground_truth.depths or ():
        small = cv2.resize(np.asarray(depth), (width // patch, height // patch), interpolation=cv2.INTER_AREA)
        disparity = 1 / cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
        smooth = cv2.resize(rng.normal(0, field, (6, 6)), (width, height), interpolation=cv2.INTER_CUBIC)
        out.append(np.exp(smooth) / (disparity + rng.normal(0, shift) * np.median(disparity)))
    return np.stack(out)


def with_broken(sequence: Sequence, depth: FloatArray, broken: tuple[int, ...]) -> Sequence:
    """The sequence with a cue (T, H, W) that is constant in some frames, whose masks reach too far."""
    depth, masks = depth.copy(), np.stack(list(sequence.masks))
    for frame in broken:
        depth[frame] = np.median(depth[frame])
        masks[frame] = cv2.dilate(masks[frame].astype(np.uint8), np.ones((9, 9), np.uint8))
    return dataclasses.replace(sequence, depths=ArrayFrames(depth.astype(np.float32)), masks=ArrayFrames(masks))
