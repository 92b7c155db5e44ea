"""Confidence of a run on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.files import remove_file
from uni4d_fg.results.confidence_store import read_confidence, write_confidence


def test_maps_come_back_to_half_a_step_at_the_size_of_the_images(tmp_path: Path, rng: np.random.Generator) -> None:
    maps = rng.random((3, 6, 8)).astype(np.float32)
    path = tmp_path / "confidence.npy"
    with write_confidence(path, 3, (6, 8)) as writer:
        for one in maps:
            writer.write(one)
    assert path.stat().st_size < 3 * 6 * 8 + 200
    back = read_confidence(path, (6, 8))
    assert len(back) == 3
    np.testing.assert_allclose(np.stack(list(back)), maps, atol=0.5 / 255 + 1e-6)
    large = read_confidence(path, (24, 32))[1]
    assert large.shape == (24, 32)
    np.testing.assert_allclose(large.mean(), maps[1].mean(), atol=0.03)
    remove_file(path)
    remove_file(path)
    assert not path.exists()


def test_nothing_is_left_of_a_video_that_was_not_written_whole(tmp_path: Path) -> None:
    path = tmp_path / "confidence.npy"
    with pytest.raises(ValueError, match="0 of 2 frames"), write_confidence(path, 2, (4, 4)):
        pass
    with pytest.raises(ValueError, match="does not fit"), write_confidence(path, 2, (4, 4)) as writer:
        writer.write(np.zeros((4, 5), np.float32))
    assert not path.exists()


def test_other_arrays_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "confidence.npy"
    np.save(path, np.zeros((2, 4, 4), np.float32))
    with pytest.raises(InputError, match=r"expected uint8 \(T, h, w\)"):
        read_confidence(path, (4, 4))
