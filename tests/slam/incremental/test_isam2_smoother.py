"""The stream with ISAM2 instead of the window."""

from __future__ import annotations

import numpy as np
import pytest
from stream_samples import ate, feed, stream, stream_config, tracks_of, true_poses

from uni4d_fg.errors import ConfigError, SolverError
from uni4d_fg.pipeline.stream_checkpoint import restore, state_arrays
from uni4d_fg.slam.incremental import FrameStatus, IncrementalReconstructor

SCENE = {"grid_columns": 9, "grid_rows": 7}
EVERY_FRAME = ("incremental.keyframe_parallax=0", "nonrigid.arap_weight=0")


def test_poses_are_those_of_the_window_as_long_as_nothing_leaves_it() -> None:
    sequence = stream(10, **SCENE)
    results, energies = {}, {}
    for smoother in ("window", "isam2"):
        solver, updates = feed(sequence, stream_config(*EVERY_FRAME, f"incremental.smoother={smoother}"))
        assert {update.status for update in updates} == {FrameStatus.KEYFRAME}
        energies[smoother] = updates[-1].reprojection_error_px
        assert np.isfinite(updates[-1].covariance).all()
        results[smoother] = solver.finish()
    found, window = results["isam2"].world_T_cam, results["window"].world_T_cam
    assert np.linalg.norm(found[:, :3, 3] - window[:, :3, 3], axis=1).max() < 0.003
    assert ate(found, true_poses(sequence)) < 1.05 * ate(window, true_poses(sequence))
    assert energies["isam2"] == pytest.approx(energies["window"], rel=0.02)


def test_older_frames_still_count() -> None:
    """Nothing is marginalized: a video longer than the window ends nearer to the truth."""
    sequence = stream(10, **SCENE)
    short = ("incremental.window=6", "incremental.nonrigid_lag=3", "incremental.nonrigid_window=5")
    errors = {}
    for smoother in ("window", "isam2"):
        solver, updates = feed(sequence, stream_config(*EVERY_FRAME, *short, f"incremental.smoother={smoother}"))
        assert updates[-1].window == (6 if smoother == "window" else 10)
        errors[smoother] = ate(solver.finish().world_T_cam, true_poses(sequence))
    assert errors["isam2"] < 1.1 * errors["window"]


def test_a_resumed_stream_grows_its_tree_anew() -> None:
    sequence, config = stream(10, **SCENE), stream_config(*EVERY_FRAME, "incremental.smoother=isam2")
    whole, _ = feed(sequence, config, frames=list(range(7)))
    first, _ = feed(sequence, config, frames=list(range(6)))
    again = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, config)
    restore(again, state_arrays(first))
    again.add_frame(
        sequence.images[6], sequence.depths[6], sequence.masks[6], tracks_of(sequence, 6), sequence.timestamps[6]
    )
    distance = np.linalg.norm(again.window.pose[:, :3, 3] - whole.window.pose[:, :3, 3], axis=1)
    assert distance.max() < 1e-3


def test_too_many_keyframes_are_refused() -> None:
    config = stream_config(*EVERY_FRAME, "incremental.smoother=isam2", "incremental.isam2_max_keyframes=2")
    with pytest.raises(SolverError, match=r"keyframe 3 is one more than incremental\.isam2_max_keyframes"):
        feed(stream(10, **SCENE), config)
    with pytest.raises(ConfigError, match=r"incremental\.smoother: got \"isam\".*window"):
        stream_config("incremental.smoother=isam")
