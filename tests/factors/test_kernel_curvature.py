"""J^T J with the curvature of robust kernels: against the slope of the gradient, and that it stays a model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors import FactorBatch, Kernel, Slot
from uni4d_fg.factors.state import State
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness
from uni4d_fg.factors.variable_types import DYNAMIC_POINT

COUNT = 12
KINDS = ("quadratic", "huber", "pseudo_huber", "cauchy", "norm")
seeds = st.integers(0, 10**6)


def smoothness(seed: int, kernel: Kernel, spread: float = 1.0) -> tuple[FactorBatch, State]:
    """Second differences, which are linear in the points: all that is not linear is the kernel."""
    rng = np.random.default_rng(seed)
    batch = FactorBatch.create(
        acceleration_smoothness,
        tuple(Slot(DYNAMIC_POINT, np.arange(i, COUNT - 2 + i)) for i in range(3)),
        sigma=rng.uniform(0.5, 2.0, (COUNT - 2, 3)),
        weight=rng.uniform(0.0, 2.0, COUNT - 2),
        kernel=kernel,
    )
    return batch, State({DYNAMIC_POINT: spread * rng.normal(size=(COUNT, 3))})


def normal_equations(batch: FactorBatch, state: State, kernel_curvature: float) -> tuple[FloatArray, FloatArray]:
    """Return J^T J and J^T r, dense."""
    r, jacobians = batch.linearize(state, kernel_curvature)
    full = np.zeros((len(batch), 3, 3 * COUNT))
    for slot, jacobian in zip(batch.slots, jacobians, strict=True):
        for n, row in enumerate(slot.rows.tolist()):
            full[n, :, 3 * row : 3 * row + 3] += jacobian[n]
    full = full.reshape(-1, 3 * COUNT)
    return full.T @ full, full.T @ r.reshape(-1)


@given(seed=seeds, kind=st.sampled_from(KINDS), part=st.floats(0.05, 0.95))
def test_it_is_that_part_of_the_way_to_the_hessian(seed: int, kind: str, part: float) -> None:
    # Cauchy's curvature is negative beyond its threshold, where it is cut off: stay below.
    kernel = Kernel(kind, 40.0 if kind == "cauchy" else 1.3)  # type: ignore[arg-type]
    batch, state = smoothness(seed, kernel)
    squared = batch.squared_norm(state)
    if kind == "huber" and np.min(np.abs(np.sqrt(squared) - 1.3)) < 1e-3:
        return  # the Hessian jumps at the threshold
    direction = np.random.default_rng(seed + 1).normal(size=(COUNT, 3))
    step = 1e-5 / np.abs(direction).max()
    ahead, back = (state.replace({DYNAMIC_POINT: state[DYNAMIC_POINT] + s * direction}) for s in (step, -step))
    slope = (normal_equations(batch, ahead, 0.0)[1] - normal_equations(batch, back, 0.0)[1]) / (2.0 * step)
    reweighted, gradient = normal_equations(batch, state, 0.0)
    model, same = normal_equations(batch, state, part)
    plain = reweighted @ direction.reshape(-1)
    expected = plain + part * (slope - plain)
    np.testing.assert_allclose(model @ direction.reshape(-1), expected, atol=1e-6 * np.abs(plain).max())
    np.testing.assert_allclose(same, gradient, rtol=1e-10, atol=1e-12 * np.abs(gradient).max())


@given(seed=seeds, kind=st.sampled_from(KINDS), part=st.floats(0.0, 0.999), spread=st.sampled_from([1e-6, 1.0, 1e6]))
def test_it_is_never_more_than_reweighting_nor_negative(seed: int, kind: str, part: float, spread: float) -> None:
    batch, state = smoothness(seed, Kernel(kind, 0.7), spread)  # type: ignore[arg-type]
    model, _ = normal_equations(batch, state, part)
    reweighted, _ = normal_equations(batch, state, 0.0)
    scale = np.abs(reweighted).max()
    assert np.linalg.eigvalsh(model).min() >= -1e-12 * scale
    assert np.linalg.eigvalsh(reweighted - model).min() >= -1e-12 * scale


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_of_zero_have_the_curvature_of_the_weight(kind: str) -> None:
    batch, state = smoothness(0, Kernel(kind, 0.7), 0.0)  # type: ignore[arg-type]
    model, gradient = normal_equations(batch, state, 0.9)
    np.testing.assert_allclose(model, normal_equations(batch, state, 0.0)[0], rtol=1e-14)
    np.testing.assert_array_equal(gradient, 0.0)
