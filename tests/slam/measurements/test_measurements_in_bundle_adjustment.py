"""Odometry, GPS and relative poses in bundle adjustment: the metric scale against the truth, and what resuming does."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import gtsam
import measurement_samples as samples
import numpy as np
import pytest
from measurement_samples import scale_error, scene, settings, truth

from uni4d_fg.config.load import load_config
from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import ConfigError
from uni4d_fg.factors import State
from uni4d_fg.factors.variable_types import GPS_MAP, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim.added_factors import LEFT_OUT, AddingRunner, Addition
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.measurements import MeasurementFiles, read_measurements
from uni4d_fg.results.graph_summary import stage_graphs
from uni4d_fg.results.io import load_reconstruction

Stored = dict[str, dict[str, bool]]


def files(folder: Path) -> dict[str, MeasurementFiles]:
    sequence = scene()
    pairs = [(t, t + 1) for t in range(sequence.num_frames - 1)]
    return {
        "odometry": MeasurementFiles(odometry=samples.write_odometry(folder / "o.tum", sequence)),
        "gps": MeasurementFiles(gps=samples.write_gps(folder / "gps.csv", sequence)),
        "relative_poses": MeasurementFiles(relative_poses=samples.write_edges(folder / "edges.g2o", sequence, pairs)),
    }


def test_without_measurements_the_scale_is_the_cues(tmp_path: Path) -> None:
    reconstruct(scene(), tmp_path, settings())
    found = load_reconstruction(tmp_path / "reconstruction.npz")
    assert 0.25 < scale_error(found.world_T_cam, scene()) < 0.35


@pytest.mark.parametrize("kind", ["odometry", "gps", "relative_poses"])
@pytest.mark.parametrize("backend", ["cpp", "python"])
def test_a_wrong_depth_scale_is_mended(tmp_path: Path, kind: str, backend: str) -> None:
    if backend == "cpp":
        pytest.importorskip("uni4d_fg_cpp")
    summary = reconstruct(scene(), tmp_path, settings(f"backend={backend}"), measurements=files(tmp_path)[kind])
    found = load_reconstruction(tmp_path / "reconstruction.npz")
    assert scale_error(found.world_T_cam, scene()) < 0.01
    np.testing.assert_allclose(found.depth_log_scale.mean(), -np.log(samples.CUE_TIMES), atol=0.04)
    assert found.pose_covariance is not None
    assert np.isfinite(found.pose_covariance).all()
    stage = summary.stages["bundle_adjustment"]
    assert any("12 of 12 frames" in fact or "11 relative poses" in fact for fact in stage["facts"])
    assert summary.warnings == []
    # Moving points follow the meter of the cameras.
    points, poses = scene().ground_truth.track_points, truth(scene())
    assert points is not None
    expected = (points[found.dynamic_track] - poses[0, :3, 3]) @ poses[0, :3, :3]
    distance = np.linalg.norm(expected, axis=2)[found.dynamic_observed]
    ratio = np.linalg.norm(found.dynamic_points, axis=2)[found.dynamic_observed] / distance
    assert abs(np.median(ratio) - 1.0) < 0.05


def test_gps_says_where_the_world_is_on_the_map(tmp_path: Path) -> None:
    reconstruct(scene(), tmp_path, settings(), measurements=files(tmp_path)["gps"])
    solved = stage_graphs(tmp_path)["bundle_adjustment"]
    rows = np.loadtxt(tmp_path / "gps.csv", delimiter=",", skiprows=1)
    on_map = (solved.final_state[GPS_MAP][0] @ solved.final_state[POSE])[:, :3, 3]
    assert np.sqrt(np.mean((on_map - rows[:, 1:4]) ** 2)) < 0.002
    assert solved.final.exists(GPS_MAP.key(0))


def test_a_false_position_and_a_false_closure_are_borne(tmp_path: Path) -> None:
    samples.write_gps(tmp_path / "gps.csv", scene())
    lines = (tmp_path / "gps.csv").read_text().splitlines()
    lines[6] = ",".join([lines[6].split(",")[0], "33", "-42", "5", "0.001"])
    (tmp_path / "gps.csv").write_text("\n".join(lines))
    reconstruct(
        scene(), tmp_path, settings("measurements.gps_kernel.kind=cauchy"),
        measurements=MeasurementFiles(gps=tmp_path / "gps.csv"),
    )  # fmt: skip
    found = load_reconstruction(tmp_path / "reconstruction.npz")
    assert scale_error(found.world_T_cam, scene()) < 0.02


def test_measurements_are_nearly_satisfied_at_the_truth(tmp_path: Path) -> None:
    poses = se3.inverse(truth(scene())[0]) @ truth(scene())
    state = State({POSE: poses, LOG_SCALE: np.zeros((len(poses), 1))})
    stage = Stage("bundle_adjustment", Problem.over(state), SolverConfig())
    for kind, given in files(tmp_path).items():
        config = settings().measurements
        measured = read_measurements(given, scene().timestamps, config)
        joined = AddingRunner(run_stage, measured.sources).joined(stage, state)
        energy, count = joined.stage.problem.energy(joined.state), len(poses)
        assert energy < (3.0 * count if kind == "gps" else 1e-4), kind


def test_frames_that_a_state_lacks_are_bridged_by_odometry_and_left_out_of_edges(tmp_path: Path) -> None:
    frames = np.array([2, 3, 7])
    poses = truth(scene())[frames]
    state = State({POSE: poses}, {POSE: frames})
    stage = Stage("bundle_adjustment", Problem.over(state), SolverConfig())
    samples.write_odometry(tmp_path / "o.tum", scene())
    samples.write_edges(tmp_path / "e.g2o", scene(), [(2, 3), (3, 4), (2, 7)])
    given = MeasurementFiles(odometry=tmp_path / "o.tum", relative_poses=tmp_path / "e.g2o")
    measured = read_measurements(given, scene().timestamps, MeasurementsConfig())
    found = [len(source(stage, state).factors) for source in measured.sources]  # type: ignore[union-attr]
    assert found == [2, 2]

    def everywhere(stage: Stage, state: State) -> Addition:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-2)
        steps = ((a, b, gtsam.Pose3(se3.inverse(truth(scene())[a]) @ truth(scene())[b])) for a, b in [(2, 7), (7, 8)])
        return Addition([gtsam.BetweenFactorPose3(POSE.key(a), POSE.key(b), step, noise) for a, b, step in steps])

    _, summary = AddingRunner(run_stage, [everywhere])(stage, state)
    assert summary.notes[LEFT_OUT] == 1
    assert summary.final_energies["BetweenFactorPose3"] < 1e-12


def test_a_resumed_run_with_other_measurements_is_solved_anew(tmp_path: Path) -> None:
    def resumed(given: MeasurementFiles | None, *changes: str) -> dict[str, bool]:
        summary = reconstruct(scene(), tmp_path / "run", settings(*changes), resume=True, measurements=given)
        return {name: stage["resumed"] for name, stage in summary.stages.items() if name != "output"}

    odometry = files(tmp_path)["odometry"]
    assert not any(resumed(None).values())
    first = resumed(odometry)
    assert first["camera_init"]
    assert not first["bundle_adjustment"]
    assert all(resumed(odometry).values())
    assert not resumed(odometry, "measurements.odometry_sigma_m=0.002")["bundle_adjustment"]
    path = odometry.odometry
    assert path is not None
    path.write_text(path.read_text() + "# another file\n")
    assert not resumed(odometry)["bundle_adjustment"]


def test_the_command_line_takes_the_files(tmp_path: Path, cli: Callable[..., tuple[int, str, str]]) -> None:
    from uni4d_fg.frontend.sequence.write import write_native

    write_native(scene(), tmp_path / "seq")
    odometry = samples.write_odometry(tmp_path / "o.tum", scene())
    words = ("reconstruct", tmp_path / "seq", "--out", tmp_path / "run", "--quiet", "--json")
    sets = [word for change in ("output.clouds=false", "output.pictures=false", *samples.PRECISE)
            for word in ("--set", change)]  # fmt: skip
    code, out, _ = cli(*words, "--odometry", odometry, *sets)
    assert code == 0
    assert any("odometry of 12 of 12" in fact for fact in json.loads(out)["stages"]["bundle_adjustment"]["facts"])
    odometry.write_text("1 2 3\n")
    code, _, err = cli(*words, "--odometry", odometry, "--resume", *sets)
    assert code == 3
    assert "o.tum, line 1: 3 columns, expected 8 or 10" in err


def test_gps_of_a_resting_camera_is_said_to_be_of_no_use(tmp_path: Path) -> None:
    samples.write_gps(tmp_path / "gps.csv", scene(), sigma=0.5)
    given = MeasurementFiles(gps=tmp_path / "gps.csv")
    measured = read_measurements(given, scene().timestamps, MeasurementsConfig())
    assert any("gps.csv is not used" in text for text in measured.warnings)


@pytest.mark.parametrize("field", ["measurements.relative_poses_kernel.kind", "loops.kernel.kind"])
def test_kernels_that_gtsam_does_not_have_are_refused(field: str) -> None:
    with pytest.raises(ConfigError, match=f"{field}: .* one of quadratic, huber, cauchy is expected"):
        load_config(None, [f"{field}=pseudo_huber"])


def test_a_sequence_without_times_says_so(tmp_path: Path) -> None:
    sequence = dataclasses.replace(scene(), timestamps=1e6 + np.arange(float(scene().num_frames)))
    given = files(tmp_path)["odometry"]
    with pytest.raises(Exception, match="the same clock"):
        reconstruct(sequence, tmp_path / "run", settings(), measurements=given)


def test_odometry_sets_the_scale_of_a_solve_without_depth_prior(tmp_path: Path) -> None:
    """Energy 'paper' anchors the distance of two cameras: that is loosened."""
    overrides = ("output.clouds=false", "output.pictures=false", *samples.PRECISE)
    reconstruct(scene(), tmp_path, load_config("paper", overrides), measurements=files(tmp_path)["odometry"])
    found = load_reconstruction(tmp_path / "reconstruction.npz")
    assert scale_error(found.world_T_cam, scene()) < 0.01
