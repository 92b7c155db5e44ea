"""Dense depth through a lens and of a camera that zooms: frames are matched, and it is as good as through a pinhole."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from zooming import ramp, zoom_sequence

from uni4d_fg.config.load import load_config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.confidence_store import read_confidence
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.run_folder import RunFolder

FRAMES = 14


def bled(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A cue made of patches of eight pixels, whose disparity has a shift and a smooth error of 5 %."""
    height, width = depth.shape
    small = cv2.resize(depth, (width // 8, height // 8), interpolation=cv2.INTER_AREA)
    disparity = 1 / cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    field = cv2.resize(rng.normal(0, 0.05, (5, 5)), (width, height), interpolation=cv2.INTER_CUBIC)
    shift = rng.normal(0, 0.04) * np.median(disparity)
    return np.asarray(np.exp(field) / (disparity + shift), np.float32)


def scene(lens: Lens, focal: float) -> Sequence:
    """A clip with a cue that bleeds and a known camera."""
    size = {"num_frames": FRAMES, "height": 180, "width": 240, "focal": focal, "objects": "rigid", "seed": 4}
    camera = {"camera_model": lens.model, "distortion": lens.parameters}
    sequence = make_synthetic_sequence(SyntheticSceneConfig(**(size | camera)))
    truth, rng = sequence.ground_truth, np.random.default_rng(4)
    assert truth.depths is not None
    assert truth.intrinsics is not None
    cue = np.stack([bled(np.asarray(depth), rng) for depth in truth.depths])
    return dataclasses.replace(sequence, depths=ArrayFrames(cue), intrinsics=truth.intrinsics, lens=lens)


def fused(sequence: Sequence, folder: Path, *changes: str) -> tuple[float, float, int]:
    """Static AbsRel, the part of the sure pixels that are right to 3 %, and how many frames were matched."""
    without = ["output.clouds=false", "output.pictures=false", "input.intrinsics=fixed"]
    config = load_config("default", [*without, *changes])
    stage = reconstruct(sequence, folder, config).stages["fusion"]
    truth, masks = sequence.ground_truth.depths, sequence.masks
    assert truth is not None
    depth = np.stack(list(read_depth(RunFolder(folder).depth)))
    sure = np.stack(list(read_confidence(RunFolder(folder).confidence, sequence.image_size))) > 0.9
    true, static = np.stack(list(truth)), np.stack(list(masks)) == 0
    ratio = true[static] / depth[static]
    error = np.abs(np.median(ratio) / ratio - 1)
    return float(error.mean()), float(np.mean(error[sure[static]] < 0.03)), stage["matched_frames"]


@pytest.mark.slow
@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
def test_depth_through_a_lens_is_as_good_as_through_a_pinhole(tmp_path: Path) -> None:
    error, right, matched = fused(scene(PINHOLE, 150.0), tmp_path / "straight")
    assert matched == FRAMES
    # Focal lengths at which the corners of the images look where those of the pinhole do.
    for name, k1, focal in (("barrel", -0.12, 170.0), ("pincushion", 0.05, 143.0)):
        bent = fused(scene(Lens("SIMPLE_RADIAL", (k1,)), focal), tmp_path / name)
        assert bent[2] == FRAMES
        assert bent[0] < 1.05 * error
        assert bent[1] > right - 0.01


@pytest.mark.slow
@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
def test_frames_that_zoom_are_matched(tmp_path: Path) -> None:
    still = scene(PINHOLE, 150.0)
    ratio = ramp(FRAMES, 1.5)
    longest = np.array([ratio.max(), ratio.max(), 1.0, 1.0])
    zoomed = dataclasses.replace(
        zoom_sequence(still, ratio), intrinsics=still.intrinsics * longest, zoom=ratio / ratio.max()
    )
    error, right, matched = fused(zoomed, tmp_path / "matched")
    assert matched == FRAMES
    assert right > 0.9
    without, _, none = fused(zoomed, tmp_path / "not", "fusion.multiview.enabled=false")
    assert none == 0
    assert error < 0.5 * without
