"""A real moving scene: every third frame of kitchen_dog, tracked, reconstructed and scored."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import make_config, run_sound

from uni4d_fg.frontend.sequence.model import ArrayFrames, FrameSource, GroundTruth, Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.pipeline import RunSummary
from uni4d_fg.results.evaluate.depth import DepthReport
from uni4d_fg.results.evaluate.run import EvaluationReport, evaluate_run
from uni4d_fg.slam.reconstruction import Reconstruction

pytestmark = pytest.mark.data

STEP = 3


def every_frame(sequence: Sequence, step: int) -> Sequence:
    """Take every ``step``-th frame into memory."""
    frames = np.arange(0, sequence.num_frames, step)
    truth = sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.depths is not None

    def pick(source: FrameSource[np.ndarray]) -> ArrayFrames:
        return ArrayFrames(np.stack([source[int(frame)] for frame in frames]))

    return dataclasses.replace(
        sequence,
        images=pick(sequence.images),
        depths=pick(sequence.depths),
        masks=pick(sequence.masks),
        timestamps=sequence.timestamps[frames],
        frame_names=(),
        ground_truth=GroundTruth(truth.world_T_cam[frames], pick(truth.depths)),
    )


@pytest.fixture(scope="module")
def run(
    data_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[RunSummary, Reconstruction, EvaluationReport]:
    folder = data_root / "kitchen_dog"
    if not (folder / "c2w.npy").is_file():
        pytest.skip(f"{folder} is not there")
    sequence, run_dir = every_frame(read_sequence(folder), STEP), tmp_path_factory.mktemp("kitchen_dog")
    tracking = ("tracking.grid_columns=30", "tracking.grid_rows=30", "tracking.query_interval=5")
    summary, result = run_sound(sequence, run_dir, make_config(*tracking))
    return summary, result, evaluate_run(run_dir, sequence)


def abs_rel(report: DepthReport | None, region: str) -> float:
    assert report is not None
    value = report.metrics["scale"].regions[region].abs_rel
    assert value is not None
    return value


def test_the_run_is_complete(run: tuple[RunSummary, Reconstruction, EvaluationReport]) -> None:
    summary, result, _ = run
    assert list(summary.stages) == [
        "tracks",
        "rolling_shutter",
        "lens",
        "camera_init",
        "bundle_adjustment",
        "nonrigid",
        "fusion",
        "output",
    ]
    assert summary.stages["camera_init"]["bridged_frames"] == []
    assert len(result.landmarks) > 1000
    assert len(result.dynamic_points) > 20
    assert np.abs(result.intrinsics[:2] / 585.0 - 1.0).max() < 0.15


def test_the_cameras_are_close_to_the_truth(run: tuple[RunSummary, Reconstruction, EvaluationReport]) -> None:
    trajectory = run[2].trajectory
    assert trajectory is not None
    assert trajectory.path_length_reference_m == pytest.approx(0.26, abs=0.01)
    assert trajectory.ate_m < 0.010
    assert trajectory.rpe_rotation_deg is not None
    assert trajectory.rpe_rotation_deg < 0.2
    assert trajectory.scale == pytest.approx(1.0, abs=0.1)


def test_fused_depth_is_better_than_the_cue(run: tuple[RunSummary, Reconstruction, EvaluationReport]) -> None:
    report = run[2]
    for region in ("static", "dynamic"):
        assert abs_rel(report.depth, region) < 0.6 * abs_rel(report.depth_cue, region)
    assert report.depth is not None
    assert report.depth.flicker.standard_deviation < 0.01
