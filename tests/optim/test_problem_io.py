"""A solved stage in a file, and as GTSAM's values: nothing is lost, and what is damaged is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from solve_samples import LANDMARK_PRIOR, bundle

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import InputError
from uni4d_fg.factors import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.optim.problem_io import load_stage_graph, save_stage_graph
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.stage_graph import RecordingRunner, StageGraph


@pytest.fixture
def solved(rng: np.random.Generator) -> StageGraph:
    problem, state = bundle(rng, kernel=Kernel("cauchy", 2.0), outliers=6, depth=True)
    odometry = gtsam.BetweenFactorPose3(
        POSE.key(0), POSE.key(2), gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 0.3))
    )
    # Priors on landmarks are a type of the samples' own, which a file does not hold.
    problem.batches = tuple(batch for batch in problem.batches if batch.factor_type is not LANDMARK_PRIOR)
    problem.eliminate(LANDMARK).add(odometry, state=state).fix(POSE, rows=[0]).fix(INTRINSICS, entries=[2, 3])
    runner = RecordingRunner(run_stage)
    runner(Stage("bundle_adjustment", problem, SolverConfig(max_iterations=5)), state)
    return runner.solved["bundle_adjustment"]


def stored(solved: StageGraph, tmp_path: Path) -> StageGraph:
    path = tmp_path / "graphs" / "bundle_adjustment.graph.npz"
    save_stage_graph(path, solved)
    return load_stage_graph(path)


def test_a_stage_comes_back_as_it_was(solved: StageGraph, tmp_path: Path) -> None:
    back = stored(solved, tmp_path)
    assert back.kind == "bundle_adjustment"
    assert back.problem.eliminated is solved.problem.eliminated is LANDMARK
    for ours, theirs in ((solved.initial_state, back.initial_state), (solved.final_state, back.final_state)):
        for variable, array in ours.arrays.items():
            np.testing.assert_array_equal(theirs[variable], array)
            np.testing.assert_array_equal(theirs.numbers(variable), ours.numbers(variable))
        assert back.problem.energies(theirs) == pytest.approx(solved.problem.energies(ours), rel=1e-14)
    for variable, free in solved.problem.free.items():
        np.testing.assert_array_equal(back.problem.free[variable], free)
    assert back.graph.error(back.final) == pytest.approx(solved.problem.energy(solved.final_state), rel=1e-9)


def test_the_values_are_gtsams_own(solved: StageGraph, tmp_path: Path) -> None:
    for name, text in solved.values_text():
        (tmp_path / name).write_text(text)
    values = gtsam.Values()
    values.deserialize((tmp_path / "bundle_adjustment.final.values").read_text())
    assert values.size() == solved.num_variables
    state: State = solved.final_state
    np.testing.assert_allclose(values.atPose3(POSE.key(2)).matrix(), state[POSE][2], atol=1e-12)
    np.testing.assert_allclose(values.atPoint3(state.keys(LANDMARK)[3]), state[LANDMARK][3], atol=1e-12)


def test_what_is_no_stage_is_refused(solved: StageGraph, tmp_path: Path) -> None:
    path = tmp_path / "x.graph.npz"
    save_stage_graph(path, solved)
    with np.load(path) as archive:
        arrays = dict(archive)
    unknown = str(arrays["header"]).replace("static_reprojection", "not_declared")
    np.savez(path, **{**arrays, "header": np.array(unknown)})
    with pytest.raises(InputError, match=r"factors of type 'not_declared', which is not declared; import its module"):
        load_stage_graph(path)
    del arrays["rows_0_1"]
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=r"x\.graph\.npz: not a solved stage of this version"):
        load_stage_graph(path)


def test_the_graph_command(solved: StageGraph, tmp_path: Path, cli: Callable[..., tuple[int, str, str]]) -> None:
    stored(solved, tmp_path)
    code, out, _ = cli("graph", tmp_path, "--json")
    assert code == 0
    (summary,) = json.loads(out)
    observations = len(solved.problem.batches[0])
    assert summary["terms"]["static_reprojection"]["residuals"] == 2 * observations
    assert summary["terms"]["BetweenFactorPose3"]["factors"] == 1
    residuals = sum(len(batch) * batch.factor_type.dim for batch in solved.problem.batches)
    free = sum(int(mask.sum()) for mask in solved.problem.free.values())
    assert summary["degrees_of_freedom"] == residuals - free
    energies = {name: term["final_energy"] for name, term in summary["terms"].items()}
    assert energies == pytest.approx(solved.problem.energies(solved.final_state), rel=1e-12)
    dot, g2o = tmp_path / "x.dot", tmp_path / "x.g2o"
    code, out, _ = cli("graph", tmp_path, "--stage", "bundle_adjustment", "--dot", dot, "--g2o", g2o, "--worst", 2)
    assert code == 0
    assert out.count("sigma  ") == 2
    assert dot.read_text().startswith("graph {")
    graph, values = gtsam.readG2o(str(g2o), True)
    assert (graph.size(), values.size()) == (len(solved.final_state[POSE]) - 1, len(solved.final_state[POSE]))
    np.testing.assert_allclose(values.atPose3(2).matrix(), solved.final_state[POSE][2], atol=1e-5)
    code, _, err = cli("graph", tmp_path, "--stage", "nonrigid")
    assert (code != 0, "the run has bundle_adjustment" in err) == (True, True)


def test_factors_that_a_file_cannot_hold_are_named(
    solved: StageGraph, rng: np.random.Generator, tmp_path: Path, cli: Callable[..., tuple[int, str, str]]
) -> None:
    problem, _ = bundle(rng)
    prior = next(batch for batch in problem.batches if batch.factor_type is LANDMARK_PRIOR)
    solved.problem.add(prior)
    back = stored(solved, tmp_path)
    assert back.left_out == {prior.name: len(prior)}
    assert prior.name not in back.problem.energies(back.final_state)
    assert f"{len(prior)} factors not stored" in cli("graph", tmp_path)[1]
