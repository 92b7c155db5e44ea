"""Black bars, repeated and blurred frames, in whole runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import SMALL, make_config

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.frames import SelectedFrames
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic import make_synthetic_sequence
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.pipeline import RunSummary, reconstruct
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.stages.frame_noise import relative_noise

pytest.importorskip("open3d")


@pytest.fixture(scope="module")
def scene() -> Sequence:
    return make_synthetic_sequence(SyntheticSceneConfig(**(SMALL | {"num_frames": 14})))


def ate(run: Path, sequence: Sequence) -> float:
    return float(evaluate_run(run, sequence).to_dict()["trajectory"]["ate_m"])


def facts(summary: RunSummary) -> str:
    return " ".join(summary.stages["tracks"]["facts"])


@pytest.mark.slow
def test_letterbox_is_left_out(scene: Sequence, tmp_path: Path) -> None:
    bar, (height, width) = 18, scene.image_size

    def boxed(frames: object, value: float) -> ArrayFrames:
        arrays = [np.asarray(a) for a in frames]  # type: ignore[attr-defined]
        pad = ((bar, bar), (0, 0), *([(0, 0)] if arrays[0].ndim == 3 else []))
        return ArrayFrames(np.stack([np.pad(a, pad, constant_values=value) for a in arrays]))

    truth = scene.ground_truth
    letterbox = replace(
        scene, images=boxed(scene.images, 0), depths=boxed(scene.depths, 2.0), masks=boxed(scene.masks, 1),
        image_size=(height + 2 * bar, width), intrinsics=scene.intrinsics + np.array([0, 0, 0, bar]), tracks=None,
        ground_truth=replace(truth, depths=None, intrinsics=None, track_points=None),
    )  # fmt: skip
    plain = replace(scene, tracks=None, ground_truth=replace(truth, track_points=None))
    reconstruct(plain, tmp_path / "plain", make_config())
    summary = reconstruct(letterbox, tmp_path / "boxed", make_config())
    assert f"black bars are left out: {bar} px above, {bar} px below" in facts(summary)
    folder = RunFolder(tmp_path / "boxed")
    seen = load_labels(folder.labels).tracks
    rows = seen.uv[seen.visible][:, 1]
    assert bar <= rows.min()
    assert rows.max() <= height + bar - 1
    depth = np.asarray(read_depth(folder.depth)[3])
    assert np.isnan(depth[:bar]).all()
    assert np.isnan(depth[-bar:]).all()
    assert np.isfinite(depth[bar:-bar]).mean() > 0.9
    found = {name: ate(tmp_path / name, s) for name, s in (("plain", plain), ("boxed", letterbox))}
    assert found["boxed"] == pytest.approx(found["plain"], rel=0.05, abs=2e-5)
    kept = reconstruct(letterbox, tmp_path / "kept", make_config("input.black_bars=keep"))
    assert "black bars" not in facts(kept)


def with_repeats(scene: Sequence, shown: list[int]) -> Sequence:
    """Show frames of a scene again, as a recorder does that drops frames."""
    rows, tracks, truth = np.array(shown), scene.tracks, scene.ground_truth
    assert tracks is not None
    assert truth.world_T_cam is not None
    return replace(
        scene, images=SelectedFrames(scene.images, rows), depths=SelectedFrames(scene.depths, rows),
        masks=SelectedFrames(scene.masks, rows), timestamps=np.arange(len(rows)) / 15.0, frame_names=(),
        tracks=Tracks(
            tracks.uv[:, rows], tracks.visible[:, rows], np.searchsorted(rows, tracks.query_frame).astype(np.int32)
        ),
        ground_truth=replace(
            truth, world_T_cam=truth.world_T_cam[rows], depths=None, track_points=None, rigid_instance=None,
            world_T_object=None,
        ),
    )  # fmt: skip


def test_repeated_frames_get_the_pose_of_the_frame_they_repeat(scene: Sequence, tmp_path: Path) -> None:
    # Every third picture is lost and the one before is shown in its place: the camera jumps behind it.
    sequence = with_repeats(scene, [0, 1, 1, 3, 4, 4, 6, 7, 7, 9, 10, 10, 12, 13])
    summary = reconstruct(sequence, tmp_path / "auto", make_config())
    assert "4 frame(s) repeat the one before and get its pose: 2, 5, 8, 11" in facts(summary)
    result = load_reconstruction(RunFolder(tmp_path / "auto").reconstruction)
    assert result.world_T_cam.shape == (14, 4, 4)
    assert result.pose_covariance is not None
    np.testing.assert_array_equal(result.world_T_cam[[2, 5, 8, 11]], result.world_T_cam[[1, 4, 7, 10]])
    np.testing.assert_array_equal(result.timestamps, sequence.timestamps)
    assert result.dynamic_points.shape[1] == read_depth(RunFolder(tmp_path / "auto").depth).array.shape[0] == 14
    reconstruct(sequence, tmp_path / "keep", make_config("input.repeated_frames=keep"))
    assert ate(tmp_path / "auto", sequence) < ate(tmp_path / "keep", sequence)
    again = reconstruct(sequence, tmp_path / "auto", make_config(), resume=True)
    assert again.stages["bundle_adjustment"]["resumed"]


def test_no_frame_of_a_plain_scene_is_a_repeat(scene: Sequence, tmp_path: Path) -> None:
    assert "repeat" not in facts(reconstruct(scene, tmp_path, make_config()))


def test_blurred_frames_weigh_less(scene: Sequence, tmp_path: Path) -> None:
    tracks, rng = scene.tracks, np.random.default_rng(5)
    assert tracks is not None
    uv, blurred = tracks.uv.copy(), [4, 9]
    uv[:, blurred] += rng.normal(0.0, 2.5, uv[:, blurred].shape).astype(np.float32)
    height, width = scene.image_size
    inside = tracks.visible & np.nan_to_num((uv >= 0).all(-1) & (uv <= (width - 1, height - 1)).all(-1))
    uv[~inside] = np.nan
    sequence = replace(scene, tracks=Tracks(uv, inside, tracks.query_frame))
    errors = {}
    for name, changes in (("weighed", ()), ("alike", ("bundle_adjustment.blurred_frames=null",))):
        reconstruct(sequence, tmp_path / name, make_config(*changes))
        errors[name] = ate(tmp_path / name, sequence)
    assert errors["weighed"] < 0.97 * errors["alike"]


def test_relative_noise_is_told_per_frame() -> None:
    rng = np.random.default_rng(0)
    frame = np.repeat(np.arange(12), 400)
    sigma = 0.3 * np.linspace(1.0, 2.5, 12)  # grows slowly: no blur
    sigma[6] *= 4.0
    residual = rng.normal(size=(len(frame), 2)) * sigma[frame][:, None]
    ratio = relative_noise(residual, frame, 13)  # nothing is seen in the last frame
    assert 2.7 < ratio[6] < 4.0  # four times its own place on the slope, and the worse side counts
    assert np.delete(ratio, 6).max() < 1.5
    assert ratio[12] == 1.0
