"""Real sequences: the incremental path against the batch figure of docs/results.md."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stream_samples import ate, stream_config

from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.slam.incremental import FrameStatus, IncrementalReconstructor


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("name", "batch_ate_m"), [("kitchen", 0.0045), ("kitchen_dog", 0.0050)])
def test_the_error_is_at_most_one_and_a_half_times_that_of_the_batch(
    data_root: Path, name: str, batch_ate_m: float
) -> None:
    sequence = read_sequence(data_root / name)
    solver = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, stream_config())
    for t in range(sequence.num_frames):
        update = solver.add_frame(sequence.images[t], sequence.depths[t], sequence.masks[t])
        assert update.status is not FrameStatus.BRIDGED
    result, truth = solver.finish(), sequence.ground_truth.world_T_cam
    assert truth is not None
    assert ate(result.world_T_cam, truth) <= 1.5 * batch_ate_m
    # The color camera's focal length is about 525 px; 585 px are given.
    np.testing.assert_allclose(result.intrinsics[:2], 525.0, rtol=0.05)
