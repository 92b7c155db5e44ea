"""Covariances of the cameras against their errors, over several small scenes."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.results.evaluate.consistency import evaluate_consistency
from uni4d_fg.slam.incremental import FrameTracks, IncrementalReconstructor
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver


def scene(seed: int, frames: int) -> Sequence:
    return make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=frames, grid_columns=24, grid_rows=18, render_images=False, objects="none", seed=seed
        )
    )


def mean_nees(sequence: Sequence, poses: np.ndarray, covariance: np.ndarray) -> float:
    truth = sequence.ground_truth.world_T_cam
    assert truth is not None
    found = evaluate_consistency(poses, truth, covariance, with_scale=False)
    assert found is not None
    return found.mean


def test_the_normalized_error_of_a_batch_is_one_over_seeds() -> None:
    """Poses of a scene err alike: its mean over frames spreads by about a half, that of six scenes by a fifth."""
    config = load_config("default", ["bundle_adjustment.structure=keep"])
    values = []
    for seed in range(6):
        sequence = scene(seed, 24)
        assert sequence.tracks is not None
        labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
        found = StaticSceneSolver(config, timestamps=sequence.timestamps).solve(
            labelled, sequence.intrinsics, sequence.intrinsics, free_intrinsics=True
        )
        values.append(mean_nees(sequence, found.cameras.world_T_cam, found.pose_covariance))
    assert 1.0 / 1.5 < float(np.mean(values)) < 1.5


def streamed_nees(sequence: Sequence) -> float:
    tracks = sequence.tracks
    assert tracks is not None
    solver = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, load_config("default"))
    for t in range(sequence.num_frames):
        seen = np.flatnonzero(tracks.visible[:, t])
        solver.add_frame(
            sequence.images[t], sequence.depths[t], sequence.masks[t],
            FrameTracks(seen, tracks.uv[seen, t].astype(np.float64)), float(sequence.timestamps[t]),
        )  # fmt: skip
    found = solver.finish()
    assert found.pose_covariance is not None
    return mean_nees(sequence, found.world_T_cam, found.pose_covariance)


@pytest.mark.slow
def test_the_normalized_error_of_streams_is_one() -> None:
    """The focal length is given 5 % too long: frames between keyframes were posed with it, and must not keep it."""
    assert 1.0 / 1.5 < float(np.mean([streamed_nees(scene(seed, 60)) for seed in range(4)])) < 1.5
