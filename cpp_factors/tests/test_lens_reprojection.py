"""Reprojection through a lens against GTSAM's factors; against NumPy it is compared with all other types."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from families import arguments_of, split_arguments
from uni4d_fg_cpp import _core

from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.lens_reprojection import fisheye_reprojection, opencv_reprojection
from uni4d_fg.factors.state import State
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.optim.native_factors import native_batches

NATIVE = {
    opencv_reprojection: gtsam.GeneralSFMFactor2Cal3DS2,
    fisheye_reprojection: gtsam.GeneralSFMFactor2Cal3Fisheye,
}


@pytest.mark.parametrize("kind", list(NATIVE), ids=lambda kind: kind.name)
def test_residuals_and_jacobians_are_gtsams(kind: FactorType) -> None:
    arguments = arguments_of(kind.name, np.random.default_rng(0), 200)
    z = world_to_camera(arguments["world_T_cam"], arguments["landmark"])[:, 2]
    arguments = {name: array[z > 0.5] for name, array in arguments.items()}
    count = len(arguments["uv"])
    assert count > 50
    variables, data = split_arguments(kind.name, arguments)
    state = State(dict(zip(kind.variables, variables, strict=True)))
    noise = gtsam.noiseModel.Unit.Create(2)
    factors = [
        NATIVE[kind](data["uv"][i], noise, *(int(variable.key(i)) for variable in kind.variables)) for i in range(count)
    ]
    (theirs,) = native_batches(factors, state)
    expected, expected_jacobians = theirs.linearize(state)
    r, jacobians = _core.linearize(kind.name, variables, data)
    # GTSAM subtracts the measurement, we subtract from it.
    np.testing.assert_allclose(r, -expected, rtol=1e-9, atol=1e-9)
    for ours, jacobian in zip(jacobians, expected_jacobians, strict=True):
        np.testing.assert_allclose(ours, -jacobian, rtol=1e-8, atol=1e-8 * np.abs(jacobian).max())


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.019, 1e-9, 3.0])
@pytest.mark.parametrize("radius", [0.0, 1e-6, 0.4])
@pytest.mark.parametrize("kind", list(NATIVE), ids=lambda kind: kind.name)
def test_singular_points_are_numpys(kind: FactorType, radius: float, z: float) -> None:
    if kind is fisheye_reprojection and radius == 0.0 and z <= 1e-9:
        return  # on the axis there is no image of what lies behind
    camera = np.array([[300.0, 310.0, 160.0, 120.0, -0.1, 0.02, 3e-3, -2e-3]])
    variables = [np.eye(4)[None], np.array([[0.6 * radius, -0.8 * radius, z]]), camera]
    data = {"uv": np.array([[10.0, 20.0]])}
    r, jacobians = _core.linearize(kind.name, variables, data)
    expected, expected_jacobians = kind.linearize(*variables, **data)
    np.testing.assert_allclose(r, expected, rtol=1e-10)
    for ours, jacobian in zip(jacobians, expected_jacobians, strict=True):
        np.testing.assert_allclose(ours, jacobian, rtol=1e-9, atol=1e-9 * np.abs(jacobian).max())
