from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.errors import Cancelled, InputError, OutputError
from uni4d_fg.frontend.sequence.digest import frames_digest
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks import cache
from uni4d_fg.frontend.tracks.cache import cache_key, load_or_track
from uni4d_fg.frontend.tracks.io import load_tracks, save_tracks

CONFIG = TrackingConfig(grid_columns=6, grid_rows=5, query_interval=2, max_drift_px=2.0)


@pytest.fixture
def sequence() -> Sequence:
    rng = np.random.default_rng(3)
    image = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    images = np.stack([np.roll(image, t, axis=1) for t in range(4)])
    return Sequence(
        name="noise",
        images=ArrayFrames(images),
        depths=ArrayFrames(np.ones((4, 48, 64), np.float32)),
        masks=ArrayFrames(np.zeros((4, 48, 64), np.int32)),
        intrinsics=np.array([60.0, 60.0, 31.5, 23.5]),
        image_size=(48, 64),
        timestamps=np.arange(4.0),
    )


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one entry whenever the tracker runs."""
    seen: list[int] = []
    original = cache.track_grid

    def counted(*arguments: object) -> Tracks:
        seen.append(1)
        return original(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(cache, "track_grid", counted)
    return seen


def assert_same(a: Tracks, b: Tracks) -> None:
    np.testing.assert_array_equal(a.uv, b.uv)
    np.testing.assert_array_equal(a.visible, b.visible)
    np.testing.assert_array_equal(a.query_frame, b.query_frame)
    assert (a.uv.dtype, a.visible.dtype, a.query_frame.dtype) == (
        b.uv.dtype,
        b.visible.dtype,
        b.query_frame.dtype,
    )


def test_second_call_reads_the_cache(sequence: Sequence, tmp_path: Path, runs: list[int]) -> None:
    first = load_or_track(sequence, CONFIG, tmp_path / "cache")
    again = load_or_track(sequence, CONFIG, tmp_path / "cache")
    assert len(runs) == 1
    assert first.num_tracks > 0
    assert_same(first, again)
    assert [p.name for p in (tmp_path / "cache").iterdir()] == [
        f"tracks-{cache_key(frames_digest(sequence.images), CONFIG)}.npz"
    ]


def test_without_a_cache_nothing_is_written(sequence: Sequence, tmp_path: Path, runs: list[int]) -> None:
    load_or_track(sequence, CONFIG, None)
    load_or_track(sequence, CONFIG, None)
    assert len(runs) == 2
    assert not list(tmp_path.iterdir())


def test_own_tracks_come_first(sequence: Sequence, tmp_path: Path, runs: list[int]) -> None:
    own = Tracks(np.zeros((1, 4, 2), np.float32), np.ones((1, 4), bool), np.zeros(1, np.int32))
    assert load_or_track(replace(sequence, tracks=own), CONFIG, tmp_path) is own
    assert not runs
    short = Tracks(own.uv[:, :3], own.visible[:, :3], own.query_frame)
    with pytest.raises(InputError, match="cover 3 frames"):
        load_or_track(replace(sequence, tracks=short), CONFIG, tmp_path)


def test_key_depends_on_every_pixel_and_every_setting(sequence: Sequence) -> None:
    key = cache_key(frames_digest(sequence.images), CONFIG)
    assert cache_key(frames_digest(sequence.images), CONFIG) == key
    for frame in range(4):
        images = np.stack(list(sequence.images))
        images[frame, -1, -1, 2] ^= 1
        assert cache_key(frames_digest(ArrayFrames(images)), CONFIG) != key
    changed = {
        "grid_columns": 7,
        "window_px": 23,
        "max_drift_px": None,
        "forward_backward_px": 0.4,
        "min_observations": 2,
    }
    for name, value in changed.items():
        assert cache_key(frames_digest(sequence.images), CONFIG.model_copy(update={name: value})) != key
    images = np.stack(list(sequence.images))
    assert cache_key(frames_digest(ArrayFrames(images[:3])), CONFIG) != key
    assert cache_key(frames_digest(ArrayFrames(images.reshape(4, 64, 48, 3))), CONFIG) != key


@pytest.mark.parametrize("damage", ["empty", "cut", "garbage", "other length", "missing array"])
def test_corrupt_cache_is_replaced(sequence: Sequence, tmp_path: Path, runs: list[int], damage: str) -> None:
    first = load_or_track(sequence, CONFIG, tmp_path)
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "garbage":
        path.write_bytes(b"not an archive" * 50)
    elif damage == "other length":
        save_tracks(path, Tracks(first.uv[:, :2], first.visible[:, :2], np.zeros_like(first.query_frame)))
    else:
        np.savez(path, uv=first.uv)
    assert_same(load_or_track(sequence, CONFIG, tmp_path), first)
    assert len(runs) == 2
    assert_same(load_tracks(path), first)


def test_cancelled_run_leaves_no_file(sequence: Sequence, tmp_path: Path) -> None:
    asked: list[int] = []

    def stop_while_tracking() -> bool:
        asked.append(1)
        return len(asked) > 6  # four times while the key is computed

    with pytest.raises(Cancelled, match="step"):
        load_or_track(sequence, CONFIG, tmp_path, should_stop=stop_while_tracking)
    with pytest.raises(Cancelled):
        load_or_track(sequence, CONFIG, tmp_path, should_stop=lambda: True)
    assert not list(tmp_path.iterdir())


def test_progress_is_passed_on(sequence: Sequence, tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    load_or_track(sequence, CONFIG, tmp_path, progress=lambda *step: steps.append(step))
    assert steps[-1] == (6, 6)


def test_unwritable_cache_is_an_output_error(sequence: Sequence, tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("in the way")
    with pytest.raises(OutputError):
        load_or_track(sequence, CONFIG, blocker / "cache")
