"""The joint energy as a last stage of a run: what it writes, resuming, and switching it on and off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import SMALL, arrays_of, make_config, make_scene, masks_of, resumed_stages, run_sound, with_masks

from uni4d_fg.config.solver import NativeKernelConfig
from uni4d_fg.frontend.measurements.relative_poses import RelativePoses
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.joint import NOT_IN_WINDOWS
from uni4d_fg.results.graph_summary import stage_graphs
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.measurements.relative_poses import RelativePoseSource

pytest.importorskip("open3d")

JOINT = "joint.enabled=true"


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return make_scene(SMALL)


def test_a_run_with_the_joint_energy_is_sound_and_can_be_switched_back(sequence: Sequence, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    _, staged = run_sound(sequence, folder.root, make_config())
    before = arrays_of(folder.reconstruction)
    assert "joint" not in stage_graphs(folder.root)

    summary, joint = run_sound(sequence, folder.root, make_config(JOINT), resume=True)
    assert [name for name, resumed in resumed_stages(summary).items() if not resumed] == ["joint", "fusion"]
    solve = summary.stages["joint"]["solves"][-1]
    assert solve["name"] == "joint"
    assert solve["final_energy"] < solve["initial_energy"]
    assert {"static_reprojection", "dynamic_reprojection", "arap", "smoothness"} <= set(solve["final_energies"])
    np.testing.assert_array_equal(joint.dynamic_track, staged.dynamic_track)
    np.testing.assert_array_equal(joint.world_T_cam[0], staged.world_T_cam[0])
    moved = np.linalg.norm(joint.world_T_cam[:, :3, 3] - staged.world_T_cam[:, :3, 3], axis=1)
    assert 0.0 < moved.max() < 0.05
    assert np.nanmax(np.linalg.norm(joint.dynamic_points - staged.dynamic_points, axis=2)) < 0.5
    stored = stage_graphs(folder.root)["joint"]
    assert stored.graph.error(stored.final) == pytest.approx(solve["final_energy"], rel=1e-9)
    assert stored.graph.error(stored.initial) == pytest.approx(solve["initial_energy"], rel=1e-9)

    summary, _ = run_sound(sequence, folder.root, make_config(JOINT), resume=True)
    assert all(resumed_stages(summary).values())

    summary, _ = run_sound(sequence, folder.root, make_config(), resume=True)
    assert "joint" not in summary.stages
    assert not (folder.root / "stages" / "joint.npz").exists()
    assert not list(folder.graphs.glob("joint*"))
    for name, array in arrays_of(folder.reconstruction).items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


def test_measured_poses_hold_the_cameras_of_the_joint_solve_too(sequence: Sequence, tmp_path: Path) -> None:
    last = sequence.num_frames - 1
    assert sequence.ground_truth is not None
    known = np.linalg.inv(sequence.ground_truth.world_T_cam[0]) @ sequence.ground_truth.world_T_cam[last]
    tight = np.eye(6)[None] * 1e8
    source = RelativePoseSource(
        RelativePoses(np.array([0]), np.array([last]), known[None], tight), NativeKernelConfig(kind="quadratic")
    )
    for changes in ((), (JOINT,)):
        folder = RunFolder(tmp_path / f"run{len(changes)}")
        reconstruct(sequence, folder.root, make_config(*changes), additions=[source])
        poses = arrays_of(folder.reconstruction)["world_T_cam"]
        np.testing.assert_allclose(np.linalg.inv(poses[0]) @ poses[last], known, atol=1e-3)


def test_without_moving_points_there_is_nothing_to_do(sequence: Sequence, tmp_path: Path) -> None:
    still = with_masks(sequence, np.zeros_like(masks_of(sequence)))
    summary, result = run_sound(still, tmp_path / "run", make_config(JOINT))
    assert len(result.dynamic_track) == 0
    assert summary.stages["joint"]["facts"] == ["nothing to do without moving points"]


def test_windows_say_that_there_is_none(sequence: Sequence, tmp_path: Path) -> None:
    summary = reconstruct(sequence, tmp_path / "run", make_config(JOINT, "windows.frames=6", "windows.overlap=2"))
    assert NOT_IN_WINDOWS in summary.warnings
    assert "joint" not in summary.stages
