from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewing_samples import opened

from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.results.measures import pose_sigmas
from uni4d_fg.results.residuals import landmark_sigma, reprojection_residuals


def test_an_offset_of_all_observations_is_the_residual(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.labelled is not None
    exact = run.reconstruction
    uv = run.labelled.tracks.uv.copy()
    for rows, points in (
        (exact.landmark_track, np.repeat(exact.landmarks[:, None], exact.num_frames, axis=1)),
        (exact.dynamic_track, exact.dynamic_points),
    ):
        moved = project(exact.intrinsics, world_to_camera(exact.world_T_cam[None], points)) + np.array([3.0, -4.0])
        uv[rows] = np.where(np.isfinite(moved), moved, uv[rows])
    uv[~run.labelled.tracks.visible] = np.nan
    labelled = replace(run.labelled, tracks=replace(run.labelled.tracks, uv=uv))
    residuals = reprojection_residuals(exact, labelled)
    np.testing.assert_allclose(residuals.error, np.tile([3.0, -4.0], (len(residuals.row), 1)), atol=1e-3)
    static = (labelled.weight[exact.landmark_track] > 0).sum()
    assert len(residuals.row) == static + exact.dynamic_observed.sum()
    assert residuals.is_dynamic.sum() == exact.dynamic_observed.sum()
    np.testing.assert_allclose(residuals.per_frame(exact.num_frames, 0.5, dynamic=False), 5.0, atol=1e-3)


def test_a_frame_without_observations_has_no_residual(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.labelled is not None
    weight = run.labelled.weight.copy()
    weight[:, 2] = 0.0
    residuals = reprojection_residuals(run.reconstruction, replace(run.labelled, weight=weight))
    per_frame = residuals.per_frame(run.num_frames, 0.9, dynamic=False)
    assert np.isnan(per_frame).tolist() == [frame == 2 for frame in range(run.num_frames)]


def test_the_certainty_of_a_landmark_is_that_of_its_rays(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.labelled is not None
    reconstruction, residuals = run.reconstruction, reprojection_residuals(run.reconstruction, run.labelled)
    sigma = 1.4826 * np.median(np.abs(residuals.error[~residuals.is_dynamic]))
    found = landmark_sigma(reconstruction, residuals)
    assert np.isfinite(found).mean() > 0.9
    for row in np.flatnonzero(np.isfinite(found))[:3].tolist():
        frames = residuals.frame[(residuals.row == row) & ~residuals.is_dynamic]
        poses, point, step = reconstruction.world_T_cam[frames], reconstruction.landmarks[row], 1e-6
        columns = [
            (
                project(reconstruction.intrinsics, world_to_camera(poses, point + step * axis))
                - project(reconstruction.intrinsics, world_to_camera(poses, point - step * axis))
            ).ravel()
            / (2.0 * step)
            for axis in np.eye(3)
        ]
        jacobian = np.stack(columns, axis=1)
        expected = sigma * np.sqrt(np.trace(np.linalg.inv(jacobian.T @ jacobian)))
        assert found[row] == pytest.approx(expected, rel=1e-4)


def test_one_view_does_not_determine_a_landmark(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.labelled is not None
    weight = np.zeros_like(run.labelled.weight)
    weight[:, 0] = run.labelled.weight[:, 0]
    residuals = reprojection_residuals(run.reconstruction, replace(run.labelled, weight=weight))
    assert np.isinf(landmark_sigma(run.reconstruction, residuals)).all()


def test_sigmas_of_poses_are_those_of_the_covariance(finished_run: Path) -> None:
    reconstruction = opened(finished_run).reconstruction
    covariance = np.tile(np.diag([1e-4, 0.0, 0.0, 4e-6, 0.0, 0.0]), (reconstruction.num_frames, 1, 1))
    covariance[1] = np.nan
    sigmas = pose_sigmas(replace(reconstruction, pose_covariance=covariance))
    assert sigmas is not None
    np.testing.assert_allclose(sigmas[0][2:], 2e-3)
    np.testing.assert_allclose(sigmas[1][2:], np.degrees(1e-2))
    assert np.isnan(sigmas[0][1])
    assert pose_sigmas(replace(reconstruction, pose_covariance=None)) is None
