from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.bars import Content, tracks_inside
from uni4d_fg.frontend.sequence.resize import resize_tracks
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.io import load_tracks, save_tracks


def tracks(confidence: bool = False) -> Tracks:
    rng = np.random.default_rng(0)
    visible = rng.random((5, 4)) < 0.6
    uv = rng.uniform(0, 90, (5, 4, 2)).astype(np.float32)
    uv[~visible] = np.nan
    scores = rng.random((5, 4)).astype(np.float32) if confidence else None
    return Tracks(uv, visible, rng.integers(0, 4, 5).astype(np.int32), scores)


@pytest.mark.parametrize("confidence", [False, True])
def test_round_trip(tmp_path: Path, confidence: bool) -> None:
    before = tracks(confidence)
    save_tracks(tmp_path / "tracks.npz", before)
    after = load_tracks(tmp_path / "tracks.npz")
    np.testing.assert_array_equal(after.uv, before.uv)
    np.testing.assert_array_equal(after.visible, before.visible)
    np.testing.assert_array_equal(after.query_frame, before.query_frame)
    assert (after.confidence is None) == (not confidence)
    if before.confidence is not None and after.confidence is not None:
        np.testing.assert_array_equal(after.confidence, before.confidence)


def test_what_is_known_of_tracks_and_frames_goes_along_with_them() -> None:
    before = replace(tracks(confidence=True), blur_px=np.array([0.0, 3.5, 12.0, 0.0], np.float32))
    some = before.in_frames(np.array([1, 3]), np.zeros(5, np.int32))
    np.testing.assert_array_equal(some.uv, before.uv[:, [1, 3]])
    np.testing.assert_array_equal(some.confidence, before.confidence[:, [1, 3]])
    np.testing.assert_array_equal(some.blur_px, [3.5, 0.0])
    np.testing.assert_allclose(resize_tracks(before, (60, 80), (30, 40)).blur_px, [0.0, 1.75, 6.0, 0.0])
    inside = tracks_inside(before, Content(0, 60, 0, 80))
    np.testing.assert_array_equal(inside.blur_px, before.blur_px)
    np.testing.assert_array_equal(inside.confidence, before.confidence)


def test_blur_of_frames_is_kept(tmp_path: Path) -> None:
    blur = np.array([0.0, 3.5, 12.0, 0.0], np.float32)
    save_tracks(tmp_path / "tracks.npz", replace(tracks(), blur_px=blur))
    after = load_tracks(tmp_path / "tracks.npz")
    np.testing.assert_array_equal(after.blur_px, blur)
    np.testing.assert_array_equal(after.select(np.array([1, 3])).blur_px, blur)
    with pytest.raises(InputError, match=r"blur_px \(3,\) must be \(4,\)"):
        replace(after, blur_px=blur[:3])


def test_files_of_other_programs(tmp_path: Path) -> None:
    """Double precision, 0/1 visibility and positions where a point is hidden are all accepted."""
    uv = np.arange(12.0).reshape(2, 3, 2)
    visible = np.array([[1, 0, 1], [1, 1, 1]], np.uint8)
    np.savez(tmp_path / "t.npz", uv=uv, visible=visible, query_frame=np.array([0, 2]), extra=np.zeros(3))
    loaded = load_tracks(tmp_path / "t.npz")
    assert loaded.uv.dtype == np.float32
    assert loaded.visible.dtype == np.bool_
    assert loaded.query_frame.dtype == np.int32
    assert np.isnan(loaded.uv[0, 1]).all()
    np.testing.assert_array_equal(loaded.uv[1], uv[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv": np.zeros((5, 3, 2), np.float32)}, "must be"),
        ({"uv": np.zeros((5, 4), np.float32)}, "dimensions"),
        ({"uv": np.full((5, 4, 2), np.nan, np.float32)}, "NaN"),
        ({"query_frame": np.array([0, 0, 0, 0, 4])}, r"\[0, 4\)"),
        ({"query_frame": np.array([0, 0, 0, 0, -1])}, r"\[0, 4\)"),
        ({"query_frame": np.zeros(4, int)}, "must be"),
        ({"confidence": np.zeros((5, 3))}, "confidence"),
    ],
)
def test_bad_files_name_the_file(tmp_path: Path, change: dict[str, np.ndarray], message: str) -> None:
    good = tracks()
    arrays = {"uv": good.uv, "visible": good.visible, "query_frame": good.query_frame, **change}
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=message) as caught:
        load_tracks(path)
    assert "bad.npz" in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.npz"):
        load_tracks(tmp_path / "nothing.npz")
