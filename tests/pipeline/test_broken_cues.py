"""Frames whose cue shows nothing: named, and their depth about as good as that of the other frames."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from pipeline_scenes import make_config

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.run_folder import RunFolder

BROKEN = (4, 9)
FRAMES = 13


def hardened(sequence: Sequence) -> Sequence:
    """The sequence with a cue that bleeds and errs smoothly, constant in two frames, whose masks reach too far."""
    rng = np.random.default_rng(4)
    height, width = sequence.image_size
    cue, masks = list[np.ndarray](), np.stack(list(sequence.masks))
    for depth in sequence.ground_truth.depths or ():
        small = cv2.resize(np.asarray(depth), (width // 14, height // 14), interpolation=cv2.INTER_AREA)
        disparity = 1 / cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
        field = cv2.resize(rng.normal(0, 0.06, (6, 6)), (width, height), interpolation=cv2.INTER_CUBIC)
        cue.append(np.exp(field) / (disparity + rng.normal(0, 0.04) * np.median(disparity)))
    for frame in BROKEN:
        cue[frame] = np.full_like(cue[frame], np.median(cue[frame]))
        masks[frame] = cv2.dilate(masks[frame].astype(np.uint8), np.ones((9, 9), np.uint8))
    depths = ArrayFrames(np.stack(cue).astype(np.float32))
    return dataclasses.replace(sequence, depths=depths, masks=ArrayFrames(masks))


@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
def test_broken_frames_are_as_good_as_others(tmp_path: Path) -> None:
    size = SyntheticSceneConfig(num_frames=FRAMES, height=240, width=320, focal=300.0, seed=2)
    sequence = make_synthetic_sequence(size)
    truth = sequence.ground_truth
    assert truth.depths is not None
    given = dataclasses.replace(hardened(sequence), intrinsics=truth.intrinsics)
    stage = reconstruct(given, tmp_path, make_config("input.intrinsics=fixed")).stages["fusion"]
    assert stage["broken_frames"] == list(BROKEN)
    depth, true = (np.stack(list(maps)) for maps in (read_depth(RunFolder(tmp_path).depth), truth.depths))
    static = np.stack(list(sequence.masks)) == 0
    scale = np.median(true[static] / depth[static])
    error = np.array([np.abs(scale * d[s] / g[s] - 1).mean() for d, g, s in zip(depth, true, static, strict=True)])
    assert np.median(error) < 0.025
    assert error[list(BROKEN)].max() < 1.1 * np.median(error)
    assert stage["matched_frames"] == FRAMES
