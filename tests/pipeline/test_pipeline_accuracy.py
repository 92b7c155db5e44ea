"""How accurate a reconstruction of the synthetic scene is, with default noise, without noise, and by preset."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import (
    SMALL,
    TINY,
    check_run,
    depth_of,
    make_config,
    make_scene,
    run_sound,
    solves_of,
    with_depth,
    with_true_poses,
)

from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import CueNoise
from uni4d_fg.geometry.camera import camera_to_world, unproject, world_to_camera
from uni4d_fg.optim.adam.runner import AdamRunner
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.compare.comparison import stage_arrays
from uni4d_fg.pipeline.steps import nonrigid_step
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.results.evaluate.depth import DepthReport
from uni4d_fg.results.evaluate.run import EvaluationReport, evaluate_run
from uni4d_fg.results.evaluate.trajectory import TrajectoryMetrics
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

pytest.importorskip("open3d")


@dataclass(frozen=True)
class Scored:
    sequence: Sequence
    run_dir: Path
    result: Reconstruction
    report: EvaluationReport

    @property
    def trajectory(self) -> TrajectoryMetrics:
        assert self.report.trajectory is not None
        return self.report.trajectory

    @property
    def relative_ate(self) -> float:
        return self.trajectory.ate_m / self.trajectory.path_length_reference_m

    @property
    def focal_error(self) -> float:
        truth = self.sequence.ground_truth.intrinsics
        assert truth is not None
        return float(np.abs(self.result.intrinsics[:2] / truth[:2] - 1.0).max())

    @property
    def depth(self) -> DepthReport:
        assert self.report.depth is not None
        return self.report.depth

    @property
    def depth_cue(self) -> DepthReport:
        assert self.report.depth_cue is not None
        return self.report.depth_cue

    @property
    def dynamic_rmse(self) -> float:
        assert self.report.dynamic_points is not None
        rmse = self.report.dynamic_points[0].rmse_m
        assert rmse is not None
        return rmse


def score(sequence: Sequence, run_dir: Path, *overrides: str, preset: str = "default") -> Scored:
    _, result = run_sound(sequence, run_dir, make_config(*overrides, preset=preset))
    return Scored(sequence, run_dir, result, evaluate_run(run_dir, sequence))


def abs_rel(report: DepthReport, region: str) -> float:
    """Mean relative depth error after one scale for the whole video."""
    value = report.metrics["scale"].regions[region].abs_rel
    assert value is not None
    return value


def raw_lift_rmse(scored: Scored) -> float:
    """Error of the cue lifted with the true cameras, at the observed dynamic points."""
    truth, labelled = scored.sequence.ground_truth, load_labels(RunFolder(scored.run_dir).labels)
    assert truth.world_T_cam is not None
    assert truth.intrinsics is not None
    assert truth.track_points is not None
    row, frame = np.nonzero(scored.result.dynamic_observed)
    track = scored.result.dynamic_track[row]
    uv, depth = (values[track, frame].astype(np.float64) for values in (labelled.tracks.uv, labelled.depth))
    lifted = camera_to_world(truth.world_T_cam[frame], unproject(truth.intrinsics, uv, depth))
    error = np.linalg.norm(lifted - truth.track_points[track, frame], axis=1)
    return float(np.sqrt(np.nanmean(error**2)))


def warnings_of(scored: Scored) -> list[str]:
    warnings: list[str] = json.loads(RunFolder(scored.run_dir).summary.read_text())["warnings"]
    return warnings


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Scored:
    sequence = make_scene({"num_frames": 30, "grid_columns": 24, "grid_rows": 18})
    return score(sequence, tmp_path_factory.mktemp("noisy"))


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Scored:
    size = {"num_frames": 12, "grid_columns": 20, "grid_rows": 15, "query_interval": 6}
    return score(make_scene(size, noise=CueNoise.none()), tmp_path_factory.mktemp("exact"))


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> Scored:
    return score(make_scene(SMALL), tmp_path_factory.mktemp("paper"), preset="paper")


def test_cameras_of_the_noisy_scene(noisy: Scored) -> None:
    assert noisy.relative_ate < 0.005
    assert noisy.trajectory.rpe_rotation_deg is not None
    assert noisy.trajectory.rpe_rotation_deg < 0.1


def test_the_focal_length_is_found_from_a_start_five_percent_off(noisy: Scored) -> None:
    truth = noisy.sequence.ground_truth.intrinsics
    assert truth is not None
    assert noisy.sequence.intrinsics[0] / truth[0] == pytest.approx(1.05)
    assert noisy.focal_error < 0.02


def test_fused_depth_is_better_than_the_cue_and_does_not_flicker(noisy: Scored) -> None:
    assert abs_rel(noisy.depth, "static") < 0.125 * abs_rel(noisy.depth_cue, "static")
    assert abs_rel(noisy.depth, "dynamic") < 0.5 * abs_rel(noisy.depth_cue, "dynamic")
    assert noisy.depth.flicker.standard_deviation < 0.01
    assert noisy.depth_cue.flicker.standard_deviation > 0.03


def test_dynamic_points_are_three_times_as_accurate_as_the_lifted_cue(noisy: Scored) -> None:
    assert len(noisy.result.dynamic_track) > 150
    assert noisy.dynamic_rmse < raw_lift_rmse(noisy) / 3.0


def test_exact_cues_give_an_almost_exact_scene(exact: Scored) -> None:
    assert exact.relative_ate < 1e-3
    assert exact.focal_error < 1e-3
    assert exact.trajectory.scale == pytest.approx(1.0, abs=1e-3)
    assert abs_rel(exact.depth, "static") < 1e-4
    assert abs_rel(exact.depth, "dynamic") < 1e-3
    assert exact.depth.flicker.standard_deviation < 1e-4
    assert exact.dynamic_rmse < 2e-3
    assert exact.report.landmarks is not None
    for landmarks in exact.report.landmarks:
        assert landmarks.median_m is not None
        assert landmarks.median_m < 2e-3
    assert np.abs(exact.result.depth_log_scale).max() < 1e-3
    assert float(np.median(exact.result.landmark_error)) < 0.02


def test_the_paper_preset_runs_end_to_end(paper: Scored) -> None:
    stages = json.loads(RunFolder(paper.run_dir).summary.read_text())["stages"]
    assert [solve["name"] for solve in solves_of(stages)][-2:] == ["bundle_adjustment", "nonrigid"]
    assert paper.relative_ate < 0.06
    np.testing.assert_array_equal(paper.result.intrinsics, paper.sequence.intrinsics)
    assert abs_rel(paper.depth, "static") < 0.75 * abs_rel(paper.depth_cue, "static")
    assert len(paper.result.dynamic_track) > 30


def test_the_bare_energy_of_the_paper_does_not_hold_moving_points_and_says_so_and_the_preset_does(
    paper: Scored, noisy: Scored
) -> None:
    for held in (paper, noisy):
        assert "depart from the depth cue" not in " ".join(warnings_of(held))
    scene = stage_arrays(paper.run_dir, "bundle_adjustment")
    labelled = load_labels(RunFolder(paper.run_dir).labels)
    bare = nonrigid_step(labelled, scene, make_config("nonrigid.proximal_weight=0", preset="paper"), Hooks())
    assert "depart from the depth cue" in " ".join(bare.summary["warnings"])
    preset = make_config(preset="paper")
    held_error = depth_error(paper, nonrigid_step(labelled, scene, preset, Hooks()))
    by_adam = nonrigid_step(labelled, scene, preset, Hooks(), AdamRunner(preset.adam))
    assert "depth_prior" not in by_adam.summary["solves"][0]["final_energies"]  # the program that is the baseline
    assert held_error < 0.1 * depth_error(paper, bare)
    assert held_error < 1.1 * depth_error(paper, by_adam)


def depth_error(scored: Scored, record: StageRecord) -> float:
    """Median of |log z - log true z| of moving points, each in the camera of its frame."""
    truth, poses = scored.sequence.ground_truth, stage_arrays(scored.run_dir, "bundle_adjustment")["world_T_cam"]
    assert truth.track_points is not None
    assert truth.world_T_cam is not None
    row, frame = np.nonzero(record.arrays["observed"])
    z = world_to_camera(poses[frame], record.arrays["points"][row, frame])[:, 2]
    there = truth.track_points[record.arrays["track"][row], frame]
    true_z = world_to_camera(truth.world_T_cam[frame], there)[:, 2]
    return float(np.nanmedian(np.abs(np.log(np.maximum(z, 1e-3)) - np.log(true_z))))


def test_the_exact_energy_of_the_static_scene_is_reported(paper: Scored) -> None:
    stages = json.loads(RunFolder(paper.run_dir).summary.read_text())["stages"]
    exact_energy = stages["bundle_adjustment"]["exact_energy"]
    assert set(exact_energy) == {"static_reprojection", "camera_rotation", "camera_translation"}
    assert 0.1 < exact_energy["static_reprojection"] < 2.0


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_fixed_cameras_are_kept_exactly(tmp_path: Path, preset: str) -> None:
    sequence = with_true_poses(make_scene(TINY))
    config = make_config("input.poses=fixed", "input.intrinsics=fixed", preset=preset)
    _, result = run_sound(sequence, tmp_path, config)
    np.testing.assert_array_equal(result.world_T_cam, sequence.initial_world_T_cam)
    np.testing.assert_array_equal(result.intrinsics, sequence.intrinsics)
    assert len(result.landmarks) > 80


def test_initial_poses_are_a_start_and_fix_the_first_camera(tmp_path: Path) -> None:
    sequence = with_true_poses(make_scene(SMALL))
    given = sequence.initial_world_T_cam
    assert given is not None
    summary, result = run_sound(sequence, tmp_path, make_config("input.poses=initial", "input.intrinsics=fixed"))
    assert summary.stages["camera_init"]["facts"] == ["poses taken from the sequence (initial)"]
    np.testing.assert_array_equal(result.world_T_cam[0], given[0])
    np.testing.assert_array_equal(result.intrinsics, sequence.intrinsics)
    moved = np.linalg.norm(result.world_T_cam[1:, :3, 3] - given[1:, :3, 3], axis=1)
    assert 1e-6 < moved.max() < 0.05


def test_a_run_with_views_writes_them(tmp_path: Path) -> None:
    sequence = make_scene(TINY, num_frames=3)
    folder = RunFolder(tmp_path)
    reconstruct(sequence, tmp_path, make_config("output.clouds=true", "output.pictures=true"))
    check_run(tmp_path, sequence)
    views = [folder.static_cloud, *(folder.dynamic_cloud(t) for t in range(sequence.num_frames))]
    views += [folder.trajectory_picture, folder.depth_picture, folder.scene_picture]
    assert all(path.stat().st_size > 100 for path in views)

    shorter = make_scene(TINY, num_frames=2)
    reconstruct(shorter, tmp_path, make_config("output.clouds=true"))
    assert sorted(path.name for path in folder.dynamic_cloud(0).parent.iterdir()) == [f"{t:05d}.ply" for t in range(2)]
    assert not folder.scene_picture.exists()


@pytest.mark.slow
def test_depth_from_motion_that_is_wrong_behind_edges_bends_no_cameras(tmp_path: Path) -> None:
    size = {"num_frames": 20, "grid_columns": 24, "grid_rows": 18}
    scene = make_scene(size, objects="none", noise=CueNoise.none())
    truth, depth = scene.ground_truth.intrinsics, depth_of(scene)
    assert truth is not None
    # What is far is interpolated towards what is near beside it.
    wrong = np.where(depth > np.nanquantile(depth, 0.6), 0.9 * depth, depth)
    seen = dataclasses.replace(with_depth(scene, wrong), depth_parallax=True, focal_sigma=0.01, intrinsics=truth)
    as_cue = score(seen, tmp_path / "as_cue", "geometric_depth.depth_prior=true")
    found = score(seen, tmp_path / "found")
    assert found.focal_error == 0.0
    assert found.relative_ate < 5e-7
    assert found.relative_ate < as_cue.relative_ate / 10.0
    covariance = found.result.intrinsics_covariance
    assert covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)[:2]), 0.01 * truth[:2], rtol=0.01)
