"""Normal equations of frame pairs against those of the batch."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from uni4d_fg_cpp import _core

from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.depth_reprojection import depth_reprojection
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, POSE
from uni4d_fg.geometry import se3

KERNELS = ("quadratic", "huber", "pseudo_huber", "cauchy", "norm")
NUM_POSES = 5


def make_batch(rng: np.random.Generator, count: int, kind: str, shuffled: bool) -> tuple[FactorBatch, State]:
    pair = np.sort(rng.integers(0, NUM_POSES * (NUM_POSES - 1), count))
    if shuffled:
        rng.shuffle(pair)
    source, other = np.divmod(pair, NUM_POSES - 1)
    target = other + (other >= source)
    state = State(
        {
            POSE: se3.se3_exp(rng.normal(size=(NUM_POSES, 6)) * 0.15),
            INTRINSICS: np.array([[510.0, 490.0, 320.0, 240.0]]),
        }
    )
    uv = rng.uniform(0, 600, (count, 2))
    batch = FactorBatch.create(
        depth_reprojection,
        (Slot(POSE, source), Slot(POSE, target), Slot(INTRINSICS, np.zeros(count, dtype=np.int64))),
        {"uv_source": uv, "depth": rng.uniform(0.3, 6, count), "uv_target": uv + rng.normal(size=(count, 2)) * 40},
        sigma=rng.uniform(0.5, 30, (count, 2) if count % 2 else count),
        weight=rng.uniform(0, 2, count),
        kernel=Kernel(kind, 1.7),  # type: ignore[arg-type]
    )
    return batch, state


def system_of(batch: FactorBatch, columns: np.ndarray, threads: int) -> _core.PairSystem:
    return _core.PairSystem(
        source=batch.slots[0].rows,
        target=batch.slots[1].rows,
        uv_source=batch.data["uv_source"],
        depth=batch.data["depth"],
        uv_target=batch.data["uv_target"],
        sigma=batch.sigma,
        weight=batch.weight,
        kernel=KERNELS.index(batch.kernel.kind),
        threshold=batch.kernel.threshold,
        pose_columns=np.ascontiguousarray(columns[:-4].reshape(-1, 6)),
        intrinsics_columns=np.ascontiguousarray(columns[-4:]),
        size=int(columns.max()) + 1,
        threads=threads,
    )


def dense(batch: FactorBatch, state: State, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r, jacobians = batch.linearize(state)
    size = int(columns.max()) + 1
    full = np.zeros((*r.shape, NUM_POSES * 6 + 4))
    rows = np.arange(len(batch))
    for slot, jacobian in zip(batch.slots, jacobians, strict=True):
        start = 6 * NUM_POSES if slot.variable is INTRINSICS else 6 * slot.rows
        for i in range(jacobian.shape[2]):
            full[rows, :, start + i] += jacobian[:, :, i]
    free = np.flatnonzero(columns >= 0)
    a = np.zeros((*r.shape, size))
    a[:, :, columns[free]] = full[:, :, free]
    a, b = a.reshape(-1, size), r.reshape(-1)
    return a.T @ a, a.T @ b


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 600),
    kind=st.sampled_from(KERNELS),
    shuffled=st.booleans(),
    threads=st.integers(0, 3),
)
def test_energy_hessian_and_gradient(seed: int, count: int, kind: str, shuffled: bool, threads: int) -> None:
    rng = np.random.default_rng(seed)
    batch, state = make_batch(rng, count, kind, shuffled)
    free = rng.random(NUM_POSES * 6 + 4) > 0.3
    free[rng.integers(0, len(free))] = True
    columns = np.full(len(free), -1)
    columns[free] = np.arange(free.sum())
    system = system_of(batch, columns, threads)
    poses, intrinsics = state[POSE], state[INTRINSICS][0]
    assert system.energy(poses, intrinsics) == pytest.approx(batch.energy(state), rel=1e-11)
    hessian, gradient = system.linearize(poses, intrinsics)
    expected_hessian, expected_gradient = dense(batch, state, columns)
    scale = np.sqrt(np.maximum(np.diag(expected_hessian), 1e-12))
    np.testing.assert_array_less(np.abs(hessian - expected_hessian) / np.outer(scale, scale), 1e-10)
    residual_norm = np.linalg.norm(batch.linearize(state)[0])
    np.testing.assert_array_less(np.abs(gradient - expected_gradient) / scale, 1e-10 * (1.0 + residual_norm))


def test_same_result_on_every_call_and_for_any_number_of_threads() -> None:
    batch, state = make_batch(np.random.default_rng(0), 60001, "huber", False)
    columns = np.arange(NUM_POSES * 6 + 4)
    poses, intrinsics = state[POSE], state[INTRINSICS][0]
    one = system_of(batch, columns, 1)
    reference = one.linearize(poses, intrinsics)
    for threads in (1, 2, 3):
        system = system_of(batch, columns, threads)
        for _ in range(2):
            for found, expected in zip(system.linearize(poses, intrinsics), reference, strict=True):
                np.testing.assert_array_equal(found, expected)
        assert system.energy(poses, intrinsics) == one.energy(poses, intrinsics)
