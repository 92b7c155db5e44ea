"""Bundle adjustment side by side: this package with and without C++, GTSAM and Ceres.

    python benchmarks/bundle_adjustment.py [--sizes 60000 350000] [--repeats 3] [--threads 2] [--solvers cpp gtsam]
                                           [--bal FILE ...] [--plot FILE.png]

Every solver gets the same synthetic problem and the same start, in a process of its own so that its peak memory
is its own: tracks of 20 to 50 consecutive frames, pixel noise of 1 px with 3 % outliers, shared fx, fy, cx, cy,
Huber's kernel at 1.345 px, first and last pose fixed. Every solver stops when a step lowers the cost by less than
1e-7 of it. Printed are the fastest of the repeats, and the relative difference of the final cost to the lowest.

    cpp, python   this package's Levenberg-Marquardt driver; 'set up' is sorting the factors
    gtsam         gtsam.LevenbergMarquardtOptimizer on GeneralSFMFactor2Cal3_S2, landmarks first in the ordering,
                  its default parameters; its calibration has a skew, held at 0 by a prior, and the fixed poses are
                  held by priors of 1e-6. Building the graph from Python is not counted
    ceres         pycolmap's bundle adjuster on a PINHOLE camera, SPARSE_SCHUR and DENSE_SCHUR (both come with
                  the extra 'dev'); Ceres' own times, its preprocessing as 'set up'; building the problem is not counted

With --bal the problems are files in the format of "Bundle Adjustment in the Large" (text, .bz2 or .gz) in place of the
synthetic sizes. Their cameras have a focal length and two radial distortion coefficients each; here all share one
pinhole camera. Observations are undistorted with the file's own coefficients, divided by their camera's focal length
and multiplied by the median one; axes are turned to x right, y down, z forward, and the world is scaled to a median
depth of 10. Observations that cannot be undistorted or whose point is behind the camera are left out, and so are points
and cameras that are left with too few; their number is printed. The start is the file's, and first and last camera
are fixed (benchmarks/bal.py). Costs are therefore not those that others report for these files, and where the solvers
end in different minima the table marks it with (!).

With --plot the times are drawn as well. Peak memory is that of the process while it solves, the problem included; 'of
which solver' is what is added to it from the start of the solve.

Pixels are coordinates alone, so that no solver's convention for the center of a pixel enters. An iteration is a
linearization; rejected steps count to the time of the iteration they precede.

With --roofline the C++ solver's passes are timed on one thread against what bounds them: linearization against the
bandwidth of a plain copy (it reads 64 bytes of sorted observation and 5 of indices and writes a coupling block of
192, which the processor reads first: 453 bytes), elimination against multiplications (3 x 7 x 7 x 2 operations per
pair of observations of a landmark). Times are the processor's, so that other work on the machine disturbs little.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from bal import BalProblem, read_bal
from side_by_side import EQUAL, Times, draw_times, run_apart, run_main, with_memory

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors import FactorBatch, Kernel, Slot
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.objective import Objective
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective

SOLVERS = ("cpp", "python", "gtsam", "ceres-sparse", "ceres-dense")
THRESHOLD = 1.345
TOLERANCE = 1e-7
MAX_ITERATIONS = 50
K = np.array([600.0, 610.0, 480.0, 270.0])


def make_problem(observations: int, seed: int = 0) -> tuple[Problem, State]:
    """Return about so many observations of points along the path of a camera, with a disturbed start."""
    rng = np.random.default_rng(seed)
    frames = 60 if observations < 200_000 else 150 if observations < 700_000 else 300
    count = observations // 35
    t = np.arange(frames)
    poses = se3.se3_exp(np.stack([0.05 * np.sin(t / 17), 0.1 * np.sin(t / 23), 0 * t, 0.06 * t, 0 * t, 0 * t], axis=1))
    length = rng.integers(20, 51, count)
    first = rng.integers(-10, frames - 10, count)
    middle = np.clip(first + length // 2, 0, frames - 1)
    depth = rng.uniform(3.0, 12.0, count)
    offset = np.stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.35, 0.35, count), np.ones(count)], axis=1)
    points = np.einsum("nij,nj->ni", poses[middle, :3, :3], offset * depth[:, None]) + poses[middle, :3, 3]
    row = np.repeat(np.arange(count), length)
    frame = np.repeat(first - np.cumsum(length) + length, length) + np.arange(length.sum())
    seen = (frame >= 0) & (frame < frames)
    row, frame = row[seen], frame[seen]
    uv = project(K, world_to_camera(poses[frame], points[row])) + rng.normal(scale=1.0, size=(len(row), 2))
    wrong = rng.uniform(size=len(row)) < 0.03
    uv[wrong] += rng.normal(scale=20.0, size=(int(wrong.sum()), 2))
    disturbance = rng.normal(scale=[0.003] * 3 + [0.03] * 3, size=(frames, 6))
    disturbance[[0, -1]] = 0.0
    state = State(
        {
            POSE: se3.retract(poses, disturbance),
            INTRINSICS: K[None] * 1.03,
            LANDMARK: points * (1.0 + rng.normal(scale=0.05, size=(count, 1))),
        }
    )
    return adjustment(state, frame, row, uv), state


def bal_problem(file: BalProblem) -> tuple[Problem, State]:
    """Return a file's problem, started where the file does."""
    state = State({POSE: file.world_T_cam, INTRINSICS: file.intrinsics[None], LANDMARK: file.points})
    return adjustment(state, file.camera, file.point, file.uv), state


def adjustment(state: State, frame: IntArray, row: IntArray, uv: FloatArray) -> Problem:
    """Return the problem of observations (M, 2) of landmarks (M,) in frames (M,): first and last pose fixed."""
    slots = (Slot(POSE, frame), Slot(LANDMARK, row), Slot(INTRINSICS, np.zeros(len(row), dtype=np.int64)))
    batch = FactorBatch.create(static_reprojection, slots, {"uv": uv}, kernel=Kernel("huber", THRESHOLD))
    free = {
        LANDMARK: np.ones((len(state[LANDMARK]), 3), dtype=bool),
        POSE: np.ones((len(state[POSE]), 6), dtype=bool),
        INTRINSICS: np.ones((1, 4), dtype=bool),
    }
    free[POSE][[0, -1]] = False
    return Problem((batch,), free).eliminate(LANDMARK)


def solve_ours(problem: Problem, state: State, threads: int, cpp: bool) -> dict[str, float]:
    config = SolverConfig(relative_decrease=TOLERANCE, max_iterations=MAX_ITERATIONS)
    if cpp:
        from uni4d_fg.optim.cpp_schur import CppSchurObjective

    began = time.perf_counter()
    objective: Objective[State]
    if cpp:
        objective = CppSchurObjective(problem, state, config, threads=threads)
    else:
        objective = SchurObjective(problem, state, config, threads=threads)
    set_up = time.perf_counter() - began
    _, summary = minimize(objective, state, config)
    phases = {name: value for name, value in summary.seconds.items() if name != "total"}
    return {
        "cost": summary.final_energy,
        "iterations": len(summary.iterations),
        "set up": set_up,
        "total": set_up + summary.seconds["total"],
        **phases,
    }


def solve_gtsam(problem: Problem, state: State, threads: int) -> dict[str, float]:
    import gtsam

    (batch,) = problem.batches
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(THRESHOLD), gtsam.noiseModel.Unit.Create(2)
    )
    pose, landmark, _ = (s.rows.tolist() for s in batch.slots)
    poses, landmarks, intrinsics = state.keys(POSE), state.keys(LANDMARK), state.key(INTRINSICS, 0)
    for uv, frame, row in zip(batch.data["uv"], pose, landmark, strict=True):
        graph.push_back(gtsam.GeneralSFMFactor2Cal3_S2(uv, noise, poses[frame], landmarks[row], intrinsics))
    fx, fy, cx, cy = state[INTRINSICS][0]
    skew = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e6, 1e6, 1e-6, 1e6, 1e6]))
    graph.push_back(gtsam.PriorFactorCal3_S2(intrinsics, gtsam.Cal3_S2(fx, fy, 0.0, cx, cy), skew))
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    last = len(state[POSE]) - 1
    for frame in (0, last):
        graph.push_back(gtsam.PriorFactorPose3(poses[frame], gtsam.Pose3(state[POSE][frame]), tight))
    values = gtsam.Values()
    ordering = gtsam.Ordering()
    for row, point in enumerate(state[LANDMARK]):
        values.insert(landmarks[row], point)
        ordering.push_back(landmarks[row])
    for frame, matrix in enumerate(state[POSE]):
        values.insert(poses[frame], gtsam.Pose3(matrix))
        ordering.push_back(poses[frame])
    values.insert(intrinsics, gtsam.Cal3_S2(fx, fy, 0.0, cx, cy))
    ordering.push_back(intrinsics)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(MAX_ITERATIONS)
    parameters.setOrdering(ordering)
    began = time.perf_counter()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    set_up = time.perf_counter() - began
    optimizer.optimize()
    total = time.perf_counter() - began
    return {"cost": optimizer.error(), "iterations": optimizer.iterations(), "set up": set_up, "total": total}


def solve_ceres(problem: Problem, state: State, threads: int, kind: str) -> dict[str, float]:
    import pyceres
    import pycolmap

    (batch,) = problem.batches
    pose, landmark = batch.slots[0].rows, batch.slots[1].rows
    scene = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=960, height=540, params=state[INTRINSICS][0], camera_id=1)
    scene.add_camera_with_trivial_rig(camera)
    order = np.argsort(pose, kind="stable")
    start = np.searchsorted(pose[order], np.arange(len(state[POSE]) + 1))
    place = np.empty(len(pose), dtype=np.int64)
    config = pycolmap.BundleAdjustmentConfig()
    for frame, matrix in enumerate(state[POSE]):
        rows = order[start[frame] : start[frame + 1]]
        place[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=str(frame), keypoints=batch.data["uv"][rows], camera_id=1, image_id=frame + 1)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(matrix)[:3]))
        config.add_image(frame + 1)
    for frame in (0, len(state[POSE]) - 1):
        config.set_constant_rig_from_world_pose(frame + 1)
    by_landmark = np.argsort(landmark, kind="stable")
    first = np.searchsorted(landmark[by_landmark], np.arange(len(state[LANDMARK]) + 1))
    for row, point in enumerate(state[LANDMARK]):
        elements = [
            pycolmap.TrackElement(int(pose[n]) + 1, int(place[n])) for n in by_landmark[first[row] : first[row + 1]]
        ]
        scene.add_point3D(point, pycolmap.Track(elements))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    options.ceres.loss_function_scale = THRESHOLD
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
    solver = pyceres.SolverOptions()
    solver.linear_solver_type = getattr(pyceres.LinearSolverType, kind)
    solver.num_threads = threads
    solver.function_tolerance = TOLERANCE
    solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    solver.max_num_iterations = MAX_ITERATIONS
    solver.logging_type = pyceres.LoggingType.SILENT
    summary = pyceres.SolverSummary()
    pyceres.solve(solver, adjuster.problem, summary)
    return {
        "cost": summary.final_cost,
        "iterations": summary.num_successful_steps + summary.num_unsuccessful_steps,
        "set up": summary.preprocessor_time_in_seconds,
        "total": summary.total_time_in_seconds,
        "linearize": summary.jacobian_evaluation_time_in_seconds,
        "solve": summary.linear_solver_time_in_seconds,
        "evaluate": summary.residual_evaluation_time_in_seconds,
    }


RUN: dict[str, Callable[[Problem, State, int], dict[str, float]]] = {
    "cpp": lambda problem, state, threads: solve_ours(problem, state, threads, True),
    "python": lambda problem, state, threads: solve_ours(problem, state, threads, False),
    "gtsam": solve_gtsam,
    "ceres-sparse": lambda problem, state, threads: solve_ceres(problem, state, threads, "SPARSE_SCHUR"),
    "ceres-dense": lambda problem, state, threads: solve_ceres(problem, state, threads, "DENSE_SCHUR"),
}


def problem_of(size: int | Path) -> tuple[Problem, State]:
    """Return the synthetic problem of a size, or that of a file."""
    return bal_problem(read_bal(size)) if isinstance(size, Path) else make_problem(size)


def run_here(solver: str, size: int | Path, threads: int) -> None:
    """Solve once in this process and print the result as JSON."""
    problem, state = problem_of(size)
    result: dict[str, Any] = with_memory(lambda: RUN[solver](problem, state, threads))
    result |= {"observations": len(problem.batches[0]), "landmarks": len(state[LANDMARK])}
    result["frames"] = len(state[POSE])
    print(json.dumps(result))


def measured(size: int | Path, solvers: list[str], threads: int, repeats: int) -> dict[str, dict[str, Any]]:
    """Return the fastest result of every solver; without those that are not installed."""
    problem = ["--bal", str(size)] if isinstance(size, Path) else ["--sizes", str(size)]
    results = {}
    for solver in solvers:
        arguments = ["--here", solver, *problem, "--threads", str(threads)]
        result = run_apart(__file__, arguments, repeats, threads)
        if result is not None:
            results[solver] = result
    return results


def roofline(size: int | Path) -> None:
    """Print what the C++ passes take per observation, and what memory and arithmetic allow."""
    from uni4d_fg.optim.cpp_schur import CppSchurObjective

    def fastest(call: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
        times = []
        for _ in range(15):
            began = clock()
            call()
            times.append(clock() - began)
        return min(times)

    problem, state = problem_of(size)
    objective = CppSchurObjective(problem, state, SolverConfig(), threads=1)
    linearization = objective.linearize(state)
    count = len(problem.batches[0])
    length = np.bincount(problem.batches[0].slots[1].rows)
    operations = float((length * (length + 1) // 2).sum()) * 3 * 7 * 7 * 2
    source = np.ones(32_000_000)
    target = source.copy()
    bandwidth = 2 * source.nbytes / fastest(lambda: np.copyto(target, source))
    linearize, reduce = fastest(lambda: objective.linearize(state)), fastest(lambda: linearization.reduced(1e-4))
    energies = fastest(lambda: objective.energies(state))
    print(f"\n{count} observations, one thread, copy {bandwidth / 1e9:.1f} GB/s")
    print(f"energies    {energies / count * 1e9:6.1f} ns per observation")
    print(
        f"linearize   {linearize / count * 1e9:6.1f} ns per observation; memory alone allows "
        f"{453 / bandwidth * 1e9:.1f} ns (with the read before the write counted by the copy too: "
        f"{453 / (1.5 * bandwidth) * 1e9:.1f} ns)"
    )
    print(f"eliminate   {reduce / count * 1e9:6.1f} ns per observation; {operations / reduce / 1e9:.1f} GFLOP/s")


def table(results: dict[str, dict[str, Any]]) -> None:
    """Print one size."""
    if not results:
        return
    any_result = next(iter(results.values()))
    lowest = min(result["cost"] for result in results.values())
    reference = results.get("cpp", any_result)
    per_iteration = {name: (r["total"] - r["set up"]) / max(r["iterations"], 1) for name, r in results.items()}
    own = per_iteration["cpp" if "cpp" in results else next(iter(results))]
    print(
        f"\n{any_result['observations']} observations, {any_result['landmarks']} landmarks, "
        f"{any_result['frames']} frames; cost {lowest:.6g}\n"
    )
    print(
        "| solver | total, s | ratio | s / iteration | ratio | iterations | set up | linearize | solve | evaluate |",
        end="",
    )
    print(" peak memory, MB | of which solver | cost above lowest |\n|---|" + "---|" * 12)
    for name, r in results.items():
        phases = " | ".join(f"{r[phase]:.3f}" if phase in r else "" for phase in ("linearize", "solve", "evaluate"))
        above = r["cost"] / lowest - 1.0
        print(
            f"| {name} | {r['total']:.3f} | {r['total'] / reference['total']:.1f} | {per_iteration[name]:.4f} | "
            f"{per_iteration[name] / own:.1f} | {r['iterations']} | {r['set up']:.3f} | {phases} | "
            f"{r['peak_mb']:.0f} | {r['added_mb']:.0f} | {above:.1e}{'' if above < EQUAL else ' (!)'} |",
            flush=True,
        )


def main() -> None:
    """Print one table per size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[60_000, 350_000, 1_000_000])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--solvers", nargs="+", default=list(SOLVERS), choices=SOLVERS)
    parser.add_argument("--bal", type=Path, nargs="+", metavar="FILE", help="files in place of synthetic sizes")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the times")
    parser.add_argument("--roofline", action="store_true", help="time the C++ passes instead")
    parser.add_argument("--here", choices=SOLVERS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    sizes: list[int | Path] = arguments.bal or arguments.sizes
    if arguments.here:
        run_here(arguments.here, sizes[0], arguments.threads)
        return
    # A malformed file shows before the first run.
    described = {file: read_bal(file).describe() for file in arguments.bal or []}
    seconds: dict[str, dict[int | str, float]] = {}
    for size in sizes:
        if isinstance(size, Path):
            print(f"\n{described[size]}", flush=True)
        if arguments.roofline:
            roofline(size)
            continue
        results = measured(size, arguments.solvers, arguments.threads, arguments.repeats)
        table(results)
        for name, result in results.items():
            key = size.name if isinstance(size, Path) else result["observations"]
            seconds.setdefault(name, {})[key] = result["total"]
    if arguments.plot and not arguments.roofline:
        draw_times(arguments.plot, [Times("Bundle adjustment", "file" if arguments.bal else "observations", seconds)])


if __name__ == "__main__":
    run_main(main)
