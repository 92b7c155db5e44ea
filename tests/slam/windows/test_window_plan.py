"""Windows: which frames, who owns an observation, how results are blended."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.config.load import load_config
from uni4d_fg.errors import ConfigError
from uni4d_fg.slam.windows.motion import join_motion
from uni4d_fg.slam.windows.plan import (
    TrackSpans,
    blend_weight,
    calibration_frames,
    middle_frames,
    owned_range,
    plan_windows,
    windows_of,
)

SIZES = st.tuples(st.integers(2, 12), st.integers(0, 30), st.integers(2, 400))


@given(SIZES)
def test_windows_cover_the_video_and_neighbors_share_the_overlap(sizes: tuple[int, int, int]) -> None:
    overlap, more, num_frames = sizes
    frames = 3 * overlap + more
    windows = plan_windows(num_frames, frames, overlap)
    assert windows[0].start == 0
    assert windows[-1].stop == num_frames
    assert all(len(window) <= frames for window in windows)
    assert all(a.stop - b.start == overlap for a, b in itertools.pairwise(windows))
    assert all(a.stop <= c.start for a, c in zip(windows, windows[2:], strict=False))
    total, middles = np.zeros(num_frames), np.zeros(num_frames)
    for index, window in enumerate(windows):
        total[window.start : window.stop] += blend_weight(windows, index)
        middles[window.start : window.stop] += middle_frames(windows, index)
    np.testing.assert_allclose(total, 1.0)
    np.testing.assert_array_equal(middles, 1.0)


@given(SIZES)
def test_many_windows_are_an_even_number_and_hardly_shorter(sizes: tuple[int, int, int]) -> None:
    overlap, more, num_frames = sizes
    frames = 3 * overlap + more
    windows = plan_windows(num_frames, frames, overlap)
    fewest = max(-(-(num_frames - overlap) // (frames - overlap)), 1)
    assert len(windows) == fewest if fewest < 5 else len(windows) == fewest + fewest % 2
    assert max(map(len, windows)) - min(map(len, windows)) <= 1
    assert len(windows) <= fewest * 6 / 5


def test_a_thousand_frames_are_fourteen_windows() -> None:
    windows = plan_windows(1000, 100, 20)
    assert [len(windows), len(windows[0]), windows[-1].start] == [14, 90, 910]
    assert [len(plan_windows(frames, 100, 20)) for frames in (100, 180, 260, 340, 341, 500)] == [1, 2, 3, 4, 6, 6]


@given(SIZES, st.integers(0, 1000))
def test_every_observation_has_one_owner(sizes: tuple[int, int, int], seed: int) -> None:
    overlap, more, num_frames = sizes
    windows = plan_windows(num_frames, 3 * overlap + more, overlap)
    rng = np.random.default_rng(seed)
    track = rng.integers(0, 10000, 20)
    ends = np.sort(rng.integers(0, num_frames, (20, 2)), axis=1)
    owners = np.zeros((20, num_frames), dtype=int)
    for index, window in enumerate(windows):
        lower, upper = owned_range(ends[:, 0], ends[:, 1], track, windows, index)
        frame = window.frames
        owners[:, frame] += (frame >= lower[:, None]) & (frame < upper[:, None])
    seen = (np.arange(num_frames) >= ends[:, :1]) & (np.arange(num_frames) <= ends[:, 1:])
    np.testing.assert_array_equal(owners[seen], 1)


def test_what_cannot_be_solved_in_windows_is_refused() -> None:
    assert windows_of(load_config("default", []), 1000) == []
    assert windows_of(load_config("default", ["windows.frames=30"]), 30) == []
    assert len(windows_of(load_config("default", ["windows.frames=30"]), 31)) == 2
    with pytest.raises(ConfigError, match="third"):
        plan_windows(100, 20, 10)
    with pytest.raises(ConfigError, match="energy 'map'"):
        windows_of(load_config("paper", ["windows.frames=30"]), 60)
    with pytest.raises(ConfigError, match="fixed"):
        windows_of(load_config("default", ["windows.frames=30", "input.poses=fixed"]), 60)


def test_calibration_frames_are_apart_as_far_as_tracks_reach() -> None:
    def frames(length: int, num_frames: int) -> np.ndarray:
        count = np.full(10, length)
        return calibration_frames(TrackSpans(np.zeros(10, int), count - 1, count), num_frames, 30, 6)

    np.testing.assert_array_equal(frames(60, 60), np.arange(0, 60, 2))
    np.testing.assert_array_equal(frames(3, 1000), np.arange(30))
    np.testing.assert_array_equal(frames(60, 1000), np.arange(0, 300, 10))


def test_trajectories_go_over_from_one_window_to_the_next() -> None:
    windows = plan_windows(10, 6, 2)
    weights = [blend_weight(windows, i) for i in range(2)]
    ones = np.ones((1, 6, 3))
    parts = [
        {"points": ones * 0.0, "observed": np.ones((1, 6), bool), "track": np.array([7]), "instance": np.array([2])},
        {
            "points": np.concatenate([ones * 3.0, ones * 5.0]), "observed": np.zeros((2, 6), bool),
            "track": np.array([7, 9]), "instance": np.array([2, 4]),
        },
    ]  # fmt: skip
    found = join_motion(windows, weights, parts)
    np.testing.assert_allclose(found["points"][0, :, 0], [0, 0, 0, 0, 1, 2, 3, 3, 3, 3])
    assert np.isnan(found["points"][1, :4]).all()
    np.testing.assert_allclose(found["points"][1, 4:], 5.0)
    np.testing.assert_array_equal(found["instance"], [2, 4])
    np.testing.assert_array_equal(found["observed"][0], np.arange(10) < 6)
