from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.cues.packed_maps import RELATIVE_ERROR, load_map, rounded, save_map
from uni4d_fg.errors import InputError
from uni4d_fg.files import save_npz


def scene(rng: np.random.Generator, height: int = 240, width: int = 320) -> np.ndarray:
    """A slanted wall with a box before it, with the noise of a depth cue."""
    v, u = np.mgrid[:height, :width] / width
    depth = 2.0 + u + 0.5 * v
    depth[80:160, 100:200] = 1.2 + 0.1 * u[80:160, 100:200]
    return (depth * (1.0 + 1e-3 * rng.standard_normal((height, width)))).astype(np.float32)


def test_numbers_of_any_size_and_sign_come_back_nearly_as_they_were(tmp_path: Path, rng: np.random.Generator) -> None:
    values = (rng.standard_normal((50, 70)) * 10.0 ** rng.uniform(-30, 30, (50, 70))).astype(np.float32)
    save_map(tmp_path / "a.npz", values)
    found = load_map(tmp_path / "a.npz")
    assert found.dtype == np.float32
    error = np.abs(found.astype(np.float64) / values - 1.0)
    assert 0 < error.max() <= RELATIVE_ERROR
    np.testing.assert_array_equal(found, rounded(values))
    np.testing.assert_array_equal(rounded(found), found)


def test_special_values_stay_what_they_are() -> None:
    largest = np.finfo(np.float32).max
    strange = np.array([0xFFFFFFFF, 0x7FFFFFFF, 0xFFF00001], np.uint32).view(np.float32)
    row = np.concatenate([[0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, largest, -largest, 1e-42], strange])
    values = np.stack([row, row[::-1]]).astype(np.float32)
    found = rounded(values)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(values))
    np.testing.assert_array_equal(found[0, :6], values[0, :6])
    np.testing.assert_allclose(found[0, 6:8], values[0, 6:8], rtol=2 * RELATIVE_ERROR)
    assert abs(found[0, 8]) < 1e-38


def test_a_depth_map_takes_less_than_a_third(tmp_path: Path, rng: np.random.Generator) -> None:
    values = scene(rng)
    save_map(tmp_path / "a.npz", values)
    assert (tmp_path / "a.npz").stat().st_size < values.nbytes / 3


def test_damage_is_found(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "a.npz"
    save_map(path, scene(rng))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.npz"):
        load_map(path)
    save_npz(path, planes=np.zeros((4, 5, 6), np.uint8))
    with pytest.raises(InputError, match="not a map of the cue cache"):
        load_map(path)
