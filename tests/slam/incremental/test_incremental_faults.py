"""Frames repeated, out of order, dropped, without depth, without tracks, all masked: reported and recovered from."""

from __future__ import annotations

import numpy as np
import pytest
from stream_samples import (
    aligned_error,
    ate,
    feed,
    no_tracks,
    path_length,
    stream,
    stream_config,
    tracks_of,
    true_poses,
)

from uni4d_fg.slam.incremental import FrameStatus, FrameTracks

FRAMES = 36


def test_repeated_and_late_frames_change_nothing() -> None:
    sequence = stream(FRAMES)
    order = [*range(10), 9, 5, *range(10, 14)]
    solver, updates = feed(sequence, frames=order)
    assert updates[10].status is FrameStatus.REPEATED
    assert updates[11].status is FrameStatus.OUT_OF_ORDER
    assert updates[10].frame == updates[11].frame == 9
    np.testing.assert_array_equal(updates[11].world_T_cam, updates[9].world_T_cam)
    undisturbed, _ = feed(sequence, frames=list(range(14)))
    result = solver.finish()
    np.testing.assert_array_equal(result.world_T_cam, undisturbed.finish().world_T_cam)
    np.testing.assert_array_equal(result.timestamps, sequence.timestamps[:14])


@pytest.mark.parametrize("gap", [1, 4])
def test_dropped_frames_are_bridged_by_their_tracks(gap: int) -> None:
    sequence = stream(FRAMES)
    kept = [t for t in range(FRAMES) if not 12 <= t < 12 + gap]
    solver, updates = feed(sequence, frames=kept)
    assert all(update.status is not FrameStatus.BRIDGED for update in updates)
    truth = true_poses(sequence)
    assert ate(solver.finish().world_T_cam, truth[kept]) < 0.015 * path_length(truth)


@pytest.mark.parametrize("missing", [range(10, 16), range(12, FRAMES)])
def test_frames_without_depth_do_no_harm(missing: range) -> None:
    sequence = stream(FRAMES)
    nothing = np.full(sequence.image_size, np.nan, dtype=np.float32)
    solver, updates = feed(sequence, depth=lambda t: nothing if t in missing else sequence.depths[t])
    assert all(update.status is not FrameStatus.BRIDGED for update in updates)
    truth = true_poses(sequence)
    result = solver.finish()
    assert result.pose_covariance is not None
    assert np.isfinite(result.world_T_cam).all()
    assert np.isfinite(result.pose_covariance).all()
    assert ate(result.world_T_cam, truth) < 0.015 * path_length(truth)


def test_a_stream_that_begins_without_depth_begins_where_depth_does() -> None:
    sequence = stream(FRAMES)
    nothing = np.full(sequence.image_size, np.nan, dtype=np.float32)
    solver, updates = feed(sequence, frames=list(range(20)), depth=lambda t: nothing if t < 3 else sequence.depths[t])
    assert all(update.status is FrameStatus.BRIDGED for update in updates[1:4])
    assert all(update.status is not FrameStatus.BRIDGED for update in updates[4:])
    truth = true_poses(sequence)[3:20]
    assert ate(solver.finish().world_T_cam[3:], truth) < 0.03 * path_length(truth)


def renumbered(tracks: FrameTracks) -> FrameTracks:
    return FrameTracks(tracks.track + 100_000, tracks.uv)


@pytest.mark.parametrize("found_again", [True, False])
def test_all_tracks_lost_for_ten_frames(found_again: bool) -> None:
    """Poses are bridged with a growing covariance that covers the error; afterwards motion is right again."""
    sequence = stream(FRAMES)
    first, last = 14, 23

    def tracks(t: int) -> FrameTracks:
        if first <= t <= last:
            return no_tracks()
        seen = tracks_of(sequence, t)
        return seen if t < first or found_again else renumbered(seen)

    solver, updates = feed(sequence, stream_config("incremental.window=16"), tracks=tracks)
    assert all(updates[t].status is FrameStatus.BRIDGED for t in range(first, last + 1))
    assert all(updates[t].status is not FrameStatus.BRIDGED for t in range(last + 3, FRAMES))
    spread = [np.sqrt(np.trace(updates[t].covariance[3:, 3:])) for t in range(first, last + 1)]
    assert (np.diff(spread) > 0).all()
    assert spread[-1] > 3.0 * spread[0]
    result, truth = solver.finish(), true_poses(sequence)
    before, after = slice(0, first), slice(last + 3, FRAMES)
    assert ate(result.world_T_cam[before], truth[before]) < 0.02
    assert ate(result.world_T_cam[after], truth[after]) < 0.02
    if found_again:
        assert ate(result.world_T_cam, truth) < 0.05 * path_length(truth)
    assert result.pose_covariance is not None
    error = aligned_error(result.world_T_cam, truth)[first : last + 1]
    final = np.sqrt(np.trace(result.pose_covariance[first : last + 1, 3:, 3:], axis1=1, axis2=2))
    assert (error < 3.0 * final + 0.02).all()


def test_frames_that_are_all_masked_are_bridged() -> None:
    sequence = stream(FRAMES)
    everything = np.ones(sequence.image_size, dtype=np.int32)
    hidden = range(15, 19)

    def tracks(t: int) -> FrameTracks:
        # The tracker of a fully masked frame follows the mover; its tracks are not those of the scene.
        return renumbered(tracks_of(sequence, t)) if t in hidden else tracks_of(sequence, t)

    solver, updates = feed(sequence, mask=lambda t: everything if t in hidden else sequence.masks[t], tracks=tracks)
    assert all(updates[t].status is FrameStatus.BRIDGED for t in hidden)
    assert all(updates[t].status is not FrameStatus.BRIDGED for t in range(20, FRAMES))
    truth = true_poses(sequence)
    assert ate(solver.finish().world_T_cam, truth) < 0.05 * path_length(truth)


def test_a_stream_that_never_shows_anything_ends_without_an_error() -> None:
    sequence = stream(FRAMES)
    solver, updates = feed(sequence, frames=list(range(16)), tracks=lambda t: no_tracks())
    assert [u.status for u in updates[1:]] == [FrameStatus.BRIDGED] * 15
    result = solver.finish()
    np.testing.assert_allclose(result.world_T_cam, np.tile(np.eye(4), (16, 1, 1)), atol=1e-6)
    assert len(result.landmarks) == 0
