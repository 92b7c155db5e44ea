"""GTSAM's own optimizers reach our minima, stage by stage, and behave as a stage's solver must."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from solve_samples import bundle, camera_path, pair_terms, trajectories

from uni4d_fg.config.load import load_config
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import ConfigError, SolverError
from uni4d_fg.factors import Kernel, factor
from uni4d_fg.factors.priors import intrinsics_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE, pose_variable
from uni4d_fg.geometry import se3
from uni4d_fg.optim.added_factors import Addition, with_additions
from uni4d_fg.optim.backend import Backend
from uni4d_fg.optim.gtsam_graph import gtsam_factors, to_gtsam
from uni4d_fg.optim.gtsam_optimizers import minimize_with_gtsam
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import LevenbergMarquardtRunner, Round, Stage
from uni4d_fg.optim.summary import SolveSummary, Termination

OPTIMIZERS = ("gtsam_levenberg_marquardt", "gtsam_dogleg")
every_optimizer = pytest.mark.parametrize("optimizer", OPTIMIZERS)
RUN = LevenbergMarquardtRunner(Backend("python"))
MAP = pose_variable("test_optimizer_map", "T", ("map",))
K = np.array([500.0, 505.0, 320.0, 240.0])


@factor(POSE, MAP, data={"map_T_cam": (4, 4)}, dim=3, name="test_optimizer_in_map")
def in_map(world_T_cam, map_T_world, *, map_T_cam):  # type: ignore[no-untyped-def]
    """Center of a camera in the axes of a map."""
    found = map_T_world @ world_T_cam
    return found[..., :3, 3] - map_T_cam[..., :3, 3]


def tight(optimizer: str = "levenberg_marquardt") -> SolverConfig:
    return SolverConfig(optimizer=optimizer, max_iterations=200, relative_decrease=1e-12)  # type: ignore[arg-type]


def camera_init(rng: np.random.Generator) -> tuple[Problem, State]:
    poses = se3.retract(camera_path(6), rng.normal(scale=0.01, size=(6, 6)))
    state = State({POSE: poses, INTRINSICS: K[None] * 1.01})
    problem = Problem.over(state).add(
        replace(pair_terms(rng, 6, 60, same=False), kernel=Kernel("huber", 1.5)),
        intrinsics_prior([0], measured=K[None], sigma=5.0),
    )
    return problem.fix(POSE, rows=[0, 1]).fix(INTRINSICS, entries=[1, 2, 3]), state


def bundle_adjustment(rng: np.random.Generator) -> tuple[Problem, State]:
    problem, state = bundle(rng, kernel=Kernel("huber", 1.5), outliers=6, depth=True)
    return problem.fix(POSE, rows=[0]).fix(INTRINSICS, entries=[2, 3]).fix(LANDMARK, rows=[2]), state


def nonrigid(rng: np.random.Generator) -> tuple[Problem, State]:
    return trajectories(rng, kernel=Kernel("huber", 1.5))


STAGES = {"camera_init": camera_init, "bundle_adjustment": bundle_adjustment, "nonrigid": nonrigid}


@every_optimizer
@pytest.mark.parametrize("kind", STAGES)
def test_the_minimum_is_ours(rng: np.random.Generator, kind: str, optimizer: str) -> None:
    problem, state = STAGES[kind](rng)
    ours, expected = RUN(Stage(kind, problem, tight()), state)
    found, summary = RUN(Stage(kind, problem, tight(optimizer)), state)
    assert expected.initial_energy > 1.5 * expected.final_energy
    assert summary.final_energy == pytest.approx(expected.final_energy, rel=1e-6)
    assert summary.initial_energies == pytest.approx(expected.initial_energies, rel=1e-12)
    assert problem.energies(found) == pytest.approx(summary.final_energies, rel=1e-12)
    for variable, array in found.arrays.items():
        np.testing.assert_allclose(array, ours[variable], atol=1e-2 if variable is INTRINSICS else 2e-5)
        frozen = ~problem.free[variable].any(axis=1) if variable in problem.free else np.ones(len(array), dtype=bool)
        np.testing.assert_array_equal(array[frozen], state[variable][frozen])
    if INTRINSICS in state:
        np.testing.assert_array_equal(found[INTRINSICS][:, 2:], state[INTRINSICS][:, 2:])
    energies = [record.energy for record in summary.iterations]
    assert (np.diff(energies) < 0).all()
    assert energies[-1] == pytest.approx(summary.final_energy, rel=1e-6)
    assert summary.converged
    (part,) = summary.notes["solved_by"]
    assert part["by"].startswith("GTSAM ")
    assert set(part["terms"]) == set(summary.final_energies)


@every_optimizer
def test_rounds_follow_each_other(rng: np.random.Generator, optimizer: str) -> None:
    problem, state = nonrigid(rng)
    name = problem.batches[0].name
    schedules = ((Round(weight={name: 0.01}), Round()), (Round(),))
    stage = Stage("nonrigid", problem, tight(optimizer), schedules=schedules)
    found, summary = RUN(stage, state)
    assert len(summary.notes["schedule_energies"]) == 2
    _, expected = RUN(replace(stage, solver=tight()), state)
    assert summary.final_energy == pytest.approx(expected.final_energy, rel=1e-6)
    assert min(summary.notes["schedule_energies"]) == pytest.approx(problem.energy(found), rel=1e-9)
    seconds = [record.seconds for record in summary.iterations]
    assert (np.diff(seconds) > 0).all()


@every_optimizer
def test_a_solve_is_cancelled_between_two_iterations(rng: np.random.Generator, optimizer: str) -> None:
    problem, state = bundle_adjustment(rng)
    seen: list[tuple[str, int, float]] = []
    states: list[State] = []
    hooks = Hooks(
        on_iteration=lambda *found: seen.append(found), should_stop=lambda: len(seen) == 2, on_state=states.append
    )
    found, summary = RUN(Stage("bundle_adjustment", problem, tight(optimizer)), state, hooks)
    assert summary.termination is Termination.CANCELLED
    assert [number for _, number, _ in seen] == [1, 2]
    assert len(summary.iterations) == 2
    assert summary.final_energy < summary.initial_energy
    np.testing.assert_array_equal(found[POSE], states[-1][POSE])


@every_optimizer
def test_the_limits_of_the_configuration_hold(rng: np.random.Generator, optimizer: str) -> None:
    problem, state = bundle_adjustment(rng)

    def solved(**changes: float) -> SolveSummary:
        config = tight(optimizer).model_copy(update=changes)
        return minimize_with_gtsam(problem, state, config)[1]

    short = solved(max_iterations=2)
    assert (len(short.iterations), short.termination) == (2, Termination.MAX_ITERATIONS)
    loose, full = solved(relative_decrease=0.1), solved()
    assert loose.termination is Termination.RELATIVE_DECREASE
    assert len(loose.iterations) < len(full.iterations)


@every_optimizer
def test_added_factors_and_variables_join(rng: np.random.Generator, optimizer: str) -> None:
    problem, state = bundle_adjustment(rng)
    moved = se3.se3_exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])[None])
    rows = np.arange(5)

    def source(stage: Stage, state: State) -> Addition:
        between = gtsam.BetweenFactorPose3(
            POSE.key(3), POSE.key(4), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
        )
        positions = in_map(rows, 0, map_T_cam=moved @ camera_path(5), sigma=0.01)
        return Addition([positions, between], {MAP: np.eye(4)[None]})

    ends = [
        with_additions(RUN, [source])(Stage("bundle_adjustment", problem, tight(o)), state, None)
        for o in ("levenberg_marquardt", optimizer)
    ]
    assert ends[1][1].final_energy == pytest.approx(ends[0][1].final_energy, rel=1e-6)
    assert {"test_optimizer_in_map", "BetweenFactorPose3"} <= set(ends[1][1].final_energies)
    np.testing.assert_allclose(ends[1][0][POSE], ends[0][0][POSE], atol=2e-5)


def test_a_point_behind_its_camera_is_not_free_of_cost(rng: np.random.Generator) -> None:
    """GTSAM's own projection factor leaves it there; the energy that counts has a price for it."""
    problem, state = bundle(rng)
    reprojection = problem.batches[0]
    kept = (reprojection.slots[1].rows != 4) | (reprojection.slots[0].rows == 2)
    problem = replace(problem, batches=(reprojection.take(np.flatnonzero(kept)), *problem.batches[1:]))
    landmarks, measured = state[LANDMARK].copy(), problem.batches[1].data["measured"].copy()
    landmarks[4, 2] = measured[4, 2] = -1.0
    priors = replace(problem.batches[1], data={"measured": measured})
    problem = replace(problem, batches=(problem.batches[0], priors, problem.batches[2]))
    behind = state.replace({LANDMARK: landmarks})
    assert to_gtsam(problem, behind)[0].error(behind.to_values()) < 1e-3 * problem.energy(behind)
    config = tight("gtsam_levenberg_marquardt").model_copy(update={"max_iterations": 20})
    found, summary = RUN(Stage("bundle_adjustment", problem, config), behind)
    assert "behind a camera" in summary.notes["gtsam_factors"]
    assert summary.final_energy == pytest.approx(problem.energy(found), rel=1e-12)
    assert summary.final_energy < 1e-3 * summary.initial_energy


def test_what_cannot_be_solved_says_so(rng: np.random.Generator) -> None:
    problem, state = bundle_adjustment(rng)
    with pytest.raises(ConfigError, match=r"bundle_adjustment\.solver\.optimizer: got \"gtsam\".*gtsam_dogleg"):
        load_config("default", ["bundle_adjustment.solver.optimizer=gtsam"])
    with pytest.raises(SolverError, match="not one of GTSAM's"):
        minimize_with_gtsam(problem, state, SolverConfig())
    uv = problem.batches[0].data["uv"].copy()
    uv[7] = np.nan
    broken = replace(problem, batches=(replace(problem.batches[0], data={"uv": uv}), *problem.batches[1:]))
    with pytest.raises(SolverError, match="the starting energy of static_reprojection is not finite"):
        minimize_with_gtsam(broken, state, tight("gtsam_dogleg"))


@pytest.mark.parametrize("make", [bundle_adjustment, camera_init], ids=["landmarks", "pairs"])
def test_rows_evaluated_together_are_those_evaluated_alone(
    rng: np.random.Generator, make: Callable[[np.random.Generator], tuple[Problem, State]]
) -> None:
    problem, state = make(rng)
    batch = problem.batches[0]
    factors = list(gtsam_factors(batch, state, native=False))
    points = [state] + [
        state.retract({v: rng.normal(scale=1e-2, size=(len(state[v]), v.dim)) for v in state.arrays}) for _ in range(2)
    ]
    values = [point.to_values() for point in points]
    # Any factor at any values in any order, errors and Jacobians mixed; the same factor many times over.
    calls = [(int(rng.integers(len(factors))), int(rng.integers(3)), bool(rng.integers(2))) for _ in range(60)]
    for i, at, linear in calls + [(3, n % 3, True) for n in range(40)] + [(n, 1, True) for n in range(len(factors))]:
        (fresh,) = [f for n, f in enumerate(gtsam_factors(batch, state, native=False)) if n == i]
        if linear:
            found, expected = (f.linearize(values[at]).jacobian() for f in (factors[i], fresh))
            np.testing.assert_array_equal(found[0], expected[0])
            np.testing.assert_array_equal(found[1], expected[1])
        else:
            assert factors[i].error(values[at]) == fresh.error(values[at])
