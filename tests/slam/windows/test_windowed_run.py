"""Reconstruction in windows against the truth and against one graph; what is kept of a stopped run."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.geometry.se3 import se3_log
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.slam.reconstruction import Reconstruction

FRAMES = 36
WINDOWS = ("windows.frames=16", "windows.overlap=5")


@functools.cache
def scene() -> Sequence:
    return make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=FRAMES, height=120, width=160, focal=150.0, margin_px=3.0, grid_columns=16, grid_rows=12,
            render_images=False,
        )
    )  # fmt: skip


def settings(*overrides: str) -> Config:
    return load_config("default", ["output.clouds=false", "output.pictures=false", *overrides])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("windows")
    summary = reconstruct(scene(), folder, settings(*WINDOWS))
    assert any("3 windows" in fact for fact in summary.stages["bundle_adjustment"]["facts"])
    return folder


@pytest.fixture(scope="module")
def found(folder: Path) -> Reconstruction:
    return load_reconstruction(folder / "reconstruction.npz")


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    folder = tmp_path_factory.mktemp("one_graph")
    reconstruct(scene(), folder, settings())
    return load_reconstruction(folder / "reconstruction.npz")


def ate(result: Reconstruction) -> float:
    truth = scene().ground_truth.world_T_cam
    assert truth is not None
    similarity = align_trajectories(result.world_T_cam, truth)
    moved = similarity.scale * result.world_T_cam[:, :3, 3] @ similarity.rotation.T + similarity.translation
    return float(np.sqrt(np.mean(np.sum((moved - truth[:, :3, 3]) ** 2, axis=1))))


def test_the_path_is_nearly_as_good_as_that_of_one_graph(found: Reconstruction, batch: Reconstruction) -> None:
    truth = scene().ground_truth.world_T_cam
    assert truth is not None
    path = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    assert ate(found) < max(1.5 * ate(batch), 0.004 * path)
    np.testing.assert_array_equal(found.world_T_cam[0], np.eye(4))
    assert abs(found.depth_log_scale.mean()) < 1e-6
    np.testing.assert_allclose(found.intrinsics[:2], 150.0, rtol=0.02)


def test_the_poses_agree_with_those_of_one_graph_within_three_sigma(
    found: Reconstruction, batch: Reconstruction
) -> None:
    assert found.pose_covariance is not None
    twist = se3_log(se3.inverse(batch.world_T_cam) @ found.world_T_cam)[1:]
    sigma = np.sqrt(np.einsum("nii->ni", found.pose_covariance))[1:]
    assert (found.pose_covariance[0] == 0.0).all()
    assert (np.abs(twist) < 3.0 * sigma).mean() >= 0.95


def test_landmarks_and_trajectories_are_those_of_the_scene(found: Reconstruction, batch: Reconstruction) -> None:
    assert len(found.landmarks) > 0.9 * len(batch.landmarks)
    assert len(np.unique(found.landmark_track)) == len(found.landmark_track)
    assert len(found.dynamic_track) > 0.9 * len(batch.dynamic_track)
    truth, poses = scene().ground_truth.track_points, scene().ground_truth.world_T_cam
    assert truth is not None
    assert poses is not None
    for result in (found, batch):
        expected = (truth[result.dynamic_track] - poses[0, :3, 3]) @ poses[0, :3, :3]
        error = np.linalg.norm(result.dynamic_points - expected, axis=2)[result.dynamic_observed]
        assert np.median(error) < 0.08
    # No track jumps where one window hands it to the next.
    step = np.linalg.norm(np.diff(found.dynamic_points, axis=1), axis=2)
    assert np.nanmax(step) < 2.0 * np.nanmax(np.linalg.norm(np.diff(batch.dynamic_points, axis=1), axis=2))


def test_a_stopped_run_keeps_its_finished_windows(tmp_path: Path, folder: Path) -> None:
    windows = tmp_path / "stages" / "windows"
    with pytest.raises(Cancelled):
        reconstruct(scene(), tmp_path, settings(*WINDOWS), should_stop=lambda: (windows / "scene_000010.npz").exists())
    kept = {path.name: path.stat().st_mtime_ns for path in windows.glob("*.npz")}
    assert {"calibration_000000.npz", "scene_000000.npz", "scene_000010.npz"} <= set(kept)
    assert "scene_000021.npz" not in kept
    reconstruct(scene(), tmp_path, settings(*WINDOWS), resume=True)
    assert all((windows / name).stat().st_mtime_ns == time for name, time in kept.items())
    again, whole = (load_reconstruction(f / "reconstruction.npz") for f in (tmp_path, folder))
    for name in ("world_T_cam", "landmarks", "dynamic_points", "pose_covariance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name), err_msg=name)
