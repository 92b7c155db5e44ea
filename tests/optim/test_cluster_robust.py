"""Covariances with clusters against the spread of repeated estimates, when errors are alike and when they are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solve_samples import bundle

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim import cluster_robust
from uni4d_fg.optim.cluster_robust import Clusters, Spread, clustered_marginals, gradient_spread, image_cells
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.marginalization import marginalize_with_spread
from uni4d_fg.optim.marginals import camera_marginals
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective
from uni4d_fg.results.evaluate.consistency import nees

CONFIG = SolverConfig(max_iterations=30, relative_decrease=1e-9)
POSES, LANDMARKS, CLUSTERS, DRAWS = 5, 120, 30, 40


def problem_of(rng: np.random.Generator) -> tuple[Problem, State]:
    """A bundle with quadratic kernels, the first pose and the principal point held, at its minimum."""
    problem, state = bundle(rng, num_poses=POSES, num_landmarks=LANDMARKS, depth=True)
    free = {group: mask.copy() for group, mask in problem.free.items()}
    free[POSE][0] = False
    free[INTRINSICS][0, 2:] = False
    # Landmarks that are nearly known: the poses then err as the pixels do.
    plain = tuple(
        replace(batch, kernel=Kernel(), sigma=0.04 * batch.sigma if batch.name == "landmark_prior" else batch.sigma)
        for batch in problem.batches
    )
    problem = Problem(plain, free)
    state, _ = minimize(SchurObjective(problem, state, CONFIG), state, CONFIG)
    return problem, state


def with_reprojection_errors(problem: Problem, truth: State, errors: FloatArray) -> Problem:
    """Return the problem with pixels that are exact but for ``errors`` (N, 2), in sigmas, and other data exact."""
    batches = []
    for batch in problem.batches:
        name = next(n for n in batch.data if n in ("uv", "depth", "measured"))
        r, value = batch.residual(truth), batch.data[name]
        if name == "uv":
            value = value - r + batch.sigma[:, None] * errors
        elif name == "depth":
            value = value * np.exp(r[:, 0])
        else:
            value = value + r
        batches.append(replace(batch, data={**batch.data, name: value}))
    return replace(problem, batches=tuple(batches))


def twists(found: State, truth: State) -> FloatArray:
    relative = se3.inverse(truth[POSE][1:]) @ found[POSE][1:]
    return np.concatenate([se3.so3_log(relative[:, :3, :3]), relative[:, :3, 3]], axis=1)


@pytest.mark.parametrize("alike", [False, True])
def test_covariance_is_the_spread_of_repeated_estimates(alike: bool) -> None:
    """Errors are white, or a random walk along time that the four tracks of a cluster share.

    A variance from 40 draws deviates by sqrt(2 / 39), 23 %; the mean of 24 of them, correlated, is known to 30 %. What
    holds jointly, in spite of few clusters, is on average larger.
    """
    rng = np.random.default_rng(5)
    problem, truth = problem_of(rng)
    reprojection = next(batch for batch in problem.batches if "uv" in batch.data)
    frame = next(s.rows for s in reprojection.slots if s.variable == POSE)
    landmark = next(s.rows for s in reprojection.slots if s.variable == LANDMARK)
    clusters = Clusters(np.arange(LANDMARKS) % CLUSTERS, CLUSTERS)
    samples, claimed, independent = [], [], []
    normalized: list[float] = []
    for _ in range(DRAWS):
        if alike:
            walk = np.cumsum(rng.standard_normal((CLUSTERS, POSES, 2)), axis=1)
            errors = walk[clusters.of_landmark[landmark], frame]
        else:
            errors = rng.standard_normal((len(frame), 2))
        noisy = with_reprojection_errors(problem, truth, errors)
        found, summary = minimize(SchurObjective(noisy, truth, CONFIG), truth, CONFIG)
        assert summary.converged
        samples.append(twists(found, truth))
        for marginals, out in (
            (clustered_marginals(noisy, found, CONFIG, clusters), claimed),
            (camera_marginals(noisy, found, CONFIG), independent),
        ):
            assert marginals is not None
            out.append(np.einsum("nii->ni", marginals.blocks(POSE, POSES)[1:]))
            if out is claimed:
                normalized.append(float(nees(samples[-1], marginals.blocks(POSE, POSES)[1:]).mean()) / 6.0)
    variance = np.mean(np.square(samples), axis=0)
    ratio = float(np.mean(np.mean(claimed, axis=0) / variance))
    assert 0.7 < ratio < (1.8 if alike else 1.3)
    assert 0.67 < float(np.mean(normalized)) < 1.4
    if alike:
        assert float(np.mean(np.mean(independent, axis=0) / variance)) < 0.7


def test_few_clusters_count_as_independent(rng: np.random.Generator) -> None:
    problem, state = problem_of(rng)
    found = clustered_marginals(problem, state, CONFIG, Clusters(np.arange(LANDMARKS) % 5, 5))
    plain = camera_marginals(problem, state, CONFIG)
    assert found is not None
    assert plain is not None
    np.testing.assert_allclose(found.covariance, plain.covariance)


def test_a_prior_carries_its_spread(rng: np.random.Generator) -> None:
    problem, state = problem_of(rng)
    clusters = Clusters(np.arange(LANDMARKS) % CLUSTERS, CLUSTERS)
    whole = camera_marginals(problem, state, CONFIG)
    assert whole is not None
    spread = gradient_spread(problem.batches, state, whole.layout, clusters, LANDMARK)
    whole = replace(whole, covariance=whole.covariance @ spread.covariance() @ whole.covariance)
    free = {group: mask for group, mask in problem.free.items() if group != LANDMARK}
    leaving = {POSE: np.arange(POSES) < 2, LOG_SCALE: np.arange(POSES) < 2}
    found = marginalize_with_spread(problem.batches, state, free, leaving, CONFIG, clusters=clusters)
    assert found is not None
    prior, left = found
    assert left is not None
    stays = {group: mask & ~leaving.get(group, np.zeros(len(mask), bool))[:, None] for group, mask in free.items()}
    rest = Problem((prior,), stays)
    bread = camera_marginals(rest, state, CONFIG, None)
    assert bread is not None
    carried = gradient_spread(rest.batches, state, bread.layout, clusters, LANDMARK, left)
    covariance = bread.covariance @ carried.covariance() @ bread.covariance
    blocks = replace(bread, covariance=covariance).blocks(POSE, POSES)
    np.testing.assert_allclose(blocks[2:], whole.blocks(POSE, POSES)[2:], rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("kind", ["quadratic", "huber", "pseudo_huber", "cauchy", "norm"])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_slope_of_a_kernel_is_the_mean_derivative_of_its_pull(
    rng: np.random.Generator, kind: str, dim: int
) -> None:
    kernel, step = Kernel(kind, 0.7), 1e-6  # type: ignore[arg-type]

    def pull(r: FloatArray) -> FloatArray:
        return kernel.weight(np.atleast_1d(r @ r))[0] * r

    for _ in range(5):
        r = rng.normal(size=dim)
        sides = np.eye(dim)
        ends = [(pull(r + step * e) - pull(r - step * e)) @ e / (2.0 * step) for e in sides]
        assert kernel.slope(np.atleast_1d(r @ r), dim)[0] == pytest.approx(np.mean(ends), abs=1e-6)


def test_cells_tile_the_image() -> None:
    uv = np.array([[0.0, 0.0], [79.0, 79.0], [81.0, 0.0], [0.0, 81.0], [639.0, 479.0], [-5.0, 900.0]])
    cells = image_cells(uv, np.array([500.0, 500.0, 319.5, 239.5]), 8)
    np.testing.assert_array_equal(cells, [0, 0, 8, 1, 7 * 8 + 6 - 1, 7])


def test_held_landmarks_are_constants_whose_errors_a_cluster_shares() -> None:
    """One camera before known points: about three neighbors share their error, so that it does not cancel."""
    rng = np.random.default_rng(11)
    problem, truth = problem_of(rng)
    batches = []
    for batch in problem.batches:
        if "uv" in batch.data:
            pose = next(s.rows for s in batch.slots if s.variable == POSE)
            batches.append(batch.take(np.flatnonzero(pose == 1)))
    only = np.zeros((POSES, 6), dtype=bool)
    only[1] = True
    problem = Problem(tuple(batches), {POSE: only})
    (reprojection,) = problem.batches
    landmark = next(s.rows for s in reprojection.slots if s.variable == LANDMARK)
    # Strips of the image: what neighbors share does not cancel.
    of_landmark = np.zeros(LANDMARKS, dtype=np.int64)
    of_landmark[landmark[np.argsort(reprojection.data["uv"][:, 0])]] = (
        np.arange(len(landmark)) * CLUSTERS // len(landmark)
    )
    clusters = Clusters(of_landmark, CLUSTERS)
    samples, claimed, independent = [], [], []
    normalized: list[float] = []
    for _ in range(DRAWS):
        errors = rng.standard_normal((CLUSTERS, 2))[of_landmark[landmark]]
        noisy = with_reprojection_errors(problem, truth, errors)
        objective = SchurObjective(noisy, truth, CONFIG, None)
        found, summary = minimize(objective, truth, CONFIG)
        assert summary.converged
        samples.append(twists(found, truth)[0])
        for marginals, out in (
            (clustered_marginals(noisy, found, CONFIG, clusters), claimed),
            (camera_marginals(noisy, found, CONFIG, None), independent),
        ):
            assert marginals is not None
            out.append(np.diag(marginals.blocks(POSE, POSES)[1]))
            if out is claimed:
                normalized.append(float(nees(samples[-1][None], marginals.blocks(POSE, POSES)[1:2])[0]) / 6.0)
    variance = np.mean(np.square(samples), axis=0)
    assert 0.7 < float(np.mean(np.mean(claimed, axis=0) / variance)) < 1.6
    assert 0.67 < float(np.mean(normalized)) < 1.4
    roll_and_depth = [2, 5]
    assert float(np.mean((np.mean(independent, axis=0) / variance)[roll_and_depth])) < 0.6


@pytest.mark.parametrize("held", [False, True])
def test_factors_in_parts_give_the_spread_of_all_at_once(monkeypatch: pytest.MonkeyPatch, held: bool) -> None:
    problem, state = bundle(np.random.default_rng(3), num_poses=POSES, num_landmarks=LANDMARKS, depth=True)
    marginals = camera_marginals(problem, state, CONFIG, LANDMARK)
    assert marginals is not None
    clusters = Clusters(np.arange(LANDMARKS) % CLUSTERS, CLUSTERS)

    def spread() -> Spread:
        return gradient_spread(problem.batches, state, marginals.layout, clusters, LANDMARK, held=held)

    at_once = spread()
    assert max(len(batch) for batch in problem.batches) > 7 * 5
    monkeypatch.setattr(cluster_robust, "_PART_ROWS", 7)
    in_parts = spread()
    size = np.abs(at_once.scores).max()
    assert size > 0
    np.testing.assert_allclose(in_parts.scores, at_once.scores, rtol=0, atol=1e-11 * size)
    np.testing.assert_array_equal(in_parts.rest, at_once.rest)
