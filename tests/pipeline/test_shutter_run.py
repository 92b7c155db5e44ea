"""A run that finds a rolling shutter, one that is told it, and what it refuses."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest
from pipeline.pipeline_scenes import make_config
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.cue_noise import CueNoise
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.geometry.camera import intrinsics_matrix
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.lens.rolling_shutter import Readout

READOUT = Readout(0.05)
"""Of 1 / 15 s between two frames."""


def rows_one_by_one(sequence: Sequence) -> Sequence:
    """The tracks of a scene at rest as a camera sees them whose rows are read one after the other."""
    tracks, truth = sequence.tracks, sequence.ground_truth
    assert tracks is not None
    assert truth.world_T_cam is not None
    assert truth.intrinsics is not None
    times = np.asarray(sequence.timestamps)
    rotation = RotationSpline(times, Rotation.from_matrix(truth.world_T_cam[:, :3, :3]))
    center = CubicSpline(times, truth.world_T_cam[:, :3, 3])
    matrix = intrinsics_matrix(truth.intrinsics)

    def project(points: FloatArray, at: FloatArray) -> FloatArray:
        x = rotation(at).inv().apply(points - center(at)) @ matrix.T
        return np.asarray(x[:, :2] / x[:, 2:])

    points = np.full((tracks.num_tracks, 3), np.nan)
    for t in range(sequence.num_frames):
        mine = np.flatnonzero(tracks.query_frame == t)
        if not len(mine):
            continue
        uv = tracks.uv[mine, t].astype(np.float64)
        pixel = np.rint(uv).astype(int)
        depth = np.asarray(sequence.depths[t])[pixel[:, 1], pixel[:, 0]]
        rays = np.column_stack((uv, np.ones(len(uv)))) @ np.linalg.inv(matrix).T
        points[mine] = rotation(times[t]).apply(rays * depth[:, None]) + center(times[t])
    uv, known = tracks.uv.astype(np.float64), np.isfinite(points).all(axis=1)
    for t in range(sequence.num_frames):
        seen = np.flatnonzero(tracks.visible[:, t] & known)
        when = np.full(len(seen), times[t])
        for _ in range(5):
            when = times[t] + READOUT.delay(project(points[seen], when), sequence.image_size)
        uv[seen, t] += project(points[seen], when) - project(points[seen], np.full(len(seen), times[t]))
    height, width = sequence.image_size
    inside = (uv >= 0).all(axis=2) & (uv <= (width - 1, height - 1)).all(axis=2)
    visible = tracks.visible & inside & known[:, None]
    moved = dataclasses.replace(tracks, uv=uv.astype(np.float32), visible=visible)
    return dataclasses.replace(sequence, tracks=moved)


@functools.cache
def scene() -> Sequence:
    """A fast hand-held camera in a room at rest, with noise of a twentieth of a pixel."""
    settings = SyntheticSceneConfig(
        num_frames=16, height=120, width=160, focal=150.0, objects="none", render_images=False, grid_columns=20,
        grid_rows=15, camera_speed=1.5, seed=3,
        noise=CueNoise(track_sigma_px=0.05),
    )  # fmt: skip
    return rows_one_by_one(make_synthetic_sequence(settings))


def cameras(run: Path, *changes: str, resume: bool = False, sequence: Sequence | None = None) -> FloatArray:
    plain = ("camera.model=pinhole", "camera.zoom=off", "camera_init.max_depth_spread=null")
    reconstruct(sequence or scene(), run, make_config(*plain, *changes), resume=resume)
    return load_reconstruction(RunFolder(run).reconstruction).world_T_cam


def errors(tmp_path: Path, setting: str) -> tuple[float, float, dict[str, object]]:
    poses = cameras(tmp_path / setting, f"camera.rolling_shutter={setting}")
    metrics = evaluate_trajectory(poses, scene().ground_truth.world_T_cam)
    assert metrics.rpe_rotation_deg is not None
    summary = json.loads(RunFolder(tmp_path / setting).summary.read_text(encoding="utf-8"))
    return metrics.ate_m, metrics.rpe_rotation_deg, summary["stages"].get("rolling_shutter", {})


def test_cameras_of_a_rolling_shutter(tmp_path: Path) -> None:
    ate, turns, none = errors(tmp_path, "off")
    assert none == {}
    found_ate, found_turns, found = errors(tmp_path, "auto")
    assert found["readout_s"] == pytest.approx(READOUT.seconds, abs=0.003)
    assert found["axis"] == "rows"
    assert "rolling shutter: rows are read in" in str(found["facts"])
    assert found_ate < 0.3 * ate
    assert found_turns < 0.6 * turns
    told_ate, told_turns, told = errors(tmp_path, "0.05")
    assert "as given" in str(told["facts"])
    assert told_ate < 0.3 * ate
    assert told_turns < 0.6 * turns


def test_a_run_goes_on_with_what_it_found(tmp_path: Path) -> None:
    first = cameras(tmp_path / "run")
    np.testing.assert_array_equal(cameras(tmp_path / "run", resume=True), first)
    summary = json.loads(RunFolder(tmp_path / "run").summary.read_text(encoding="utf-8"))
    assert summary["stages"]["rolling_shutter"]["resumed"]
    assert np.abs(cameras(tmp_path / "run", "camera.rolling_shutter=off", resume=True) - first).max() > 1e-5
    assert not (tmp_path / "run" / "stages" / "rolling_shutter.npz").exists()


def step(run: Path) -> dict[str, object] | None:
    stages: dict[str, dict[str, object]] = json.loads(RunFolder(run).summary.read_text(encoding="utf-8"))["stages"]
    return stages.get("rolling_shutter")


def test_a_readout_is_found_beside_intrinsics_that_are_held(tmp_path: Path) -> None:
    truth = scene().ground_truth
    assert truth.intrinsics is not None
    exact = dataclasses.replace(scene(), intrinsics=truth.intrinsics)
    ate = {}
    for setting in ("off", "auto"):
        changes = (f"camera.rolling_shutter={setting}", "input.intrinsics=fixed")
        poses = cameras(tmp_path / setting, *changes, sequence=exact)
        ate[setting] = evaluate_trajectory(poses, truth.world_T_cam).ate_m
    assert step(tmp_path / "off") is None
    found = step(tmp_path / "auto")
    assert found is not None
    assert found["readout_s"] == pytest.approx(READOUT.seconds, abs=0.003)
    assert ate["auto"] < 0.3 * ate["off"]


def test_where_poses_are_held_no_readout_is_sought(tmp_path: Path) -> None:
    truth = scene().ground_truth
    given = dataclasses.replace(scene(), initial_world_T_cam=truth.world_T_cam)
    cameras(tmp_path / "run", "input.poses=fixed", sequence=given)
    assert step(tmp_path / "run") is None
