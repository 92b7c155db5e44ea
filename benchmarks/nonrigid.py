"""Moving points side by side: this package with and without C++, and GTSAM's linear solvers.

    python benchmarks/nonrigid.py [--sizes 400x50x6 1500x50x4] [--growth 25 50 100 200] [--solvers cpp python ...]
                                  [--repeats 3] [--cholesky] [--plot FILE.png]

Every solver gets the same problem (tracks x frames x neighbors: two bodies that turn, drift and breathe, pixels of
0.5 px with 2 % outliers, depth of 2 %, 10 % of the observations missing; the default energy) and the same start, in a
process of its own so that its peak memory is its own. All run under the one Levenberg-Marquardt driver with the same
damping, and stop when a step lowers the cost by less than 1e-4 of it. Printed are the fastest of the repeats.

    cpp          trajectories in C++; 'set up' is planning
    python       the same method with NumPy and SciPy
    gtsam-pcg    the same damped systems solved by GTSAM's conjugate gradients with its block-Jacobi preconditioner, to
                 the same relative tolerance; its Python interface does not tell the number of steps
    gtsam-metis  the same systems by GTSAM's elimination in METIS order; one linear solve only, and its cost is the
                 one after that step

For GTSAM, 'solve' is the time inside GTSAM alone: making its factors from Python is not counted, and linearization
and evaluation are those of 'python'.

`--growth` solves 400 tracks x 6 neighbors with these numbers of frames and prints the exponent of the growth.
`--cholesky` times what conjugate gradients replace: a banded Cholesky over time, points ordered by frame. A frame of M
tracks is a block of 3 M, second differences couple it with two others, so that the band has 6 M rows below the
diagonal: (3 M T) (6 M)^2 = 108 M^3 T flop for T frames. `--plot` draws the times of the sizes and of the growth.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse
from side_by_side import Times, draw_times, run_apart, run_main, with_memory

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.config.stages import NonRigidConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.objective import Step
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.trajectory_cg import TrajectoryLinearization, TrajectoryObjective
from uni4d_fg.slam.stages.nonrigid import build_mesh, nonrigid_problem
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise

SOLVERS = ("cpp", "python", "gtsam-pcg", "gtsam-metis")
SOLVER = SolverConfig(max_iterations=30, relative_decrease=1e-4)
K = np.array([300.0, 300.0, 160.0, 120.0])


def make_problem(tracks: int, frames: int, neighbors: int, seed: int = 0) -> tuple[Problem, State]:
    """Return stage 3 of two moving bodies, all points free."""
    rng = np.random.default_rng(seed)
    t, zero = np.arange(frames), np.zeros(frames)
    poses = se3.se3_exp(
        np.stack([0.002 * np.sin(t), 0.03 * np.sin(0.1 * t), zero, 0.3 * np.sin(0.07 * t), zero, zero], axis=1)
    )
    instance = np.arange(tracks) % 2
    body = rng.uniform(-1, 1, size=(tracks, 3)) * np.array([0.4, 0.5, 0.15])
    points = np.empty((tracks, frames, 3))
    for label, side in ((0, -1.0), (1, 1.0)):
        mine = instance == label
        motion = se3.se3_exp(np.stack([zero, 0.03 * side * t, 0.01 * t, zero, zero, zero], axis=1))
        breath = (1.0 + 0.1 * np.sin(0.2 * t + label))[None, :, None]
        drift = np.stack([0.2 * np.sin(0.05 * t), 0.05 * np.sin(0.3 * t), 0.1 * np.sin(0.08 * t)], axis=1)
        points[mine] = np.einsum("tij,mtj->mti", motion[:, :3, :3], body[mine][:, None] * breath) + drift
        points[mine] += np.array([0.9 * side, 0.0, 3.0])
    x = world_to_camera(np.broadcast_to(poses, (tracks, frames, 4, 4)), points)
    uv = project(K, x) + rng.normal(scale=0.5, size=(tracks, frames, 2))
    wrong = rng.random((tracks, frames)) < 0.02
    uv[wrong] += rng.normal(scale=8.0, size=(int(wrong.sum()), 2))
    depth = x[..., 2] * np.exp(rng.normal(scale=0.02, size=(tracks, frames)))
    k, f = np.nonzero(rng.random((tracks, frames)) >= 0.1)
    seen = Observations(k, f, uv[k, f], depth[k, f], np.ones(len(k)))
    config = NonRigidConfig(neighbors=neighbors)
    cameras = Cameras(poses, K, np.zeros(frames))
    mesh, seen, rows, state = build_mesh(seen, instance, frames, cameras, config, {})
    return nonrigid_problem(state, mesh, seen, rows, cameras, StaticNoise(0.5, 0.02), config), state


class GtsamSystems(TrajectoryObjective):
    """NumPy's linearization with GTSAM's linear solvers."""

    def __init__(self, problem: Problem, state: State, config: SolverConfig, method: str):
        super().__init__(problem, state, config)
        self.method, self.seconds, self.linearize_seconds = method, 0.0, 0.0
        self.graph, _ = to_gtsam(problem, state, native=False, stacked=False)
        self.keys = state.keys(DYNAMIC_POINT)

    def linearize(self, state: State) -> Any:
        """Return NumPy's model and GTSAM's factors."""
        began = time.perf_counter()
        ours = super().linearize(state)
        self.linearize_seconds += time.perf_counter() - began
        return GtsamSystem(self, ours, self.graph.linearize(state.to_values()))


class GtsamSystem:
    """One quadratic model as Gaussian factors."""

    def __init__(self, objective: GtsamSystems, ours: TrajectoryLinearization, factors: gtsam.GaussianFactorGraph):
        self.objective, self.ours, self.factors = objective, ours, factors
        self.gradient_max = ours.gradient_max

    def solve(self, damping: float) -> Step:
        """Solve the damped system; the time spent outside GTSAM is not counted."""
        objective, config = self.objective, self.objective.config
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(self.factors)
        added = np.sqrt(damping * np.clip(self.ours.bands[0], config.min_diagonal, config.max_diagonal)).reshape(-1, 3)
        unit = gtsam.noiseModel.Unit.Create(3)
        for key, diagonal in zip(objective.keys, added, strict=True):
            graph.push_back(gtsam.JacobianFactor(key, np.diag(diagonal), np.zeros(3), unit))
        solve = _metis if objective.method == "gtsam-metis" else _conjugate_gradients
        delta, seconds = solve(graph, objective.keys, config)
        objective.seconds += seconds
        curvature = float(delta @ self.ours.multiply(delta))
        decrease = -float(self.ours.gradient @ delta) - 0.5 * curvature
        return Step(delta, float(np.linalg.norm(delta)), max(decrease, 0.0))


def _metis(graph: gtsam.GaussianFactorGraph, keys: list[int], config: SolverConfig) -> tuple[np.ndarray, float]:
    """Return the exact solution and GTSAM's seconds."""
    began = time.perf_counter()
    solution = graph.optimize(gtsam.Ordering.MetisGaussianFactorGraph(graph))
    seconds = time.perf_counter() - began
    return np.asarray(solution.vector(keys)), seconds


def _conjugate_gradients(
    graph: gtsam.GaussianFactorGraph, keys: list[int], config: SolverConfig
) -> tuple[np.ndarray, float]:
    """Return the solution and GTSAM's seconds: one Gauss-Newton step on the graph as it is."""
    values = gtsam.Values()
    for key in keys:
        values.insert(key, np.zeros(3))
    linear = gtsam.LinearContainerFactor.ConvertLinearGraph(graph, values)
    inner = gtsam.PCGSolverParameters(gtsam.BlockJacobiPreconditionerParameters())
    inner.epsilon_rel, inner.epsilon_abs, inner.maxIterations = config.cg_tolerance, 1e-30, config.cg_max_iterations
    parameters = gtsam.GaussNewtonParams()
    parameters.setMaxIterations(1)
    parameters.setLinearSolverType("ITERATIVE")
    parameters.setIterativeParams(inner)
    optimizer = gtsam.GaussNewtonOptimizer(linear, values, parameters)
    began = time.perf_counter()
    solution = optimizer.optimize()
    seconds = time.perf_counter() - began
    return np.concatenate([solution.atPoint3(key) for key in keys]), seconds


def run(solver: str, size: str) -> dict[str, Any]:
    """Solve one problem with one solver in this process."""
    problem, state = make_problem(*map(int, size.split("x")))
    result = with_memory(lambda: solve(solver, problem, state))
    return {**result, "points": len(state[DYNAMIC_POINT]), "factors": sum(len(batch) for batch in problem.batches)}


def solve(solver: str, problem: Problem, state: State) -> dict[str, Any]:
    """Return cost, iterations and times of one solve."""
    config = SOLVER.model_copy(update={"max_iterations": 1}) if solver == "gtsam-metis" else SOLVER
    if solver == "cpp":
        from uni4d_fg.optim.cpp_trajectory import CppTrajectoryObjective

    began = time.perf_counter()
    if solver == "cpp":
        objective: Any = CppTrajectoryObjective(problem, state, config)
    elif solver == "python":
        objective = TrajectoryObjective(problem, state, config)
    else:
        objective = GtsamSystems(problem, state, config, solver)
    planned = time.perf_counter() - began
    _, summary = minimize(objective, state, config)
    seconds = {"set up": planned, **{phase: summary.seconds[phase] for phase in ("linearize", "solve", "evaluate")}}
    if solver.startswith("gtsam"):
        # Linearization and evaluation stand beside GTSAM's solver as they are with NumPy.
        seconds = {**seconds, "set up": 0.0, "solve": objective.seconds, "linearize": objective.linearize_seconds}
    return {
        "cost": summary.final_energy,
        "iterations": len(summary.iterations),
        "inner": sum(record.inner_iterations for record in summary.iterations),
        "seconds": seconds,
        "total": sum(seconds.values()),
    }


def measured(solver: str, size: str, repeats: int) -> dict[str, Any] | None:
    """Return the fastest of the repeats, each in a process of its own; None if the solver cannot be used."""
    return run_apart(__file__, ["--one", solver, size], 1 if solver.startswith("gtsam") else repeats)


def label(solver: str) -> str:
    """Return a solver's name in tables and pictures."""
    return f"{solver} (one linear solve)" if solver == "gtsam-metis" else solver


def table(size: str, solvers: list[str], repeats: int) -> dict[str, float]:
    """Print one size, all solvers; return the times."""
    rows: dict[str, dict[str, Any]] = {}
    for solver in solvers:
        result = measured(solver, size, repeats)
        if result is not None:
            rows[solver] = result
    if not rows:
        return {}
    reference, first = next(iter(rows.items()))
    print(f"\n### {size}: {first['points']} points, {first['factors']} factors\n")
    phases = ("set up", "linearize", "solve", "evaluate")
    columns = ("solver", "final cost", "iterations", "inner steps", *(f"{p}, s" for p in phases), "total, s")
    print("| " + " | ".join((*columns, "added memory, MB", f"total / {reference}")) + " |")
    print("|---" * (len(columns) + 2) + "|")
    for solver, row in rows.items():
        inner = "-" if solver.startswith("gtsam") else row["inner"]
        times = " | ".join(f"{row['seconds'][phase]:.3f}" for phase in phases)
        ratio = row["total"] / first["total"]
        print(
            f"| {label(solver)} | {row['cost']:.2f} | {row['iterations']} | {inner} | {times} | {row['total']:.3f} | "
            f"{row['added_mb']:.0f} | {ratio:.1f} |",
            flush=True,
        )
    return {solver: row["total"] for solver, row in rows.items()}


def growth(frames: list[int], solvers: list[str], repeats: int) -> dict[str, dict[int, float]]:
    """Print the time by frames, and the exponent of a power law fitted to it; return the times."""
    seconds: dict[str, dict[int, float]] = {}
    print("\n### 400 tracks x 6 neighbors, by frames: total, s\n")
    print("| solver | " + " | ".join(map(str, frames)) + " | exponent |")
    print("|---" * (len(frames) + 2) + "|")
    for solver in solvers:
        results = [measured(solver, f"400x{n}x6", repeats) for n in frames]
        times = [result["total"] for result in results if result is not None]
        if len(times) < len(frames):
            continue
        seconds[solver] = dict(zip(frames, times, strict=True))
        exponent = np.polyfit(np.log(frames), np.log(times), 1)[0]
        print(f"| {solver} | " + " | ".join(f"{t:.3f}" for t in times) + f" | {exponent:.2f} |", flush=True)
    return seconds


def cholesky(sizes: list[str]) -> None:
    """Time one banded Cholesky of the normal equations with points ordered by frame."""
    print("\n### Banded Cholesky over time, one factorization\n")
    print("| size | rows | band | s | GFlop/s | 400x50 at that rate, s |\n|---|---|---|---|---|---|")
    for size in sizes:
        problem, state = make_problem(*map(int, size.split("x")))
        linearization = TrajectoryObjective(problem, state, SOLVER).linearize(state)
        jacobian = linearization._jacobian
        hessian = (jacobian.T @ jacobian + linearization._inside).tocoo()
        numbers = state.numbers(DYNAMIC_POINT)
        place = np.empty(len(numbers), dtype=np.int64)
        place[np.lexsort(numbers.T)] = np.arange(len(numbers))
        row, column = (3 * place[index // 3] + index % 3 for index in (hessian.row, hessian.col))
        width, n = int(np.abs(row - column).max()), hessian.shape[0]
        band = np.zeros((width + 1, n), order="F")
        lower = row >= column
        np.add.at(band, (row[lower] - column[lower], column[lower]), hessian.data[lower])
        band[0] *= 1.0 + SOLVER.initial_damping
        began = time.perf_counter()
        _, failed = scipy.linalg.lapack.dpbtrf(band, lower=1, overwrite_ab=1)
        seconds = time.perf_counter() - began
        assert not failed
        rate = n * float(width) ** 2 / seconds
        full = 108.0 * 400.0**3 * 50.0 / rate
        print(f"| {size} | {n} | {width} | {seconds:.2f} | {rate / 1e9:.1f} | {full:.1f} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", default=["400x50x6", "1500x50x4"])
    parser.add_argument("--growth", type=int, nargs="*", default=[25, 50, 100, 200])
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=list(SOLVERS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cholesky", action="store_true")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the times")
    parser.add_argument("--one", nargs=2, metavar=("SOLVER", "SIZE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(run(*arguments.one)))
        return
    by_size: dict[str, dict[str, float]] = {}
    for size in arguments.sizes:
        for solver, total in table(size, arguments.solvers, arguments.repeats).items():
            by_size.setdefault(label(solver), {})[size] = total
    by_frames: dict[str, dict[int, float]] = {}
    if arguments.growth:
        ours = [s for s in arguments.solvers if not s.startswith("gtsam")]
        by_frames = growth(arguments.growth, ours, arguments.repeats)
    if arguments.cholesky:
        cholesky(["50x50x6", "100x50x6", "200x50x6"])
    if arguments.plot:
        panels = [Times("Moving points", "tracks x frames x neighbors", by_size)]
        panels.append(Times("400 tracks x 6 neighbors", "frames", by_frames))
        draw_times(arguments.plot, panels)


if __name__ == "__main__":
    run_main(main)
