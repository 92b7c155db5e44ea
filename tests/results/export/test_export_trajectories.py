"""TUM and KITTI trajectories as evo reads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from uni4d_fg.frontend.trajectory_files import read_kitti, write_kitti
from uni4d_fg.results.run import Run

file_interface = pytest.importorskip("evo.tools.file_interface")

Export = Callable[..., tuple[Path, object]]


def test_evo_reads_the_tum_trajectory(source: Run, exported: Export) -> None:
    folder, _ = exported("tum")
    theirs = file_interface.read_tum_trajectory_file(str(folder / "trajectory.txt"))
    result = source.reconstruction
    np.testing.assert_allclose(theirs.timestamps, result.timestamps, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.stack(theirs.poses_se3), result.world_T_cam, rtol=0, atol=1e-9)


def test_evo_reads_the_kitti_trajectory(source: Run, exported: Export) -> None:
    folder, _ = exported("kitti")
    theirs = file_interface.read_kitti_poses_file(str(folder / "poses.txt"))
    result = source.reconstruction
    np.testing.assert_allclose(np.stack(theirs.poses_se3), result.world_T_cam, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.loadtxt(folder / "times.txt"), result.timestamps, rtol=0, atol=1e-9)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 6), size=st.floats(1e-3, 1e5))
def test_any_kitti_trajectory_comes_back(tmp_path: Path, seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)) * size
    write_kitti(tmp_path / "poses.txt", poses)
    np.testing.assert_allclose(read_kitti(tmp_path / "poses.txt").world_T_cam, poses, rtol=1e-11, atol=1e-11)
