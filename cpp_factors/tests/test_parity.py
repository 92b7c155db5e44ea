"""Batch kernels against the NumPy implementation: random states, singular points, behind the camera."""

from __future__ import annotations

import numpy as np
import pytest
from families import FAMILIES, arguments_of, split_arguments
from hypothesis import given, settings
from hypothesis import strategies as st
from uni4d_fg_cpp import _core

from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import NEAR_PLANE
from uni4d_fg.graph.state import State

KERNELS = ("quadratic", "huber", "pseudo_huber", "cauchy", "norm")
TOLERANCE = 1e-10


def assert_close(actual: np.ndarray, expected: np.ndarray) -> None:
    """Relative to the row's largest entry: small entries of a row may be differences of large ones."""
    assert actual.shape == expected.shape
    axes = tuple(range(1, expected.ndim))
    scale = np.maximum(np.abs(expected).max(axis=axes, keepdims=True, initial=0.0), 1e-3)
    np.testing.assert_array_less(np.abs(actual - expected) / scale, TOLERANCE)


def check(name: str, arguments: dict[str, np.ndarray], threads: int = 1) -> None:
    variables, data = split_arguments(name, arguments)
    family = FAMILIES[name]
    expected_r, expected_jacobians = family.linearize(*variables, **data)
    r = getattr(_core, f"{name}_residual")(*variables, **data, threads=threads)
    assert_close(r, np.asarray(family.residual(*variables, **data)))
    r, jacobians = getattr(_core, f"{name}_linearize")(*variables, **data, threads=threads)
    assert_close(r, expected_r)
    assert len(jacobians) == len(expected_jacobians)
    for actual, expected in zip(jacobians, expected_jacobians, strict=True):
        assert_close(actual, np.asarray(expected))


@pytest.mark.parametrize("name", FAMILIES)
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 40), threads=st.integers(0, 3))
def test_random_states(name: str, seed: int, count: int, threads: int) -> None:
    check(name, arguments_of(name, np.random.default_rng(seed), count), threads)


@pytest.mark.parametrize("name", FAMILIES)
def test_many_rows_on_several_threads_equal_one_thread(name: str) -> None:
    variables, data = split_arguments(name, arguments_of(name, np.random.default_rng(1), 9001))
    linearize = getattr(_core, f"{name}_linearize")
    r, jacobians = linearize(*variables, **data, threads=1)
    r_many, jacobians_many = linearize(*variables, **data, threads=4)
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
    r, jacobians = FAMILIES["static_reprojection"].linearize(*split_arguments("static_reprojection", arguments)[0],
                                                             uv=arguments["uv"])  # fmt: skip
    sigma = 10.0 ** rng.uniform(-1, 1, (30, 2) if per_component else 30) * 10.0**-log_scale
    weight = rng.uniform(0, 2, 30) * (rng.random(30) > 0.2)
    state = State(
        {"pose": arguments["world_T_cam"], "landmark": arguments["landmark"], "intrinsics": arguments["intrinsics"]}
    )
    rows = np.arange(30)
    batch = FactorBatch.create(
        FAMILIES["static_reprojection"],
        tuple(Slot(group, rows) for group in ("pose", "landmark", "intrinsics")),
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
