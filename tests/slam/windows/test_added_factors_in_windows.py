"""Measurements in windows: the scale, factors within and between windows, and the joint solve against one dense one."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.factors import State
from uni4d_fg.factors.gps_position import gps_position
from uni4d_fg.factors.variable_types import GPS_MAP, POSE
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic import make_synthetic_sequence
from uni4d_fg.frontend.trajectory_files import write_tum
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.geometry.trajectory import Trajectory
from uni4d_fg.optim.added_factors import AddingRunner, Addition
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.measurements import MeasurementFiles
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.slam.reconstruction import Reconstruction
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.added_terms import added_terms
from uni4d_fg.slam.windows.information import Uncertainty, WindowInformation
from uni4d_fg.slam.windows.join import join
from uni4d_fg.slam.windows.plan import Window

FRAMES = 24
"""Windows are frames 0-13 and 10-23."""


def settings(*overrides: str) -> Config:
    windows = ("windows.frames=14", "windows.overlap=4")
    return load_config("default", ["output.clouds=false", "output.pictures=false", *windows, *overrides])


@pytest.fixture(scope="module")
def scene() -> Sequence:
    """A sequence whose depth cue is 1.3 times what it should be."""
    made = make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=FRAMES, height=120, width=160, focal=150.0, margin_px=3.0, grid_columns=16, grid_rows=12,
            render_images=False,
        )
    )  # fmt: skip
    depths = ArrayFrames(np.stack(list(made.depths)) * np.float32(1.3))
    return Sequence(**{**made.__dict__, "depths": depths})


@pytest.fixture(scope="module")
def alone(scene: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    folder = tmp_path_factory.mktemp("alone")
    reconstruct(scene, folder, settings())
    return load_reconstruction(folder / "reconstruction.npz")


def truth(scene: Sequence) -> np.ndarray:
    poses = scene.ground_truth.world_T_cam
    assert poses is not None
    return poses


def scale_error(found: Reconstruction, scene: Sequence) -> float:
    return abs(1.0 / align_trajectories(found.world_T_cam, truth(scene)).scale - 1.0)


def test_odometry_mends_the_scale(scene: Sequence, alone: Reconstruction, tmp_path: Path) -> None:
    assert scale_error(alone, scene) > 0.25
    write_tum(tmp_path / "o.tum", Trajectory(scene.timestamps, truth(scene)))
    config = settings("measurements.odometry_sigma_m=0.001", "measurements.odometry_sigma_rad=0.001")
    reconstruct(scene, tmp_path / "run", config, measurements=MeasurementFiles(odometry=tmp_path / "o.tum"))
    found = load_reconstruction(tmp_path / "run" / "reconstruction.npz")
    assert scale_error(found, scene) < 0.01
    assert found.pose_covariance is not None
    assert alone.pose_covariance is not None
    assert np.trace(found.pose_covariance[-1][3:, 3:]) < np.trace(alone.pose_covariance[-1][3:, 3:])


def test_gps_mends_the_scale_where_windows_are_joined(scene: Sequence, tmp_path: Path) -> None:
    centers = (se3.se3_exp(np.array([0.3, 1.0, -0.5, 9.0, 8.0, 7.0])) @ truth(scene))[:, :3, 3]
    noisy = centers + np.random.default_rng(0).normal(scale=1e-3, size=centers.shape)
    rows = np.concatenate([scene.timestamps[:, None], noisy, np.full((FRAMES, 1), 1e-3)], axis=1)
    header = "timestamp,x,y,z,sigma"
    np.savetxt(tmp_path / "gps.csv", rows, delimiter=",", header=header, comments="", fmt="%.9f")
    reconstruct(scene, tmp_path / "run", settings(), measurements=MeasurementFiles(gps=tmp_path / "gps.csv"))
    found = load_reconstruction(tmp_path / "run" / "reconstruction.npz")
    assert scale_error(found, scene) < 0.01
    np.testing.assert_array_equal(found.world_T_cam[0], np.eye(4))


@pytest.mark.parametrize("pair", [(16, 22), (3, 20)])
def test_a_native_factor_between_frames_of_the_video(
    scene: Sequence, alone: Reconstruction, tmp_path: Path, pair: tuple[int, int]
) -> None:
    """Within the second window, and across windows: numbers are those of the video."""
    first, last = pair
    asked = se3.inverse(alone.world_T_cam[first]) @ alone.world_T_cam[last]
    asked = asked @ se3.se3_exp(np.array([0.02, -0.01, 0.0, 0.03, 0.0, 0.02]))
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    factor = gtsam.BetweenFactorPose3(POSE.key(first), POSE.key(last), gtsam.Pose3(asked), noise)

    def source(stage: Stage, state: State) -> Addition | None:
        return Addition([factor]) if stage.kind == "bundle_adjustment" else None

    reconstruct(scene, tmp_path, settings(), additions=[source])
    found = load_reconstruction(tmp_path / "reconstruction.npz")

    def residual(poses: np.ndarray) -> float:
        step = se3.inverse(poses[first]) @ poses[last]
        return float(np.linalg.norm(se3.se3_log((se3.inverse(asked) @ step)[None])))

    assert residual(alone.world_T_cam) > 0.03
    assert residual(found.world_T_cam) < 0.002


def test_the_join_with_added_terms_is_the_dense_minimum(rng: np.random.Generator) -> None:
    """Windows as random information, GPS as added factors: no step from the end lowers the energy."""
    windows, count = [Window(0, 5), Window(3, 8)], 8
    poses = np.stack([se3.se3_exp(np.array([0.1, 0.2, -0.1, 0.5, 0.2, 0.1]) * t) for t in range(count)])
    cameras = Cameras(poses, np.array([100.0, 100.0, 50.0, 50.0]), np.zeros(count))
    parts = []
    for window in windows:
        size = 7 * len(window) + 4
        root = rng.normal(size=(size, size)) * 10.0
        root[:, :6] = 0.0
        root[:, -4:] = 0.0
        gradient = root.T @ rng.normal(size=size)
        parts.append(
            WindowInformation(
                window,
                cameras.part(window.start, window.stop),
                root.T @ root,
                gradient,
                Uncertainty(root.T @ root, None),
            )
        )
    map_T_world = se3.se3_exp(np.array([0.4, -0.2, 0.3, 1.0, 2.0, 3.0]))
    xyz = (map_T_world @ poses)[:, :3, 3] + rng.normal(scale=0.05, size=(count, 3))

    def source(stage: Stage, state: State) -> Addition:
        batch = gps_position(0, np.arange(count), xyz=xyz, lever_arm=np.zeros((count, 3)), sigma=0.01)
        return Addition([batch], {GPS_MAP: map_T_world[None]}, is_metric=False)

    runner = AddingRunner(run_stage, [source])
    added = added_terms(runner, cameras, load_config("default"))
    joined = join(parts, cameras, np.zeros((4, 4)), added)

    def energy(moved: Cameras, state: State) -> float:
        total = 0.0
        for part in parts:
            d, _ = part.difference(moved)
            total += 0.5 * d @ part.hessian @ d + part.gradient @ d
        return total + added.joined.stage.problem.energy(state)

    found = added.state.replace({POSE: joined.cameras.world_T_cam})
    lowest = energy(joined.cameras, found)
    assert lowest < energy(cameras, added.joined.state)
    for _ in range(20):
        step = rng.normal(scale=1e-4, size=(count, 6)) * (np.arange(count) > 0)[:, None]
        moved = se3.retract(joined.cameras.world_T_cam, step)
        turned = se3.retract(found[GPS_MAP], rng.normal(scale=1e-4, size=(1, 6)))
        there = found.replace({POSE: moved, GPS_MAP: turned})
        assert energy(Cameras(moved, cameras.intrinsics, joined.cameras.log_scale), there) > lowest
    # The covariance is the inverse of the whole Hessian: with GPS it is smaller than without.
    alone = join(parts, cameras, np.zeros((4, 4)))
    with_gps, without = (np.trace(one.covariances()[0], axis1=1, axis2=2)[1:] for one in (joined, alone))
    assert (with_gps < without).all()
