"""Batch kernels against NumPy and against differences: random states, singular points, behind the camera."""

from __future__ import annotations

import numpy as np
import pytest
from families import TWINS, TYPES, Arguments, arguments_of, retract, split_arguments
from hypothesis import given, settings
from hypothesis import strategies as st
from uni4d_fg_cpp import _core

from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import NEAR_PLANE

KERNELS = ("quadratic", "huber", "pseudo_huber", "cauchy", "norm")
TOLERANCE = 1e-10
STEP = 1e-6


def assert_close(actual: np.ndarray, expected: np.ndarray) -> None:
    """Relative to the row's largest entry: small entries of a row may be differences of large ones."""
    assert actual.shape == expected.shape
    axes = tuple(range(1, expected.ndim))
    scale = np.maximum(np.abs(expected).max(axis=axes, keepdims=True, initial=0.0), 1e-3)
    np.testing.assert_array_less(np.abs(actual - expected) / scale, TOLERANCE)


def check(name: str, arguments: Arguments, threads: int = 1) -> None:
    variables, data = split_arguments(name, arguments)
    twin = TWINS[name]
    expected_r, expected_jacobians = twin.linearize(*variables, **data)
    assert_close(_core.residual(name, variables, data, threads), np.asarray(twin.residual(*variables, **data)))
    r, jacobians = _core.linearize(name, variables, data, threads)
    assert_close(r, expected_r)
    assert len(jacobians) == len(expected_jacobians)
    for actual, expected in zip(jacobians, expected_jacobians, strict=True):
        assert_close(actual, np.asarray(expected))


@pytest.mark.parametrize("name", TWINS)
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 40), threads=st.integers(0, 3))
def test_random_states(name: str, seed: int, count: int, threads: int) -> None:
    check(name, arguments_of(name, np.random.default_rng(seed), count), threads)


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_the_derivatives_of_the_residual(name: str, seed: int) -> None:
    """By central differences on the manifolds that a type declares; this needs no twin in NumPy."""
    variables, data = split_arguments(name, arguments_of(name, np.random.default_rng(seed), 30))
    r, jacobians = _core.linearize(name, variables, data)
    assert_close(_core.residual(name, variables, data), r)
    for i, (variable, jacobian) in enumerate(zip(TYPES[name]["variables"], jacobians, strict=True)):
        dim = TYPES[name]["tangents"][variable]
        assert jacobian.shape == (30, TYPES[name]["dim"], dim)
        slopes = np.empty_like(jacobian)
        for k in range(dim):
            ends = []
            for sign in (1.0, -1.0):
                moved = list(variables)
                moved[i] = np.ascontiguousarray(retract(variables[i], sign * STEP * np.eye(dim)[None, k]))
                ends.append(_core.residual(name, moved, data))
            slopes[:, :, k] = (ends[0] - ends[1]) / (2.0 * STEP)
        scale = np.maximum(np.abs(slopes).max(axis=(1, 2), keepdims=True), np.abs(r).max(axis=1)[:, None, None])
        np.testing.assert_array_less(np.abs(jacobian - slopes) / (scale + 1.0), 1e-5)


@pytest.mark.parametrize("name", TYPES)
def test_many_rows_on_several_threads_equal_one_thread(name: str) -> None:
    variables, data = split_arguments(name, arguments_of(name, np.random.default_rng(1), 9001))
    r, jacobians = _core.linearize(name, variables, data, threads=1)
    r_many, jacobians_many = _core.linearize(name, variables, data, threads=4)
    np.testing.assert_array_equal(r, r_many)
    for one, many in zip(jacobians, jacobians_many, strict=True):
        np.testing.assert_array_equal(one, many)


@pytest.mark.parametrize("name", ["static_reprojection", "dynamic_reprojection", "static_depth_prior",
                                  "dynamic_depth_prior"])  # fmt: skip
@pytest.mark.parametrize("z", [-100.0, -1.0, 0.0, 0.5 * NEAR_PLANE, NEAR_PLANE, np.nextafter(NEAR_PLANE, 0), 2.0])
def test_near_plane_and_behind_the_camera(name: str, z: float) -> None:
    arguments = arguments_of(name, np.random.default_rng(2), 5)
    point = "landmark" if "landmark" in arguments else "dynamic_point"
    arguments["world_T_cam"] = np.tile(np.eye(4), (5, 1, 1))
    arguments[point][:, 2] = z
    check(name, arguments)


@pytest.mark.parametrize("back", [0.0, 3.0, 50.0])
def test_depth_reprojection_behind_the_target_camera(back: float) -> None:
    arguments = arguments_of("depth_reprojection", np.random.default_rng(3), 6)
    arguments["target_pose"] = arguments["source_pose"].copy()
    arguments["target_pose"][:, :3, 3] += back * arguments["source_pose"][:, :3, 2]
    check("depth_reprojection", arguments)


@pytest.mark.parametrize("name", ["camera_rotation", "camera_translation"])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 5e-8, 2e-7, 9e-5, 1.1e-4, 1e-2])
def test_camera_at_rest_and_small_motions(name: str, angle: float) -> None:
    rng = np.random.default_rng(4)
    base = se3.se3_exp(rng.normal(size=(8, 6)))
    step = se3.se3_exp(angle * rng.normal(size=(8, 6)))
    floor = np.full(8, 1e-3)
    check(name, {"before": base, "now": base @ step, "after": base @ step @ step, "floor": floor})
    check(name, {"before": base, "now": base.copy(), "after": base.copy(), "floor": floor})


def test_coinciding_points_of_arap() -> None:
    p = np.random.default_rng(5).normal(size=(4, 3))
    check("arap", {"first": p, "second": p.copy(), "first_next": p, "second_next": p + 1e-9})


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KERNELS),
    threshold=st.floats(1e-3, 1e3),
    per_component=st.booleans(),
    log_scale=st.floats(-8, 4),
    threads=st.integers(0, 3),
)
def test_whitening_equals_that_of_a_batch(
    seed: int, kind: str, threshold: float, per_component: bool, log_scale: float, threads: int
) -> None:
    rng = np.random.default_rng(seed)
    arguments = arguments_of("static_reprojection", rng, 30)
    # Residuals from far below to far above the threshold.
    r, jacobians = TWINS["static_reprojection"].linearize(*split_arguments("static_reprojection", arguments)[0],
                                                             uv=arguments["uv"])  # fmt: skip
    sigma = 10.0 ** rng.uniform(-1, 1, (30, 2) if per_component else 30) * 10.0**-log_scale
    weight = rng.uniform(0, 2, 30) * (rng.random(30) > 0.2)
    state = State(
        {POSE: arguments["world_T_cam"], LANDMARK: arguments["landmark"], INTRINSICS: arguments["intrinsics"]}
    )
    rows = np.arange(30)
    batch = FactorBatch.create(
        TWINS["static_reprojection"],
        tuple(Slot(variable, rows) for variable in (POSE, LANDMARK, INTRINSICS)),
        {"uv": arguments["uv"]},
        sigma=sigma,
        weight=weight,
        kernel=Kernel(kind, threshold),  # type: ignore[arg-type]
    )
    noise = dict(sigma=sigma, weight=weight, kernel=KERNELS.index(kind), threshold=threshold, threads=threads)
    white, scaled = _core.whiten(r, list(jacobians), **noise)
    expected_r, expected_jacobians = batch.linearize(state)
    assert_close(white, expected_r)
    for actual, expected in zip(scaled, expected_jacobians, strict=True):
        assert_close(actual, expected)
    assert _core.robust_energy(r, **noise) == pytest.approx(batch.energy(state), rel=1e-11, abs=1e-300)


def test_robust_energy_is_the_same_for_any_number_of_threads() -> None:
    rng = np.random.default_rng(3)
    r, sigma, weight = rng.normal(size=(30_001, 2)), rng.uniform(0.5, 2.0, 30_001), rng.uniform(size=30_001)
    energies = {
        _core.robust_energy(r, sigma=sigma, weight=weight, kernel=1, threshold=1.3, threads=threads)
        for threads in (1, 2, 3, 8)
    }
    assert len(energies) == 1
    white = np.linalg.norm(r, axis=1) / sigma
    rho = np.where(white <= 1.3, 0.5 * white**2, 1.3 * (white - 0.65))  # Huber
    assert energies.pop() == pytest.approx(weight @ rho, rel=1e-12)
