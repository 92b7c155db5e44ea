"""The factors of a zoom: no residual at the truth, and the pinhole's where nothing zooms."""

from __future__ import annotations

import numpy as np
from factor_samples import N, random_values, random_variable

from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable import SE3
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, ZOOM
from uni4d_fg.factors.zoom import zoom_smoothness, zoomed_intrinsics, zoomed_reprojection
from uni4d_fg.geometry.camera import camera_to_world, project


def test_residuals_vanish_at_the_truth(rng: np.random.Generator) -> None:
    pose, intrinsics, zoom = random_values(SE3, rng), random_variable(INTRINSICS, rng), random_variable(ZOOM, rng)
    x = random_variable(LANDMARK, rng)
    uv = project(zoomed_intrinsics(intrinsics, zoom), x)
    point = camera_to_world(pose, x)
    zero = zoomed_reprojection.residual(pose, point, intrinsics, zoom, uv=uv)
    np.testing.assert_allclose(zero, np.zeros((N, 2)), atol=1e-9)
    np.testing.assert_array_equal(zoom_smoothness.residual(zoom, zoom), np.zeros((N, 1)))
    # Twice the focal length is a zoom of log 2, and moves pixels away from the principal point.
    far = zoomed_reprojection.residual(pose, point, intrinsics, zoom + np.log(2.0), uv=uv)
    np.testing.assert_allclose(far, -(uv - intrinsics[:, 2:]), atol=1e-9)


def test_without_zoom_it_is_the_static_reprojection(rng: np.random.Generator) -> None:
    pose, intrinsics = random_values(SE3, rng), random_variable(INTRINSICS, rng)
    x = random_variable(LANDMARK, rng)
    x[0, 2], x[1, 2] = 0.0, -0.5  # on the near plane's other side both continue alike
    point, uv = camera_to_world(pose, x), rng.uniform(0, 400, (N, 2))
    ours, jacobians = zoomed_reprojection.linearize(pose, point, intrinsics, np.zeros((N, 1)), uv=uv)
    plain, expected = static_reprojection.linearize(pose, point, intrinsics, uv=uv)
    np.testing.assert_allclose(ours, plain)
    for one, other in zip(jacobians[:3], expected, strict=True):
        np.testing.assert_allclose(one, other)
    assert np.isfinite(jacobians[3]).all()
