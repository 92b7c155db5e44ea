"""Added factors in a stream: marginalization against one batch of everything, metric scale, checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stream_samples import no_tracks, stream, stream_config, tracks_of, true_poses

from uni4d_fg.arrays import Array
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.factors import State, factor
from uni4d_fg.factors.gps_position import gps_position
from uni4d_fg.factors.variable_types import GPS_MAP, POSE, VELOCITY
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.trajectory_files import write_tum
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.geometry.trajectory import Trajectory
from uni4d_fg.optim.added_factors import AddingRunner, Addition
from uni4d_fg.optim.block import BlockObjective
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.pipeline.measurements import MeasurementFiles, read_measurements
from uni4d_fg.pipeline.stream import stream_sequence
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.slam.incremental import FrameStatus, FrameTracks, IncrementalReconstructor
from uni4d_fg.slam.incremental.labels import LabelledFrame
from uni4d_fg.slam.incremental.window import CameraWindow
from uni4d_fg.slam.stages.scene import StaticNoise

EXACT = SolverConfig(max_iterations=100, relative_decrease=1e-14, initial_damping=1e-9)


@factor(POSE, POSE, VELOCITY, dim=3)
def moves_at(first: Array, second: Array, velocity: Array) -> Array:
    """A step of one second at a velocity."""
    return second[..., :3, 3] - first[..., :3, 3] - velocity


@factor(VELOCITY, VELOCITY, dim=3)
def keeps_going(first: Array, second: Array) -> Array:
    """A velocity that hardly changes."""
    return second - first


def nothing_seen() -> LabelledFrame:
    empty, none = np.zeros(0), np.zeros(0, dtype=np.int64)
    return LabelledFrame(none, np.zeros((0, 2)), empty, empty, none, none)


class Sensors:
    """Noisy odometry, positions on a map, velocities of every frame and of the next; all nearly linear."""

    def __init__(self, count: int):
        rng = np.random.default_rng(2)
        steps = se3.se3_exp(rng.normal(scale=[1e-5, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3], size=(count, 6)))
        steps[:, 2, 3] += 0.02
        self.truth = [np.eye(4)]
        for step in steps[1:]:
            self.truth.append(self.truth[-1] @ step)
        noise = se3.se3_exp(rng.normal(scale=1e-4, size=(count, 2, 6)))
        self.steps = {(a, a + n): se3.inverse(self.truth[a]) @ self.truth[a + n] @ noise[a, n - 1]
                      for n in (1, 2) for a in range(count - n)}  # fmt: skip
        self.xyz = np.stack(self.truth)[:, :3, 3] + rng.normal(scale=1e-4, size=(count, 3))

    def __call__(self, stage: Stage, state: State) -> Addition | None:
        frames = state.numbers(POSE)[:, 0]
        if len(frames) < 2:
            return None
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
        native = [
            gtsam.BetweenFactorPose3(POSE.key(a), POSE.key(b), gtsam.Pose3(step), noise)
            for (a, b), step in self.steps.items()
        ]
        rows, xyz = np.arange(len(frames)), self.xyz[frames]
        arm = np.zeros((len(frames), 3))
        loose = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
        factors = [
            native,
            gps_position(0, rows, xyz=xyz, lever_arm=arm, sigma=2e-4),
            gtsam.PriorFactorPose3(GPS_MAP.key(0), gtsam.Pose3(), loose),
            moves_at(rows[:-1], rows[1:], rows[:-1], sigma=1e-3),
            keeps_going(rows[:-1], rows[1:], sigma=1e-3),
        ]
        variables = {GPS_MAP: np.eye(4)[None], VELOCITY: np.zeros((len(frames), 3))}
        return Addition(factors, variables, {VELOCITY: frames}, is_metric=False)


def test_what_leaves_the_window_is_what_a_batch_of_everything_knows() -> None:
    """Native factors, a global variable and one per frame; the newest poses and their covariance are the batch's."""
    count = 14
    sensors = Sensors(count)
    config = stream_config(
        "incremental.window=4", "input.intrinsics=fixed", "incremental.camera_motion.rotation_weight=0",
        "incremental.camera_motion.translation_weight=0",
    )  # fmt: skip
    incremental = config.incremental.model_copy(update={"solver": EXACT})
    config = config.model_copy(update={"incremental": incremental})
    intrinsics = np.array([100.0, 100.0, 50.0, 50.0])
    window = CameraWindow(config, intrinsics, intrinsics, StaticNoise(1.0, 0.05), sources=(sensors,))
    for frame in range(count):
        start = np.eye(4) if frame == 0 else window.pose[-1]
        window.append(frame, start, 0.0, nothing_seen(), 0)
        window.solve(run_stage)
        window.update_covariance()
        while len(window) > 4:
            window.slide()
    assert set(window.added.values) == {GPS_MAP, VELOCITY}
    assert min(window.added.of(VELOCITY)) == (window.frame[0],)

    state = State({POSE: np.stack(sensors.truth)})
    stage = Stage("bundle_adjustment", Problem.over(state).fix(POSE, rows=[0]), EXACT)
    joined = AddingRunner(run_stage, [sensors]).joined(stage, state)
    whole, _ = minimize(BlockObjective(joined.stage.problem, joined.state, EXACT), joined.state, EXACT)
    spread = np.abs(se3.se3_log(se3.inverse(np.stack(sensors.truth)) @ whole[POSE])).max()
    error = np.abs(se3.se3_log(se3.inverse(whole[POSE][-4:]) @ window.pose)).max()
    assert spread > 1e-4
    assert error < 1e-3 * spread
    speed = np.stack([window.added.of(VELOCITY)[(frame,)] for frame in window.frame.tolist()])
    np.testing.assert_allclose(speed, whole[VELOCITY][-4:], atol=1e-3 * spread)
    np.testing.assert_allclose(window.added.of(GPS_MAP)[(0,)], whole[GPS_MAP][0], atol=1e-3 * spread)
    from uni4d_fg.optim.marginals import camera_marginals

    marginals = camera_marginals(joined.stage.problem, whole, EXACT, None)
    assert marginals is not None
    np.testing.assert_allclose(window.covariance, marginals.blocks(POSE, count)[-4:], rtol=0.02, atol=1e-12)


def with_wrong_depth(sequence: Sequence) -> Sequence:
    depths = ArrayFrames(np.stack(list(sequence.depths)) * np.float32(1.3))
    return Sequence(**{**sequence.__dict__, "depths": depths})


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return with_wrong_depth(stream(28, grid_columns=15, grid_rows=11))


@pytest.fixture(scope="module")
def odometry(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("odometry") / "o.tum"
    write_tum(path, Trajectory(sequence.timestamps, true_poses(sequence)))
    return path


PRECISE = ("measurements.odometry_sigma_m=0.001", "measurements.odometry_sigma_rad=0.001")


def feed(sequence: Sequence, files: MeasurementFiles | None, lost: range = range(0)) -> IncrementalReconstructor:
    config = stream_config(*PRECISE)
    sources = [] if files is None else read_measurements(files, sequence.timestamps, config.measurements).sources
    solver = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, config, additions=sources)
    for t in range(sequence.num_frames):
        tracks: FrameTracks = no_tracks() if t in lost else tracks_of(sequence, t)
        update = solver.add_frame(
            sequence.images[t], sequence.depths[t], sequence.masks[t], tracks, sequence.timestamps[t]
        )
        assert (update.status is FrameStatus.BRIDGED) == (t in lost)
    return solver


def scale(poses: np.ndarray, sequence: Sequence) -> float:
    return 1.0 / align_trajectories(poses, true_poses(sequence)).scale


def test_odometry_mends_the_scale_of_a_stream(sequence: Sequence, odometry: Path) -> None:
    alone = feed(sequence, None).finish()
    assert scale(alone.world_T_cam, sequence) > 1.25
    found = feed(sequence, MeasurementFiles(odometry=odometry)).finish()
    assert abs(scale(found.world_T_cam, sequence) - 1.0) < 0.03
    assert abs(scale(found.world_T_cam[:8], sequence_part(sequence, 8)) - 1.0) < 0.06  # before there was a window
    assert evaluate_trajectory(found.world_T_cam, true_poses(sequence)).ate_m < 0.008
    assert abs(np.exp(-found.depth_log_scale.mean()) / 1.3 - 1.0) < 0.04


def test_gps_mends_the_scale_of_a_stream(sequence: Sequence, tmp_path: Path) -> None:
    centers = (se3.se3_exp(np.array([0.3, 1.0, -0.5, 9.0, 8.0, 7.0])) @ true_poses(sequence))[:, :3, 3]
    noisy = centers + np.random.default_rng(0).normal(scale=2e-3, size=centers.shape)
    rows = np.concatenate([sequence.timestamps[:, None], noisy, np.full((len(noisy), 1), 2e-3)], axis=1)
    header = "timestamp,x,y,z,sigma"
    np.savetxt(tmp_path / "gps.csv", rows, delimiter=",", header=header, comments="", fmt="%.9f")
    solver = feed(sequence, MeasurementFiles(gps=tmp_path / "gps.csv"))
    found = solver.finish()
    assert abs(scale(found.world_T_cam, sequence) - 1.0) < 0.03


def sequence_part(sequence: Sequence, stop: int) -> Sequence:
    truth = sequence.ground_truth
    poses = true_poses(sequence)[:stop]
    return Sequence(**{**sequence.__dict__, "ground_truth": type(truth)(world_T_cam=poses)})


def test_odometry_bridges_frames_without_tracks(sequence: Sequence, odometry: Path) -> None:
    lost = range(14, 19)
    errors = []
    for files in (None, MeasurementFiles(odometry=odometry)):
        found = feed(sequence, files, lost).finish().world_T_cam
        truth = true_poses(sequence)
        step = se3.inverse(found[13]) @ found[19]
        error = se3.inverse(se3.inverse(truth[13]) @ truth[19]) @ step
        errors.append(float(np.linalg.norm(error[:3, 3])))
    assert errors[1] < 0.3 * errors[0]


def test_a_stream_with_measurements_goes_on_bit_by_bit(sequence: Sequence, odometry: Path, tmp_path: Path) -> None:
    config, files = stream_config(*PRECISE), MeasurementFiles(odometry=odometry)
    stream_sequence(sequence, tmp_path / "whole", config, measurements=files)
    asked = iter(range(1000))
    with pytest.raises(Cancelled):
        stream_sequence(
            sequence, tmp_path / "cut", config, measurements=files, should_stop=lambda: next(asked) >= 15
        )  # fmt: skip
    summary = stream_sequence(sequence, tmp_path / "cut", config, measurements=files, resume=True)
    assert summary.resumed_from == 15
    assert any("odometry of 28 of 28 frames" in line for line in summary.lines())
    whole, cut = (load_reconstruction(tmp_path / name / "reconstruction.npz") for name in ("whole", "cut"))
    np.testing.assert_array_equal(whole.world_T_cam, cut.world_T_cam)
    with pytest.raises(InputError, match="another configuration, selection of frames, calibration or"):
        stream_sequence(sequence, tmp_path / "cut", config, resume=True)


def test_the_command_line_takes_the_files(
    sequence: Sequence, odometry: Path, tmp_path: Path, cli: Callable[..., tuple[int, str, str]]
) -> None:
    write_native(sequence, tmp_path / "seq")
    sets = [word for change in PRECISE for word in ("--set", change)]
    code, out, _ = cli("stream", tmp_path / "seq", "--out", tmp_path / "run", "-q", "--odometry", odometry, *sets)
    assert code == 0
    assert "odometry of 28 of 28 frames from o.tum" in out
    found = load_reconstruction(tmp_path / "run" / "reconstruction.npz")
    assert abs(scale(found.world_T_cam, sequence) - 1.0) < 0.03
