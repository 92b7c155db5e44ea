"""From frames alone, through a lens or a zoom, to cameras and depth: what motion tells of the camera is kept."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.manifest import load_cues
from uni4d_fg.cues.plan import plan_cues
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.sequence.assemble import as_video
from uni4d_fg.frontend.sequence.model import GroundTruth, Sequence, Video
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.stream import stream_sequence
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder

sys.path.insert(0, str(Path(__file__).parents[1] / "slam" / "lens"))
from slam.lens.zooming import zoom_sequence
from warping import warp_sequence

pytest.importorskip("open3d")
pytestmark = pytest.mark.slow

FRAMES = 24


@pytest.fixture(scope="module")
def scene() -> Sequence:
    return make_synthetic_sequence(SyntheticSceneConfig(num_frames=FRAMES, seed=2, objects="none"))


def frames_of(sequence: Sequence) -> Video:
    """Return what a camera records: no cue, no truth."""
    bare = replace(as_video(sequence), depths=None, masks=None, tracks=None, intrinsics=None, lens=PINHOLE)
    return replace(bare, ground_truth=GroundTruth(), depth_is_metric=True)


def solved(video: Video, folder: Path, *changes: str) -> Sequence:
    config = load_config("default", ["output.clouds=false", "output.pictures=false", *changes])
    sequence, _ = gather_cues(video, plan_cues(video, bare=True), folder / "cues", config)
    reconstruct(sequence, folder / "run", config)
    return sequence


def errors(folder: Path, truth: Sequence) -> tuple[float, float]:
    """Return the ATE as a part of the path's extent, and the mean relative error of static depth after one scale."""
    found = load_reconstruction(RunFolder(folder / "run").reconstruction)
    known = truth.ground_truth
    assert known.world_T_cam is not None
    assert known.depths is not None
    extent = float(np.linalg.norm(np.ptp(known.world_T_cam[:, :3, 3], axis=0)))
    depth = read_depth(RunFolder(folder / "run").depth)
    ratio = np.stack([np.asarray(depth[t]) / known.depths[t] for t in range(FRAMES)])
    ratio /= np.nanmedian(ratio)
    return evaluate_trajectory(found.world_T_cam, known.world_T_cam).ate_m / extent, float(
        np.nanmean(np.abs(ratio - 1))
    )


def test_a_lens(scene: Sequence, tmp_path: Path) -> None:
    pinhole = scene.ground_truth.intrinsics
    assert pinhole is not None
    warped = warp_sequence(scene, pinhole, Lens("SIMPLE_RADIAL", (-0.15,)))
    video = frames_of(warped)
    sequence = solved(video, tmp_path)
    result = load_reconstruction(RunFolder(tmp_path / "run").reconstruction)
    assert sequence.masks_from_motion
    assert result.lens == sequence.lens
    assert result.lens.parameters[0] == pytest.approx(-0.15, abs=0.02)
    assert warped.ground_truth.intrinsics is not None
    np.testing.assert_allclose(result.intrinsics[:2], warped.ground_truth.intrinsics[:2], rtol=0.02)
    path, depth = errors(tmp_path, warped)
    assert path < 0.004
    assert depth < 0.03
    again, _ = load_cues(video, tmp_path / "cues")
    assert again.lens == sequence.lens
    assert again.zoom is None


def test_a_zoom(scene: Sequence, tmp_path: Path) -> None:
    ratio = np.exp(np.log(1.5) * np.linspace(0.0, 1.0, FRAMES))
    zoomed = zoom_sequence(scene, ratio)
    assert zoomed.ground_truth.intrinsics is not None
    video = frames_of(zoomed)
    sequence = solved(video, tmp_path)
    result = load_reconstruction(RunFolder(tmp_path / "run").reconstruction)
    assert sequence.zoom is not None
    np.testing.assert_array_equal(result.zoom, sequence.zoom)
    focal = zoomed.ground_truth.intrinsics[0] * ratio
    np.testing.assert_allclose(result.frame_intrinsics[:, 0], focal, rtol=0.03)
    path, depth = errors(tmp_path, zoomed)
    assert path < 0.003  # 0.006 with a readout that is none
    assert depth < 0.05
    again, _ = load_cues(video, tmp_path / "cues")
    np.testing.assert_array_equal(again.zoom, sequence.zoom)
    with pytest.raises(ConfigError, match="this camera zooms"):
        stream_sequence(sequence, tmp_path / "stream", load_config("default", []))


def test_a_lens_that_is_known(scene: Sequence, tmp_path: Path) -> None:
    pinhole, lens = scene.ground_truth.intrinsics, Lens("SIMPLE_RADIAL", (-0.15,))
    assert pinhole is not None
    warped = warp_sequence(scene, pinhole, lens)
    known = warped.ground_truth.intrinsics
    sequence = solved(replace(frames_of(warped), lens=lens, intrinsics=known), tmp_path)
    assert sequence.lens == lens
    np.testing.assert_array_equal(sequence.intrinsics, known)
    path, depth = errors(tmp_path, warped)
    assert path < 0.004
    assert depth < 0.03
