"""A point tracker in windows: positions, hiding, both directions of time, and going on after an interruption."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_networks import moving_points, write_card

from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.cache import FrameCache
from uni4d_fg.cues.card import find_model
from uni4d_fg.cues.point_tracker_network import PointTrackerNetwork, window_starts
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames

CONFIG = NetworkConfig(threads=1, grid_columns=4, grid_rows=3, query_interval=6, margin_px=6.0)
VELOCITY = (0.5, -0.25)


def video(num_frames: int, height: int = 48, width: int = 80) -> ArrayFrames:
    """Every frame is of one gray level, its number."""
    levels = np.arange(num_frames, dtype=np.uint8)
    return ArrayFrames(np.broadcast_to(levels[:, None, None, None], (num_frames, height, width, 3)))


def tracker(tmp_path: Path, frames: int = 8, points: int = 5, overlap: int = 3, **changes: Any) -> PointTrackerNetwork:
    moving_points(tmp_path / "tiny.onnx", frames, points, (24, 40), VELOCITY)
    card = write_card(
        tmp_path / "tiny.yaml",
        kind="tracks",
        input={"name": "video", "scale": 1.0},
        size={"rule": "fixed", "height": 24, "width": 40},
        video={"frames": frames, "points": points, "queries": "queries", "query_order": "txy"},
        outputs={"tracks": "tracks", "order": "TN", "visibility": "visibility", "visibility_kind": "logit"},
        overlap=overlap,
    )
    if changes:
        import yaml

        values = yaml.safe_load(card.read_text())
        for name, value in changes.items():
            values[name] = {**values[name], **value} if isinstance(value, dict) else value
        card.write_text(yaml.safe_dump(values))
    return PointTrackerNetwork(find_model(str(card), "tracks"), CONFIG)


def check_positions(tracks: Any, num_frames: int, size: tuple[int, int] = (48, 80)) -> None:
    """The network works at half the size, so that points move by twice its velocity."""
    frame = np.arange(num_frames)
    at_query = tracks.uv[np.arange(tracks.num_tracks), tracks.query_frame]
    steps = (frame[None] - tracks.query_frame[:, None])[..., None]
    expected = at_query[:, None] + 2 * np.array(VELOCITY) * steps
    seen = tracks.visible
    np.testing.assert_allclose(tracks.uv[seen], expected[seen], atol=1e-3)
    height, width = size
    inside = (expected >= 0).all(axis=2) & (expected[..., 0] < width) & (expected[..., 1] < height)
    assert not (seen & ~inside).any()


def test_tracks_cover_a_short_video_from_every_query(tmp_path: Path) -> None:
    tracks = tracker(tmp_path).track(video(7))
    assert tracks.num_frames == 7
    assert sorted(set(tracks.query_frame.tolist())) == [0, 6]
    assert tracks.num_tracks == 24
    assert tracks.visible.all()
    check_positions(tracks, 7)
    assert tracks.confidence is not None
    assert (tracks.confidence[tracks.visible] >= 0.5).all()


def test_windows_hand_tracks_on_in_both_directions(tmp_path: Path) -> None:
    num_frames = 19  # up to the gray level at which points hide
    tracks = tracker(tmp_path).track(video(num_frames))
    check_positions(tracks, num_frames)
    for query in (0, 6, 12, 18):
        group = tracks.visible[tracks.query_frame == query]
        # Points in the middle of the image stay in it for the whole video.
        assert group.all(axis=1).any(), query


def test_a_short_hiding_is_bridged_and_a_long_one_ends_the_track(tmp_path: Path) -> None:
    num_frames = 30
    tracks = tracker(tmp_path, frames=10, overlap=6).track(video(num_frames))
    check_positions(tracks, num_frames)
    assert not tracks.visible[:, 20:23].any()
    early = tracks.visible[tracks.query_frame == 12]
    assert early[:, 23:].any()
    narrow = tracker(tmp_path, frames=6, overlap=1).track(video(num_frames))
    check_positions(narrow, num_frames)
    assert narrow.visible[narrow.query_frame == 12][:, 24:].sum() < early[:, 24:].sum()


@pytest.mark.parametrize("center", [0.0, 0.5])
def test_the_pixel_center_of_the_network_cancels_out(tmp_path: Path, center: float) -> None:
    tracks = tracker(tmp_path, video={"pixel_center": center}).track(video(7))
    check_positions(tracks, 7)
    grid = tracks.uv[tracks.query_frame == 0, 0]
    np.testing.assert_allclose(grid[0], [6.0, 6.0])
    np.testing.assert_allclose(grid[-1], [73.0, 41.0])


def test_ctrl_c_loses_one_window_and_the_rest_is_not_done_again(tmp_path: Path) -> None:
    model = tracker(tmp_path)
    cache = FrameCache(tmp_path / "windows")
    whole = model.track(video(19))
    calls = 0
    run = model.network.run

    def counted(feeds: Any) -> Any:
        nonlocal calls
        calls += 1
        return run(feeds)

    model.network.run = counted  # type: ignore[method-assign]
    asked = iter([False, False, True])
    with pytest.raises(Cancelled, match="window 2 of"):
        model.track(video(19), should_stop=lambda: next(asked), cache=cache)
    first = calls
    assert first > 0
    again = model.track(video(19), cache=cache)
    total = calls
    model.track(video(19), cache=cache)
    assert calls == total
    np.testing.assert_array_equal(again.uv, whole.uv)
    np.testing.assert_array_equal(again.visible, whole.visible)
    fresh = calls
    model.track(video(19))
    assert total == calls - fresh


def test_a_file_of_another_window_length_is_one_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"by the card it is \(1, 9, 3, 24, 40\)"):
        tracker(tmp_path, video={"frames": 9})
    with pytest.raises(InputError, match="its output 'tracks' has the shape"):
        tracker(tmp_path, outputs={"order": "NT"}).track(video(7))


@given(st.integers(2, 200), st.integers(2, 40), st.data())
def test_windows_cover_every_frame_and_overlap(num_frames: int, length: int, data: st.DataObject) -> None:
    overlap = data.draw(st.integers(1, length - 1))
    starts = window_starts(num_frames, length, overlap)
    covered = np.zeros(num_frames, bool)
    for start in starts:
        covered[start : start + length] = True
    assert covered.all()
    assert starts[0] == 0
    for a, b in itertools.pairwise(starts):
        assert a < b <= a + length - overlap
