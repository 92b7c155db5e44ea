"""How well the camera's path is known, and that depth is as sure as the path allows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pipeline_scenes import TINY, make_config, make_scene

from uni4d_fg.pipeline import fuse, reconstruct
from uni4d_fg.pipeline.fuse import share_right
from uni4d_fg.pipeline.path_uncertainty import path_uncertainty
from uni4d_fg.results.run_folder import RunFolder


def _straight(steps: int, step: float) -> np.ndarray:
    poses = np.tile(np.eye(4), (steps + 1, 1, 1))
    poses[:, 0, 3] = step * np.arange(steps + 1)
    return poses


def test_positions_known_to_a_part_of_the_path() -> None:
    # Sigma 1 cm along each axis of 2 m: sqrt(3) cm. The first frame is held, and rotations do not count.
    poses = _straight(8, 0.25)
    covariance = np.zeros((9, 6, 6))
    covariance[1:] = np.diag([0.3, 0.3, 0.3, 1e-4, 1e-4, 1e-4])
    assert path_uncertainty(poses, covariance) == pytest.approx(np.sqrt(3) * 0.01 / 2.0)


def test_without_a_path_or_covariance_it_is_not_known() -> None:
    assert math.isnan(path_uncertainty(_straight(3, 0.1), None))
    assert math.isnan(path_uncertainty(_straight(3, 0.0), np.zeros((4, 6, 6))))
    assert math.isnan(path_uncertainty(_straight(0, 0.1), np.zeros((1, 6, 6))))


@pytest.mark.parametrize(
    ("uncertainty", "share"),
    # 1, 2 and 3 standard deviations within 3 %; nothing known, and hopeless
    [(0.03, 0.6827), (0.015, 0.9545), (0.01, 0.9973), (math.nan, 1.0), (0.0, 1.0), (5.0, 0.1)],
)
def test_share_that_is_right_is_that_of_the_normal_distribution(uncertainty: float, share: float) -> None:
    assert share_right(uncertainty) == pytest.approx(share, abs=1e-4)


@given(st.floats(1e-6, 10.0), st.floats(1e-6, 10.0))
def test_a_path_that_is_less_known_is_never_surer(one: float, other: float) -> None:
    assert share_right(max(one, other)) <= share_right(min(one, other))


def test_a_path_known_to_seven_thousandths_changes_no_stored_confidence() -> None:
    steps = np.arange(256)
    assert np.array_equal(np.rint(share_right(0.007) * steps), steps)


def test_depth_of_a_run_is_as_sure_as_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = make_scene(TINY)
    stored = []
    for uncertainty in (math.nan, 0.05):
        monkeypatch.setattr(fuse, "path_uncertainty", lambda *_, known=uncertainty: known)
        out = tmp_path / str(uncertainty)
        reconstruct(sequence, out, make_config())
        stored.append(np.load(RunFolder(out).confidence))
    known, doubted = stored
    assert np.mean(known > 0) > 0.3
    np.testing.assert_array_equal(doubted, np.rint(0.4515 * known))  # of a normal distribution, within 0.6 sigma
