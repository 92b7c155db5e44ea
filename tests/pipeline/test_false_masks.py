"""Masks over parts of the still scene: what several frames show there with confidence is depth like any other."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hardened_cues import hardened_depth
from pipeline_scenes import make_config, masks_of, with_depth

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.run_folder import RunFolder

SIZE = SyntheticSceneConfig(num_frames=11, height=240, width=320, focal=300.0, seed=2)


@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
@pytest.mark.parametrize("from_motion", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_what_stands_still_in_a_false_mask_is_as_good_as_beside_it(tmp_path: Path, from_motion: bool) -> None:
    """Of masks from motion; what a given one hides might follow the camera, and is not matched."""
    scene = make_synthetic_sequence(SIZE)
    truth = scene.ground_truth
    assert truth.depths is not None
    masks = masks_of(scene)
    false = np.zeros_like(masks, dtype=bool)
    false[:, 20:110, 30:130] = True
    false &= masks == 0
    marked = ArrayFrames(np.where(false, np.int32(9), masks).astype(np.int32))
    given = dataclasses.replace(
        with_depth(scene, hardened_depth(scene, 4)), masks=marked, masks_from_motion=from_motion,
        intrinsics=truth.intrinsics,
    )  # fmt: skip
    reconstruct(given, tmp_path, make_config("input.intrinsics=fixed"))
    run = RunFolder(tmp_path)
    depth, true = (np.stack(list(maps)) for maps in (read_depth(run.depth), truth.depths))
    beside = (masks == 0) & ~false
    scale = np.median(true[beside] / depth[beside])
    error = np.abs(scale * depth / true - 1)
    cue = np.stack(list(given.depths))
    of_cue = np.abs(np.median(true[beside] / cue[beside]) * cue / true - 1)
    still = (np.load(run.confidence) > 0)[false].mean()
    assert error[beside].mean() < 0.018
    assert error[masks > 0].mean() < 0.45 * of_cue[masks > 0].mean()
    if from_motion:
        assert error[false].mean() < 0.03 < 0.4 * of_cue[false].mean()
        assert still > 0.6
    else:
        assert error[false].mean() < of_cue[false].mean()
        assert still < 0.2
