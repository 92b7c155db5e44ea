"""What errors of points add to the covariance of a pose, against poses found with points that err."""

from __future__ import annotations

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project
from uni4d_fg.optim.stage import run_stage
from uni4d_fg.slam.incremental.labels import LabelledFrame
from uni4d_fg.slam.incremental.point_errors import PointErrors, point_errors
from uni4d_fg.slam.incremental.pose import locate
from uni4d_fg.slam.stages.energy import MAP
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise
from uni4d_fg.slam.stages.structure import reprojection_term

INTRINSICS = np.array([300.0, 300.0, 160.0, 120.0])
NOISE = StaticNoise(0.5, 0.03)


def frame(points: np.ndarray) -> LabelledFrame:
    """Return what a camera at the origin sees, exactly."""
    count = len(points)
    uv = np.asarray(project(INTRINSICS, points))
    zero = np.zeros(count, dtype=np.int64)
    return LabelledFrame(np.arange(count), uv, np.full(count, np.nan), np.ones(count), zero, zero[:0])


def test_the_spread_is_that_of_poses_found_with_points_that_err() -> None:
    rng = np.random.default_rng(0)
    config = load_config()
    z = rng.uniform(1.5, 4.0, 120)
    points = np.stack([z * rng.uniform(-0.5, 0.5, 120), z * rng.uniform(-0.35, 0.35, 120), z], axis=1)
    cells = rng.integers(0, 20, 120)
    along = 0.02 * points
    across = np.tile(np.diag([1.0, 1.0, 0.0]) * 0.002**2, (120, 1, 1))
    seen = frame(points)

    def pose(moved: np.ndarray) -> np.ndarray:
        found = locate([np.eye(4)], seen, moved, INTRINSICS, NOISE, config, run_stage)
        twist: np.ndarray = se3.se3_log(found.world_T_cam[None])[0]
        return twist

    twists = []
    for _ in range(150):
        error = along * rng.standard_normal(20)[cells][:, None]
        error[:, :2] += 0.002 * rng.standard_normal((120, 2))
        twists.append(pose(points + error))
    observations = Observations(np.arange(120), np.zeros(120, np.int64), seen.uv, seen.depth, seen.weight)
    batch = reprojection_term(observations, observations.track, 0.5, 1, config.bundle_adjustment, MAP)
    state = Cameras(np.eye(4)[None], INTRINSICS, np.zeros(1)).state(points)
    _, (jacobian, _, _) = batch.linearize(state)
    given = np.linalg.inv(np.einsum("nda,ndb->ab", jacobian, jacobian))
    predicted = PointErrors(along, across).spread(batch, state, given, cells)
    measured = np.cov(np.array(twists).T)
    ratio = np.sqrt(np.diag(measured) / np.diag(predicted))
    assert (ratio > 0.75).all()
    assert (ratio < 1.33).all()


def test_one_view_knows_a_point_across_its_ray_by_one_pixel_and_along_it_by_the_depth_cue() -> None:
    points = np.array([[0.0, 0.0, 2.0]])
    zero = np.zeros(1, dtype=np.int64)
    seen = Observations(np.array([7]), zero, np.array([[160.0, 120.0]]), np.array([2.0]), np.ones(1))
    cameras = Cameras(np.eye(4)[None], INTRINSICS, np.zeros(1))
    errors = point_errors(seen, cameras, 0, np.array([7]), points, NOISE)
    np.testing.assert_allclose(errors.along, [[0.0, 0.0, 2.0 * 0.03]], rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(errors.across[0])), [2.0 * 0.5 / 300.0] * 2 + [0.0], rtol=1e-3)
