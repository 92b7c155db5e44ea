"""Covariances with a variable that is held at an uncertain value, against solves with other values of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solve_samples import bundle

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import se3_log
from uni4d_fg.optim.cluster_robust import Clusters
from uni4d_fg.optim.considered import Considered, considered_marginals
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.marginals import camera_marginals
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective

CONFIG = SolverConfig(max_iterations=60, relative_decrease=1e-12)
POSES, LANDMARKS = 4, 60


@pytest.mark.parametrize("clustered", [False, True])
def test_poses_follow_what_is_held(clustered: bool) -> None:
    problem, start = bundle(np.random.default_rng(2), num_poses=POSES, num_landmarks=LANDMARKS, depth=True)
    plain = tuple(replace(batch, kernel=Kernel()) for batch in problem.batches if batch.name != "intrinsics_prior")
    free = {variable: mask.copy() for variable, mask in problem.free.items()}
    free[POSE][0] = False
    problem = Problem(plain, free)
    held = Problem(plain, {v: np.zeros_like(m) if v == INTRINSICS else m for v, m in free.items()})
    state, _ = minimize(SchurObjective(held, start, CONFIG), start, CONFIG)
    sigma = np.array([3.0, 0.0, 0.0, 0.0])
    other = state.replace({INTRINSICS: state[INTRINSICS] + sigma})
    moved, _ = minimize(SchurObjective(held, other, CONFIG), other, CONFIG)
    step = se3_log(se3.inverse(state[POSE]) @ moved[POSE])
    clusters = Clusters(np.arange(LANDMARKS) % 20, 20) if clustered else None

    def covariance(of: np.ndarray) -> np.ndarray:
        found = considered_marginals(problem, state, CONFIG, clusters, LANDMARK, Considered(INTRINSICS, of))
        assert found is not None
        return found.blocks(POSE, POSES)

    exact = covariance(np.zeros((4, 4)))
    added = covariance(np.diag(sigma**2)) - exact
    np.testing.assert_allclose(added, step[:, :, None] * step[:, None, :], atol=0.05 * np.abs(step).max() ** 2)
    assert np.abs(step[1:]).max() > 1e-3
    if not clustered:
        given = camera_marginals(held, state, CONFIG)
        assert given is not None
        np.testing.assert_allclose(exact, given.blocks(POSE, POSES), rtol=1e-6, atol=1e-15)
