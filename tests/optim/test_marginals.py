"""Marginal covariances against dense algebra and against the spread of repeated estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from solve_samples import bundle, dense_jacobian, free_mask

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.marginals import camera_marginals
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective

CONFIG = SolverConfig(max_iterations=30, relative_decrease=1e-10)
DRAWS = 200


def held_first_pose(problem: Problem) -> Problem:
    free = {group: mask.copy() for group, mask in problem.free.items()}
    free[POSE][0] = False
    free[INTRINSICS][0, 2:] = False
    return replace(problem, free=free)


def test_covariance_is_the_inverse_of_the_whole_hessian(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, depth=True)
    problem = held_first_pose(problem)
    groups = [POSE, INTRINSICS, LOG_SCALE, LANDMARK]
    jacobian, _, _ = dense_jacobian(problem, state, groups)
    free = np.flatnonzero(free_mask(problem, state, groups))
    full = np.zeros((jacobian.shape[1],) * 2)
    full[np.ix_(free, free)] = np.linalg.inv(jacobian[:, free].T @ jacobian[:, free])
    marginals = camera_marginals(problem, state, CONFIG)
    assert marginals is not None
    poses = len(state[POSE])
    for i, block in enumerate(marginals.blocks(POSE, poses)):
        expected = full[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        np.testing.assert_allclose(block, expected, rtol=1e-7, atol=1e-9 * np.abs(full).max())
    intrinsics = full[6 * poses : 6 * poses + 4, 6 * poses : 6 * poses + 4]
    np.testing.assert_allclose(marginals.blocks(INTRINSICS, 1)[0], intrinsics, rtol=1e-7, atol=1e-12)
    assert (marginals.blocks(POSE, poses)[0] == 0.0).all()


def test_nothing_is_claimed_of_what_is_not_determined(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    reprojection = replace(problem, batches=problem.batches[:1])
    assert camera_marginals(reprojection, state, CONFIG) is None


def exact_measurements(problem: Problem, truth: State) -> dict[str, FloatArray]:
    """Return what every batch would measure without noise, by its name: residuals are measured minus predicted."""
    out = {}
    for batch in problem.batches:
        name = next(n for n in batch.data if n in ("uv", "depth", "measured"))
        r = batch.residual(truth)
        if name == "depth":
            out[batch.name] = batch.data[name] * np.exp(r[:, 0])
        else:
            out[batch.name] = batch.data[name] - r if name == "uv" else batch.data[name] + r
    return out


def draw(problem: Problem, exact: dict[str, FloatArray], rng: np.random.Generator) -> Problem:
    """Return the problem with new noise of exactly the batches' sigmas."""
    batches: list[FactorBatch] = []
    for batch in problem.batches:
        name = next(n for n in batch.data if n in ("uv", "depth", "measured"))
        value = exact[batch.name]
        noise = rng.standard_normal(value.shape) * (batch.sigma[:, None] if value.ndim == 2 else batch.sigma)
        measured = value * np.exp(noise) if name == "depth" else value + noise
        batches.append(replace(batch, data={**batch.data, name: measured}))
    return replace(problem, batches=tuple(batches))


def test_covariance_is_the_spread_of_repeated_estimates() -> None:
    """The sample variance of n normal draws has a relative deviation of sqrt(2 / (n - 1)): 0.100 for 200.

    A mean of squared Mahalanobis distances over n draws of d entries has the deviation sqrt(2 d / n). Both are
    held to four deviations, over 21 variances and 5 blocks, plus 2 % for what the linearization leaves out.
    """
    rng = np.random.default_rng(11)
    problem, state = bundle(rng, num_poses=4, num_landmarks=40, depth=True)
    problem = held_first_pose(problem)
    # Quadratic kernels: the covariance then is that of the noise, without reweighting.
    plain = tuple(replace(batch, kernel=type(batch.kernel)("quadratic")) for batch in problem.batches)
    problem = replace(problem, batches=plain)
    truth, _ = minimize(SchurObjective(problem, state, CONFIG), state, CONFIG)
    exact = exact_measurements(problem, truth)
    poses = len(truth[POSE])
    twists, focal = np.zeros((DRAWS, poses, 6)), np.zeros((DRAWS, 4))
    for i in range(DRAWS):
        noisy = draw(problem, exact, rng)
        found, summary = minimize(SchurObjective(noisy, truth, CONFIG), truth, CONFIG)
        assert summary.converged
        relative = se3.inverse(truth[POSE]) @ found[POSE]
        twists[i, :, :3], twists[i, :, 3:] = se3.so3_log(relative[:, :3, :3]), relative[:, :3, 3]
        focal[i] = found[INTRINSICS][0] - truth[INTRINSICS][0]
    marginals = camera_marginals(draw_free(problem, exact), truth, CONFIG)
    assert marginals is not None
    blocks = [(twists[:, t], marginals.blocks(POSE, poses)[t]) for t in range(1, poses)]
    blocks.append((focal[:, :2], marginals.blocks(INTRINSICS, 1)[0][:2, :2]))
    assert np.abs(twists[:, 0]).max() < 1e-12
    for samples, covariance in blocks:
        ratio = np.var(samples, axis=0, ddof=1) / np.diag(covariance)
        assert np.abs(ratio - 1.0).max() < 4.0 * np.sqrt(2.0 / (DRAWS - 1)) + 0.02
        distance = np.einsum("ni,ij,nj->n", samples, np.linalg.inv(covariance), samples)
        entries = samples.shape[1]
        assert abs(distance.mean() - entries) < 4.0 * np.sqrt(2.0 * entries / DRAWS) + 0.02 * entries


def draw_free(problem: Problem, exact: dict[str, FloatArray]) -> Problem:
    """Return the problem with exact measurements."""
    batches = []
    for batch in problem.batches:
        name = next(n for n in batch.data if n in ("uv", "depth", "measured"))
        batches.append(replace(batch, data={**batch.data, name: exact[batch.name]}))
    return replace(problem, batches=tuple(batches))
