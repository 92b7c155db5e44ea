from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewing_samples import opened

from uni4d_fg.results.report.distrust import distrusted
from uni4d_fg.results.residuals import Residuals, reprojection_residuals
from uni4d_fg.results.run import Run


@pytest.fixture
def run(finished_run: Path) -> Run:
    return opened(finished_run)


@pytest.fixture
def residuals(run: Run) -> Residuals:
    assert run.labelled is not None
    return reprojection_residuals(run.reconstruction, run.labelled)


def stopped(last: float) -> dict[str, object]:
    return {
        "name": "bundle_adjustment",
        "termination": "stopped: iteration limit",
        "num_iterations": 40,
        "energy_curve": [[39, 100.0], [40, last]],
    }


def with_stage(run: Run, name: str, **fields: object) -> Run:
    stage = {**run.summary["stages"][name], **fields}
    return run.with_parts(summary={**run.summary, "stages": {**run.summary["stages"], name: stage}})


def test_a_good_run_gives_no_reason(run: Run, residuals: Residuals) -> None:
    assert distrusted(run, residuals) == []


def test_a_solve_that_was_still_falling_is_named(run: Run) -> None:
    [text] = distrusted(with_stage(run, "bundle_adjustment", solves=[stopped(95.0)]), None)
    assert "before it converged" in text
    assert "lowered the energy by 5 %" in text
    assert distrusted(with_stage(run, "bundle_adjustment", solves=[stopped(99.999)]), None) == []
    [text] = distrusted(with_stage(run, "camera_init", solves=[stopped(95.0)] * 12), None)
    assert "12 of 12" in text


def test_frames_with_few_or_bad_observations_are_named(run: Run, residuals: Residuals) -> None:
    keep = ~((residuals.frame == 2) | (residuals.frame == 3) | (residuals.frame == 6))
    fields = ("row", "frame", "uv", "error", "depth", "is_dynamic")
    few = Residuals(*(getattr(residuals, name)[keep] for name in fields))
    assert distrusted(run, few) == ["Fewer than 30 static points support the camera in frames 2–3, 6."]
    worse = np.where((residuals.frame == 5)[:, None], 10.0, 1.0) * residuals.error
    [text] = distrusted(run, replace(residuals, error=worse))
    assert text.endswith("in frame 5.")


def test_uncertain_cameras_are_named(run: Run) -> None:
    covariance = np.zeros((run.num_frames, 6, 6))
    covariance[3] = np.nan
    covariance[6, 3, 3] = 100.0
    found = distrusted(run.with_parts(reconstruction=replace(run.reconstruction, pose_covariance=covariance)), None)
    assert "do not determine the camera in frame 3" in found[0]
    assert found[1].endswith("in frame 6.")


def test_an_uncertain_focal_length_is_named(run: Run) -> None:
    focal = run.reconstruction.intrinsics[0]
    covariance = np.diag([(0.2 * focal) ** 2, 0.0, 0.0, 0.0])
    reconstruction = replace(run.reconstruction, intrinsics_covariance=covariance)
    assert distrusted(run.with_parts(reconstruction=reconstruction), None) == [
        "The focal length is uncertain by 20 % (standard deviation)."
    ]


def test_that_depth_is_not_metric_is_said_once_and_first(run: Run) -> None:
    cues = {"metric": False, "warnings": ["masks are a guess", "depth is not metric: no depth was given"]}
    found = distrusted(run.with_parts(summary={**run.summary, "cues": cues}), None)
    assert found == ["Depth is not metric: no depth was given.", "Masks are a guess."]


def test_dropped_shares_and_scales_are_judged(run: Run) -> None:
    found = distrusted(with_stage(run, "tracks", tracks={"static": 10, "rejected": 30}), None)
    assert found[0].startswith("30 of 40 tracks were rejected")
    count = len(run.reconstruction.landmarks)
    dropped = {"landmark far from its neighbors": count, "track without depth": 10 * count}
    [text] = distrusted(with_stage(run, "bundle_adjustment", dropped=dropped), None)
    assert text.startswith("50 % of the static landmarks")
    scales = np.resize([-0.3, 0.3], run.num_frames)
    [text] = distrusted(run.with_parts(reconstruction=replace(run.reconstruction, depth_log_scale=scales)), None)
    assert "standard deviation 30 %" in text


def test_what_is_said_twice_is_said_once(run: Run) -> None:
    summary = {**run.summary, "warnings": ["depth is odd"], "cues": {"warnings": ["depth is odd"], "metric": True}}
    assert distrusted(run.with_parts(summary=summary), None) == ["Depth is odd."]


def test_probes_are_not_meant_to_converge(run: Run, residuals: Residuals) -> None:
    solves = run.summary["stages"]["lens"]["solves"]
    probes = [solve for solve in solves if solve["name"].endswith("probe]")]
    assert any(not str(solve["termination"]).startswith("converged") for solve in probes)
    named = [solve | {"name": "lens[zoom]"} for solve in probes]
    assert not distrusted(run, residuals)
    assert any(
        "Stage lens" in reason for reason in distrusted(with_stage(run, "lens", solves=solves + named), residuals)
    )
