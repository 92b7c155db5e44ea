"""What the image holds of tracks in place, and which of those that contradict a static scene are believed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.track_certainty import believed, position_variance, share_of_moving
from uni4d_fg.cues.track_motion import TrackMotion, find_moving_tracks
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.slam.stages.scene import Cameras

SIZE = (240, 320)


def tracks_at(uv: np.ndarray, frames: int = 1) -> Tracks:
    """Tracks (K, 2), or (K, T, 2), seen in all frames."""
    uv = np.repeat(uv[:, None], frames, axis=1) if uv.ndim == 2 else uv
    return Tracks(uv.astype(np.float32), np.ones(uv.shape[:2], bool), np.zeros(len(uv), np.int32))


def edges() -> np.ndarray:
    """A horizontal and a diagonal edge, a corner, and nothing."""
    image = np.full((*SIZE, 3), 60, np.uint8)
    image[60:, :100] = 160
    cv2.fillPoly(image, [np.array([[160, 240], [320, 80], [320, 240]])], (160, 160, 160))
    return image


def test_positions_are_certain_across_edges_only() -> None:
    at = np.array([[40, 60], [240, 160], [100, 60], [200, 30]])
    variance = position_variance(ArrayFrames(np.repeat(edges()[None], 3, axis=0)), tracks_at(at, 3))
    (along, none, across), (xx, xy, yy), corner, flat = variance.astype(np.float64)
    assert across < 0.1
    assert along > 50 * across
    assert abs(none) < 0.01 * along
    # Across the diagonal, (1, 1) / sqrt(2), as certain as across the horizontal one; along it as uncertain as there.
    np.testing.assert_allclose([(xx + 2 * xy + yy) / 2, (xx - 2 * xy + yy) / 2], [across, along], rtol=0.3)
    assert max(corner[0], corner[2]) < 0.3
    np.testing.assert_allclose(flat, [along, 0, along], rtol=0.05, atol=1e-6)


def test_positions_are_in_pixels_of_the_images_whatever_the_size_they_are_looked_at() -> None:
    large = cv2.resize(edges(), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    at = np.array([[40, 60], [100, 60]])
    small = position_variance(ArrayFrames(edges()[None]), tracks_at(at))
    found = position_variance(ArrayFrames(large[None]), tracks_at(4 * at + 1.5))
    half = cv2.resize(edges(), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    np.testing.assert_allclose(
        found / 4, position_variance(ArrayFrames(half[None]), tracks_at(2 * at + 0.5)), rtol=0.1, atol=1e-3
    )
    assert (found[:, 2] > small[:, 2]).all()


def test_a_track_that_slides_along_an_edge_does_not_move() -> None:
    frames, intrinsics = 8, np.array([300.0, 300.0, 159.5, 119.5])
    rng = np.random.default_rng(0)
    rest = rng.uniform((10, 10), (310, 230), (200, 2))
    uv = np.repeat(np.concatenate([rest, [[40, 60], [40, 60]]])[:, None], frames, axis=1)
    uv[-2, :, 0] += 1.5 * np.arange(frames)  # along the edge
    uv[-1, :, 1] += 1.5 * np.arange(frames)  # across it
    tracks = tracks_at(uv)
    count = len(uv)
    zero = np.zeros(count, np.int32)
    labelled = LabelledTracks(tracks, zero, zero, np.ones((count, frames), np.float32), np.full((count, frames), 2.0))
    variance = np.zeros((count, 3), np.float32)
    variance[-2:] = position_variance(ArrayFrames(edges()[None]), tracks_at(uv[-2:, :1]))
    cameras = Cameras(np.tile(np.eye(4), (frames, 1, 1)), intrinsics, np.zeros(frames))
    none = np.zeros(count, bool)
    spread = np.zeros((count, frames), np.float32)
    given = (labelled, spread, cameras, SIZE, MotionMaskConfig(), none)
    sure = find_moving_tracks(*given)
    assert sure.moving.tolist()[-2:] == [True, True]
    found = find_moving_tracks(*given, position_variance=variance)
    assert found.moving.tolist()[-2:] == [False, True]
    assert found.static[-2]
    assert not found.moving[:-2].any()


@pytest.mark.parametrize(("noise_px", "least", "most"), [(0.1, 0.9, 1.0), (0.7, 0.0, 0.1)])
def test_what_moves_by_little_is_told_where_tracks_are_that_exact(noise_px: float, least: float, most: float) -> None:
    """A camera on a tripod, and somebody who walks away: 3 px within 20 frames."""
    frames, resting, intrinsics = 24, 300, np.array([300.0, 300.0, 159.5, 119.5])
    rng = np.random.default_rng(0)
    uv = np.repeat(rng.uniform((10, 10), (310, 230), (resting + 30, 2))[:, None], frames, axis=1)
    uv[resting:, :, 1] += 0.15 * np.arange(frames)
    tracks = tracks_at(uv + rng.normal(0, noise_px, uv.shape))
    count, still = len(uv), np.zeros(frames)
    zero, seen = np.zeros(count, np.int32), np.ones((count, frames), np.float32)
    labelled = LabelledTracks(tracks, zero, zero, seen, 2 * seen)
    cameras = Cameras(np.tile(np.eye(4), (frames, 1, 1)), intrinsics, still)
    found = find_moving_tracks(labelled, 0 * seen, cameras, SIZE, MotionMaskConfig(), np.zeros(count, bool))
    assert least <= found.moving[resting:].mean() <= most
    assert found.moving[:resting].mean() < 0.02
    assert found.static[:resting].mean() > 0.9


def test_tracks_that_contradict_are_believed_where_they_depart_or_those_around_do() -> None:
    column, row = np.meshgrid(np.arange(4, 320, 8), np.arange(4, 240, 8))
    at = np.stack([column, row], axis=-1).reshape(-1, 2)
    pond = at[:, 0] > 200  # everything there ripples by less than depth and the image can tell
    thread = np.abs(at[:, 0] - 100) < 4  # slides along a depth edge
    leaf = np.hypot(*(at - (60, 60)).T) < 4  # departs, alone
    known = pond | thread | leaf
    departure = np.where(leaf, 6.0, 1.0)
    motion = TrackMotion(leaf, ~leaf, departure)
    tracks = tracks_at(at, 4)
    share = share_of_moving(tracks, known, ~known, SIZE)
    assert share[at[:, 0] > 220].min() > 0.95
    assert share[thread].max() < 0.6
    found = believed(known, motion, tracks, SIZE, MotionMaskConfig())
    assert found[at[:, 0] > 220].all()
    assert not found[thread].any()
    assert found[leaf].all()
    assert not found[~known].any()
