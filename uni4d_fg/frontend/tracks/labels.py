"""What each track belongs to: the static world, one moving instance, or nothing that can be trusted.

Only observations that are visible and away from every object border vote (see
:mod:`uni4d_fg.frontend.tracks.mask_certainty`). A track takes the label on which its votes agree, up to
``max_off_label_fraction`` of them; a track without a single vote is rejected.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, Int32Array
from uni4d_fg.config.cues import InputConfig, LabelConfig
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel, Tracks
from uni4d_fg.frontend.tracks.depth_sampling import sample_depth
from uni4d_fg.frontend.tracks.mask_certainty import UNCERTAIN, certain_labels
from uni4d_fg.optim.threads import map_in_order, thread_count

_TOGETHER = 8
"""Frames that are held at a time."""
_STATIC_ID = 0
_NOT_SEEN = -2


def label_tracks(tracks: Tracks, sequence: Sequence, config: LabelConfig, input_config: InputConfig) -> LabelledTracks:
    """Label tracks from the masks and sample the depth cue at their observations.

    Each frame's mask and depth are read once.

    Args:
        tracks: K tracks over the T frames of the sequence.
        sequence: Masks and depth.
        config: Widths of the uncertain band and voting rules.
        input_config: Range of depth that counts as present.

    Returns:
        The labelled tracks. Observations outside the image are no longer visible in them. An observation
        weighs 1 if it is sure and agrees with the label of its track, ``band_weight`` inside the band, and
        0 if it is not visible, disagrees, or belongs to a rejected track.

    Raises:
        InputError: If tracks, masks or depth disagree with the sequence in length or size.
    """
    num_frames = sequence.num_frames
    for name, count in (
        ("tracks", tracks.num_frames),
        ("masks", len(sequence.masks)),
        ("depths", len(sequence.depths)),
    ):
        if count != num_frames:
            raise InputError(f"labels: {name} cover {count} frames, the sequence has {num_frames}")
    tracks = _inside_image(tracks, sequence.image_size)
    shape = tracks.visible.shape
    found = np.full(shape, _NOT_SEEN, np.int32)
    depth = np.full(shape, np.nan, np.float32)
    threads = thread_count()
    for first in range(0, num_frames, _TOGETHER):
        # Frames side by side in memory: going through all tracks once for each frame takes several times as long.
        frames = slice(first, min(first + _TOGETHER, num_frames))
        visible, uv = tracks.visible[:, frames].T.copy(), tracks.uv[:, frames].swapaxes(0, 1).copy()
        pictures = [_read(sequence, frame) for frame in range(frames.start, frames.stop)]
        seen = [np.flatnonzero(row) for row in visible]
        looks = [
            partial(_look, *picture, at[rows], config, input_config)
            for picture, at, rows in zip(pictures, uv, seen, strict=True)
        ]
        for offset, (labels, depths) in enumerate(map_in_order(lambda look: look(), looks, threads)):
            found[seen[offset], first + offset] = labels
            depth[seen[offset], first + offset] = depths

    mask_id, votes, agreeing = _majority(found)
    agreed = (votes > 0) & (votes - agreeing <= config.max_off_label_fraction * votes)
    long_enough = agreeing >= static_frames_needed(num_frames, config)
    label = np.full(len(votes), TrackLabel.REJECTED, np.int32)
    label[agreed & (mask_id > _STATIC_ID)] = TrackLabel.DYNAMIC
    label[agreed & (mask_id == _STATIC_ID) & long_enough] = TrackLabel.STATIC
    label[agreed & (mask_id == _STATIC_ID) & ~long_enough] = TrackLabel.SHORT_STATIC
    instance = np.where(label == TrackLabel.DYNAMIC, mask_id, 0).astype(np.int32)

    weight = _weights(found, mask_id, agreed, config.band_weight)
    return LabelledTracks(tracks, label, instance, weight, depth)


def _read(sequence: Sequence, frame: int) -> tuple[Int32Array, Float32Array]:
    """Return the mask and the depth (H, W) of a frame, checked."""
    mask, depth = np.asarray(sequence.masks[frame], np.int32), sequence.depths[frame]
    for name, array in (("mask", mask), ("depth", depth)):
        if array.shape != sequence.image_size:
            raise InputError(f"labels: {name} of frame {frame} is {array.shape}, the images are {sequence.image_size}")
    return mask, depth


def _look(
    mask: Int32Array, depth_map: Float32Array, uv: Float32Array, config: LabelConfig, input_config: InputConfig
) -> tuple[Int32Array, Float32Array]:
    """Return the certain label and the depth, each (n,), at points (n, 2) px."""
    certain = certain_labels(mask, config.band_static_px, config.band_dynamic_px)
    column, row = _nearest_pixel(uv, (mask.shape[0], mask.shape[1]))
    depth = sample_depth(depth_map, uv, input_config.min_depth_m, input_config.max_depth_m, config.max_depth_spread)
    return certain[row, column], depth


def static_frames_needed(num_frames: int, config: LabelConfig) -> int:
    """Return in how many frames a static track must be surely seen to carry a camera.

    ``min_static_frames``, or ``min_static_fraction`` of a short video, but two (one track in one frame says
    nothing about motion).
    """
    fraction = math.ceil(config.min_static_fraction * num_frames)
    return max(min(2, num_frames), min(config.min_static_frames, fraction))


def _inside_image(tracks: Tracks, image_size: tuple[int, int]) -> Tracks:
    """Return the tracks with observations that round to no pixel of the image marked not visible."""
    height, width = image_size
    with np.errstate(invalid="ignore"):
        u, v = tracks.uv[..., 0], tracks.uv[..., 1]
        inside = (u >= -0.5) & (v >= -0.5) & (u < width - 0.5) & (v < height - 0.5)
    visible: BoolArray = tracks.visible & inside
    uv = np.where(visible[..., None], tracks.uv, np.float32(np.nan))
    return replace(tracks, uv=uv, visible=visible)


def _nearest_pixel(
    uv: Float32Array, image_size: tuple[int, int]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return column and row (N,) of the pixel nearest to each position inside the image."""
    height, width = image_size
    rounded = np.floor(uv.astype(np.float64) + 0.5).astype(np.int64)
    return np.clip(rounded[:, 0], 0, width - 1), np.clip(rounded[:, 1], 0, height - 1)


def _majority(
    found: Int32Array,
) -> tuple[Int32Array, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return each track's most frequent sure mask id, its sure observations, and those with that id; (K,).

    Args:
        found: (K, T) mask id at each observation, negative where unsure or not seen.
    """
    votes = (found >= 0).sum(axis=1)
    agreeing = (found == _STATIC_ID).sum(axis=1)
    mask_id = np.where(agreeing > 0, _STATIC_ID, UNCERTAIN).astype(np.int32)
    on_an_instance = np.flatnonzero(votes > agreeing)
    elsewhere = found[on_an_instance]
    for candidate in np.unique(elsewhere[elsewhere > _STATIC_ID]):
        count = (elsewhere == candidate).sum(axis=1)
        better = count > agreeing[on_an_instance]
        mask_id[on_an_instance[better]] = candidate
        agreeing[on_an_instance[better]] = count[better]
    return mask_id, votes, agreeing


def _weights(found: Int32Array, mask_id: Int32Array, agreed: BoolArray, band_weight: float) -> Float32Array:
    """Return the weight (K, T) of every observation."""
    weight = np.zeros(found.shape, np.float32)
    weight[found == UNCERTAIN] = band_weight
    weight[(found >= 0) & (found == mask_id[:, None])] = 1.0
    weight[~agreed] = 0.0
    return weight
