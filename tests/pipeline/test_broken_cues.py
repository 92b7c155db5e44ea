"""Frames whose cue shows nothing: named, as good as the others, and no measure of where moving points are."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hardened_cues import hardened_depth, with_broken
from pipeline_scenes import make_config

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.frontend.track_model import TrackLabel
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.compare.comparison import stage_arrays
from uni4d_fg.pipeline.steps import correct_cue, frozen_cameras
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.stages.observations import observations_of

BROKEN = (4, 9)
FRAMES = 13


@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
def test_broken_frames_are_as_good_as_others(tmp_path: Path) -> None:
    size = SyntheticSceneConfig(num_frames=FRAMES, height=240, width=320, focal=300.0, seed=2)
    sequence = make_synthetic_sequence(size)
    truth = sequence.ground_truth
    assert truth.depths is not None
    given = dataclasses.replace(with_broken(sequence, hardened_depth(sequence, 4), BROKEN), intrinsics=truth.intrinsics)
    stage = reconstruct(given, tmp_path, make_config("input.intrinsics=fixed")).stages["fusion"]
    assert stage["broken_frames"] == list(BROKEN)
    depth, true = (np.stack(list(maps)) for maps in (read_depth(RunFolder(tmp_path).depth), truth.depths))
    static = np.stack(list(sequence.masks)) == 0
    scale = np.median(true[static] / depth[static])
    error = np.array([np.abs(scale * d[s] / g[s] - 1).mean() for d, g, s in zip(depth, true, static, strict=True)])
    assert np.median(error) < 0.025
    assert error[list(BROKEN)].max() < 1.1 * np.median(error)
    assert stage["matched_frames"] == FRAMES
    config, labelled = make_config(), load_labels(RunFolder(tmp_path).labels)
    scene = stage_arrays(tmp_path, "bundle_adjustment")
    moving = observations_of(labelled, TrackLabel.DYNAMIC)
    assert np.isfinite(moving.depth[np.isin(moving.frame, BROKEN)]).all()
    corrected, *_ = correct_cue(moving, labelled, *frozen_cameras(scene), scene, config)
    np.testing.assert_array_equal(np.isnan(corrected.depth), np.isnan(moving.depth) | np.isin(moving.frame, BROKEN))
