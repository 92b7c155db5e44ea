"""An IMU in a whole run: metric scale from a cue of unknown scale, and a blackout bridged."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pipeline_scenes import make_config, make_scene

from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic.blackout import black_out
from uni4d_fg.frontend.synthetic.imu import WORLD_GRAVITY, simulate_imu
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import align_points
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

SIZE = {
    "num_frames": 30, "height": 96, "width": 128, "focal": 120.0, "margin_px": 3.0, "grid_columns": 16,
    "grid_rows": 12, "query_interval": 4, "camera_speed": 0.84,
}  # fmt: skip
CUE, FIRST, COUNT = 1.7, 12, 6
BODY_T_CAM = se3.se3_exp(np.array([0.02, -0.01, 1.56, 0.05, 0.04, 0.03]))


@cache
def scene() -> tuple[Sequence, ImuSamples]:
    sequence = make_scene(SIZE, objects="none")
    truth = sequence.ground_truth.world_T_cam
    assert truth is not None
    imu = simulate_imu(sequence.timestamps, truth, body_T_cam=BODY_T_CAM)
    dim = ArrayFrames(np.stack(list(sequence.depths)) / np.float32(CUE))
    return black_out(replace(sequence, depths=dim), FIRST, COUNT), imu.samples


def blackout_error(found: Reconstruction, *, with_scale: bool) -> float:
    truth = scene()[0].ground_truth.world_T_cam
    assert truth is not None
    moved = align_points(found.world_T_cam[:FIRST, :3, 3], truth[:FIRST, :3, 3], with_scale=with_scale).apply(
        found.world_T_cam[:, :3, 3]
    )
    dark = slice(FIRST, FIRST + COUNT)
    return float(np.sqrt(np.mean(np.sum((moved - truth[:, :3, 3])[dark] ** 2, axis=1))))


def run(folder: Path, imu: ImuSamples | None, *, resume: bool = False) -> tuple[Reconstruction, dict[str, Any]]:
    reconstruct(scene()[0], folder, make_config("fusion.averaged_offsets=[]"), imu=imu, resume=resume)
    return load_reconstruction(RunFolder(folder).reconstruction), json.loads(RunFolder(folder).summary.read_text())


def test_a_run_with_an_imu_is_metric_and_bridges_the_blackout(tmp_path: Path) -> None:
    sequence, imu = scene()
    found, summary = run(tmp_path / "imu", imu)
    without, _ = run(tmp_path / "visual", None)
    truth = sequence.ground_truth.world_T_cam
    assert truth is not None
    scale = align_points(found.world_T_cam[:, :3, 3], truth[:, :3, 3]).scale
    assert scale == pytest.approx(1.0, abs=0.02)
    assert blackout_error(found, with_scale=False) < 0.2 * blackout_error(without, with_scale=True)
    seen = np.r_[0:FIRST, FIRST + COUNT : len(truth)]
    np.testing.assert_allclose(found.depth_log_scale[seen].mean(), np.log(CUE), atol=0.03)
    part = summary["stages"]["bundle_adjustment"]["imu"]
    assert part["frames_by_imu_alone"] == list(range(FIRST, FIRST + COUNT))
    assert part["parts"] == 2
    expected = truth[0, :3, :3].T @ WORLD_GRAVITY
    found_down, down = (np.array(g) / np.linalg.norm(g) for g in (part["gravity"], expected))
    assert np.degrees(np.arccos(np.clip(found_down @ down, -1.0, 1.0))) < 1.5
    solves = summary["stages"]["bundle_adjustment"]["solves"]
    terms = set(solves[-3]["final_energies"])
    assert {"CombinedImuFactorWithGravityVector", "gravity_magnitude", "log_scale_deviation"} <= terms
    assert not {"camera_translation", "camera_rotation", "log_scale_prior"} & terms
    # The same samples resume; others do not.
    _, again = run(tmp_path / "imu", imu, resume=True)
    assert again["stages"]["bundle_adjustment"]["resumed"]
    _, other = run(tmp_path / "imu", replace(imu, accelerometer=imu.accelerometer + 0.01), resume=True)
    assert not other["stages"]["bundle_adjustment"]["resumed"]
    assert other["stages"]["camera_init"]["resumed"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["energy=map", "input.poses=fixed"], "input.poses: fixed"),
        (["windows.frames=10", "windows.overlap=4"], "windows"),
    ],
)
def test_configurations_without_a_place_for_an_imu_are_refused(tmp_path: Path, change: list[str], message: str) -> None:
    sequence, imu = scene()
    with pytest.raises(ConfigError, match=message):
        reconstruct(sequence, tmp_path, make_config(*change), imu=imu)
    with pytest.raises(ConfigError, match="energy: paper"):
        reconstruct(sequence, tmp_path, make_config(preset="paper"), imu=imu)


def test_an_imu_on_another_clock_is_refused(tmp_path: Path) -> None:
    sequence, imu = scene()
    with pytest.raises(InputError, match="do not cover the frames"):
        reconstruct(sequence, tmp_path, make_config(), imu=replace(imu, timestamps=imu.timestamps + 50.0))
