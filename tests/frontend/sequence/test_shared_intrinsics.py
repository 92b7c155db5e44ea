"""Intrinsics of a whole video from a ``.npy`` file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.calibration import load_intrinsics
from uni4d_fg.geometry.camera import intrinsics_matrix

KNOWN = np.array([100.0, 101.0, 8.0, 6.0])


@pytest.mark.parametrize("saved", [KNOWN, intrinsics_matrix(KNOWN), np.tile(intrinsics_matrix(KNOWN), (3, 1, 1))])
def test_four_numbers_and_matrices_are_alike(tmp_path: Path, saved: np.ndarray) -> None:
    np.save(tmp_path / "K.npy", saved)
    np.testing.assert_allclose(load_intrinsics(tmp_path / "K.npy", 3, (12, 16)), KNOWN)


def test_four_numbers_are_checked_like_a_matrix(tmp_path: Path) -> None:
    np.save(tmp_path / "K.npy", np.array([100.0, -1.0, 8.0, 6.0]))
    with pytest.raises(InputError, match="has a focal length of -1 px"):
        load_intrinsics(tmp_path / "K.npy", 3, (12, 16))
