"""Where the depth cue contradicts itself, cameras are from the tracks alone; where it does not, nothing changes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardened_cues import hardened_depth
from pipeline_scenes import assert_same_result, make_config, make_scene, resumed_stages, run_sound, with_depth
from slam.lens.zooming import ramp, zoom_sequence

from uni4d_fg.config.synthetic import CueNoise
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.pipeline import lens, reconstruct
from uni4d_fg.progress import SilentReporter
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.slam.lens.calibration import LensCalibration
from uni4d_fg.slam.lens.zoom import ZoomCalibration

SIZE = {
    "num_frames": 20, "height": 120, "width": 160, "focal": 150.0, "grid_columns": 24, "grid_rows": 18,
    "objects": "none", "noise": CueNoise.none(),
}  # fmt: skip
STEP = "structure_from_motion"
ALWAYS = "camera_init.max_depth_spread=null"


class StopAt(SilentReporter):
    """Remembers when a task has begun."""

    def __init__(self, task: str) -> None:
        self.task, self.reached = task, False

    def begin(self, task: str, total: int | None) -> None:
        self.reached |= task == self.task


def poor(seed: int = 5, **changes: Any) -> Sequence:
    """A scene with exact tracks, a network's depth, and focal lengths that are a fifth too long."""
    scene = make_scene(SIZE, **changes)
    truth = scene.ground_truth.intrinsics
    assert truth is not None
    wrong = truth * np.array([1.2, 1.2, 1.0, 1.0])
    return dataclasses.replace(with_depth(scene, hardened_depth(scene, seed, 0.06, 0.1, 7)), intrinsics=wrong)


def errors(sequence: Sequence, run_dir: Path, *overrides: str) -> tuple[float, float, float]:
    """Error of the focal length and of the path as parts of themselves, and the log of the scale of the path."""
    summary, found = run_sound(sequence, run_dir, make_config(*overrides))
    assert (STEP in summary.stages) == (ALWAYS not in overrides)
    truth = sequence.ground_truth
    assert truth.intrinsics is not None
    path = evaluate_run(run_dir, sequence).to_dict()["trajectory"]
    focal = float(np.abs(found.intrinsics[:2] / truth.intrinsics[:2] - 1).max())
    return focal, path["ate_m"] / extent_of(sequence), float(np.log(path["scale"]))


def extent_of(sequence: Sequence) -> float:
    """Extent of the true path, m."""
    poses = sequence.ground_truth.world_T_cam
    assert poses is not None
    return float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))


@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.slow)])
def test_a_poor_cue_does_not_bend_the_cameras(tmp_path: Path, seed: int) -> None:
    sequence = poor(seed)
    focal, path, log_scale = errors(sequence, tmp_path / "found")
    bent_focal, bent_path, _ = errors(sequence, tmp_path / "bent", ALWAYS)
    assert focal < 5e-4
    assert path < 1e-5
    assert bent_focal > 10 * focal
    assert bent_path > 10 * path
    assert abs(log_scale) < 0.05  # which is left to the cue: its frames err by 6 % in shift alone


def test_a_sound_cue_is_used(tmp_path: Path) -> None:
    scene = make_scene(SIZE)
    summary, _ = run_sound(with_depth(scene, hardened_depth(scene, 5, 0.0, 0.01, 2)), tmp_path, make_config())
    assert STEP not in summary.stages


@pytest.mark.slow
def test_a_lens_is_found_without_a_poor_cue(tmp_path: Path) -> None:
    sequence = poor(camera_model="SIMPLE_RADIAL", distortion=(-0.12,))
    summary, found = run_sound(sequence, tmp_path, make_config())
    assert summary.stages["lens"]["camera_model"] == "PINHOLE"  # none was sought beside this cue
    assert found.lens.parameters[0] == pytest.approx(-0.12, abs=0.002)
    np.testing.assert_allclose(found.intrinsics, sequence.ground_truth.intrinsics, rtol=0.002)
    assert any("focal lengths moved by 17 %" in warning for warning in summary.warnings)
    path = evaluate_run(tmp_path, sequence).to_dict()["trajectory"]
    assert path["ate_m"] < 2e-5 * extent_of(sequence)


@pytest.mark.slow
def test_a_zoom_beside_a_poor_cue_is_the_one_of_the_tracks(tmp_path: Path) -> None:
    ratio = ramp(SIZE["num_frames"])
    sequence = zoom_sequence(poor(), ratio)
    _, found = run_sound(sequence, tmp_path, make_config())
    truth = sequence.ground_truth.intrinsics
    assert truth is not None
    np.testing.assert_allclose(found.frame_intrinsics[:, 0], truth[0] * ratio, rtol=0.01)
    path = evaluate_run(tmp_path, sequence).to_dict()["trajectory"]
    assert path["ate_m"] < 1e-3 * extent_of(sequence)


@pytest.mark.slow
def test_a_zoom_that_only_a_poor_cue_asks_for_is_not_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = poor()

    def zooming(labelled: Any, times: Any, size: Any, intrinsics: np.ndarray, *_: Any) -> LensCalibration:
        ratio = ramp(SIZE["num_frames"])
        zoom = ZoomCalibration(ratio / ratio.max(), 1.6 * intrinsics, 6.0, 0.0, ("the camera zooms",))
        return LensCalibration(PINHOLE, zoom.intrinsics, zoom=zoom)

    monkeypatch.setattr(lens, "calibrate_with_shutter", zooming)
    summary, found = run_sound(sequence, tmp_path, make_config())
    assert summary.stages["lens"]["facts"] == ["camera model PINHOLE", "the camera zooms"]
    assert "the tracks alone ask for a pinhole that does not zoom" in summary.stages[STEP]["facts"]
    assert found.zoom is None
    np.testing.assert_allclose(found.intrinsics[:2], sequence.ground_truth.intrinsics[:2], rtol=5e-4)


def test_a_camera_that_only_turns_keeps_the_cameras_of_the_cue(tmp_path: Path) -> None:
    sequence = dataclasses.replace(poor(path="rotation"), intrinsics=make_scene(SIZE).ground_truth.intrinsics)
    summary, _ = run_sound(sequence, tmp_path, make_config())
    said = [warning for warning in summary.warnings if "path and focal lengths may be wrong" in warning]
    assert len(said) == 1
    assert "as the camera hardly moves" in said[0]
    assert evaluate_run(tmp_path, sequence).to_dict()["trajectory"]["rpe_rotation_deg"] < 0.05


@pytest.mark.slow
def test_a_run_that_was_stopped_there_goes_on(tmp_path: Path) -> None:
    sequence, config = poor(), make_config("fusion.multiview.enabled=false")
    undisturbed = reconstruct(sequence, tmp_path / "undisturbed", config)
    reporter = StopAt("bundle adjustment")
    with pytest.raises(Cancelled):
        reconstruct(sequence, tmp_path / "run", config, reporter=reporter, should_stop=lambda: reporter.reached)
    summary = reconstruct(sequence, tmp_path / "run", config, resume=True)
    resumed = {name for name, was in resumed_stages(summary).items() if was}
    assert resumed == {"tracks", "rolling_shutter", "lens", "camera_init", STEP}
    assert_same_result(tmp_path / "run", tmp_path / "undisturbed")
    assert summary.stages[STEP]["facts"] == undisturbed.stages[STEP]["facts"]
    again = reconstruct(sequence, tmp_path / "run", make_config("fusion.multiview.enabled=false", ALWAYS), resume=True)
    assert STEP not in again.stages
    assert not (tmp_path / "run" / "stages" / f"{STEP}.npz").exists()
