"""Do GTSAM's optimizers and ours agree, stage by stage, and what does an iteration cost?

    python benchmarks/gtsam_optimizers.py [SEQUENCE] [--frames 12] [--step 1] [--grid 26 20] [--repeats 5]
                                          [--tables agreement end cost]

Without a sequence on a synthetic scene of 12 frames. The sequence is reconstructed with the preset 'default', and each
stage's problem is taken from the run folder. Printed as Markdown:

agreement  every solver from the stage's start: with the stage's own tolerances, and converged (relative decrease 1e-8,
           at most 100 iterations). Poses, focal length and energy are compared with the first solver's.
end        GTSAM's Levenberg-Marquardt started at our end: by what part it lowers the energy, for the run as it is and
           for one whose tolerances are tight.
cost       time per iteration of GTSAM's Levenberg-Marquardt on the exported graph of bundle adjustment, its native part
           and all of it, against a graph that is made by hand of the same native factors. In pairs, as a median ratio.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.geometry import se3
from uni4d_fg.optim.backend import choose_backend
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import LevenbergMarquardtRunner, Stage
from uni4d_fg.optim.stage_graph import StageGraph
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.graph_summary import stage_graphs

SOLVERS = {
    "C++": ("cpp", "levenberg_marquardt"),
    "NumPy": ("python", "levenberg_marquardt"),
    "backend gtsam": ("gtsam", "levenberg_marquardt"),
    "GTSAM LM": ("python", "gtsam_levenberg_marquardt"),
    "GTSAM Dogleg": ("python", "gtsam_dogleg"),
}
"""Backend and optimizer."""
CONVERGED = {"relative_decrease": 1e-8, "max_iterations": 100}
TIGHT = [
    f"{stage}.{solver}.{setting}"
    for stage, solver in (
        ("camera_init", "solver"),
        ("bundle_adjustment", "solver"),
        ("bundle_adjustment", "structure_solver"),
        ("nonrigid", "solver"),
    )
    for setting in ("relative_decrease=1e-9", "max_iterations=1000")
]
NATIVE = ("static_reprojection", "intrinsics_prior", "log_scale_prior")
"""Terms of bundle adjustment that GTSAM has factors for."""


def cut(sequence: Sequence, frames: int, step: int) -> Sequence:
    """Take some frames into memory."""
    chosen = np.arange(sequence.num_frames)[::step][:frames]
    poses = sequence.ground_truth.world_T_cam

    def pick(source: Any) -> ArrayFrames[Any]:
        return ArrayFrames(np.stack([source[int(frame)] for frame in chosen]))

    return dataclasses.replace(
        sequence, images=pick(sequence.images), depths=pick(sequence.depths), masks=pick(sequence.masks),
        timestamps=sequence.timestamps[chosen], frame_names=(),
        ground_truth=GroundTruth(None if poses is None else poses[chosen]),
    )  # fmt: skip


def solver_of(kind: str, config: Config) -> SolverConfig:
    """Return the options of a stage's solver."""
    adjustment = config.bundle_adjustment
    return {
        "camera_init": config.camera_init.solver,
        "bundle_adjustment": adjustment.solver,
        "structure": adjustment.structure_solver,
        "nonrigid": config.nonrigid.solver,
    }[kind]


def distances(found: State, reference: State, truth: FloatArray | None) -> list[str]:
    """Return rotation and position apart, the focal length apart, and the trajectory's error, as cells."""
    cells = ["", "", "", ""]
    if POSE in found:
        twist = se3.se3_log(se3.inverse(reference[POSE]) @ found[POSE])
        cells[0] = f"{np.degrees(np.linalg.norm(twist[:, :3], axis=1).max()):.1e}"
        cells[1] = f"{1e3 * np.linalg.norm(twist[:, 3:], axis=1).max():.1e}"
        if truth is not None and len(truth) == len(found[POSE]):
            cells[3] = f"{1e3 * evaluate_trajectory(found[POSE], truth).ate_m:.3f}"
    if INTRINSICS in found:
        cells[2] = f"{np.abs(found[INTRINSICS] - reference[INTRINSICS])[:, :2].max():.1e}"
    return cells


def print_agreement(stages: dict[str, StageGraph], config: Config, truth: FloatArray | None) -> None:
    """Print how the solvers agree."""
    for label, changes in (("the stage's own tolerances", {}), ("converged", CONVERGED)):
        print(f"\n### Agreement, {label}\n")
        heads = (
            "stage", "solver", "iterations", "ms / iteration", "time, s", "energy", "relative to the first",
            "rotation, deg", "position, mm", "focal, px", "ATE, mm",
        )  # fmt: skip
        print("| " + " | ".join(heads) + " |\n|" + "---|" * len(heads))
        for kind, stage in stages.items():
            first: tuple[State, float] | None = None
            for name, (backend, optimizer) in SOLVERS.items():
                solver = solver_of(kind, config).model_copy(update={"optimizer": optimizer, **changes})
                run = LevenbergMarquardtRunner(choose_backend(backend))  # type: ignore[arg-type]
                state, summary = run(Stage(kind, stage.problem, solver), stage.initial_state)
                count, seconds = len(summary.iterations), summary.seconds["total"]
                first = first or (state, summary.final_energy)
                cells = [
                    kind, name, str(count), f"{1e3 * seconds / max(count, 1):.1f}", f"{seconds:.2f}",
                    f"{summary.final_energy:.6f}", f"{summary.final_energy / first[1] - 1.0:+.1e}",
                    *distances(state, first[0], truth if kind == "bundle_adjustment" else None),
                ]  # fmt: skip
                print("| " + " | ".join(cells) + " |", flush=True)


def lowered(stage: StageGraph) -> tuple[float, int]:
    """Return by what part GTSAM's Levenberg-Marquardt lowers the energy of a stage's end, and its iterations."""
    solver = SolverConfig(optimizer="gtsam_levenberg_marquardt", relative_decrease=1e-9, max_iterations=100)
    _, summary = LevenbergMarquardtRunner(choose_backend("python"))(
        Stage(stage.kind, stage.problem, solver), stage.final_state
    )
    return 1.0 - summary.final_energy / summary.initial_energy, len(summary.iterations)


def print_end(stages: dict[str, StageGraph], tight: dict[str, StageGraph]) -> None:
    """Print what GTSAM still finds at our ends."""
    print("\n### GTSAM's Levenberg-Marquardt from our end\n")
    print("| stage | energy | lowered by | iterations | energy, tight | lowered by | iterations |\n|" + "---|" * 7)
    for kind, stage in stages.items():
        cells = [kind]
        for end in (stage, tight[kind]):
            part, count = lowered(end)
            cells += [f"{end.problem.energy(end.final_state):.4f}", f"{part:.1e}", str(count)]
        print("| " + " | ".join(cells) + " |", flush=True)


def by_hand(problem: Problem, state: State) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the native part of bundle adjustment as one writes it with GTSAM alone."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    x, k, landmark = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.K, gtsam.symbol_shorthand.L
    huber = gtsam.noiseModel.mEstimator.Huber
    for batch in problem.batches:
        if batch.name == "static_reprojection":
            frame, point = batch.slots[0].rows.tolist(), batch.slots[1].rows.tolist()
            sigma = batch.sigma / np.sqrt(batch.weight)
            kernel = batch.kernel.threshold * np.sqrt(batch.weight)
            for n, uv in enumerate(batch.data["uv"]):
                noise = gtsam.noiseModel.Robust.Create(huber(kernel[n]), gtsam.noiseModel.Isotropic.Sigma(2, sigma[n]))
                graph.push_back(gtsam.GeneralSFMFactor2Cal3_S2(uv, noise, x(frame[n]), landmark(point[n]), k(0)))
            for row in np.unique(batch.slots[1].rows).tolist():
                values.insert(landmark(row), state[LANDMARK][row])
    fx, fy, cx, cy = state[INTRINSICS][0]
    calibration = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    values.insert(k(0), calibration)
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.2 * fx, 0.2 * fy, 1e-6, 1e-6, 1e-6]))
    graph.addPriorCal3_S2(k(0), calibration, sigmas)
    for row, pose in enumerate(state[POSE]):
        values.insert(x(row), gtsam.Pose3(pose))
    graph.addPriorPose3(x(0), values.atPose3(x(0)), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
    return graph, values


def seconds_per_iteration(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, iterations: int = 8) -> float:
    """Return the time of an iteration of GTSAM's Levenberg-Marquardt."""
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams.CeresDefaults())
    began = time.perf_counter()
    for _ in range(iterations):
        optimizer.iterate()
    return (time.perf_counter() - began) / iterations


def print_cost(stage: StageGraph, repeats: int) -> None:
    """Print times per iteration on exported graphs against a graph made by hand."""
    problem, state = stage.problem, stage.initial_state
    native = dataclasses.replace(problem, batches=tuple(b for b in problem.batches if b.name in NATIVE))
    graphs = {
        "by hand, native factors": by_hand(problem, state),
        "exported, the native terms": to_gtsam(native, state),
        "exported, all terms": to_gtsam(problem, state),
        "exported, all terms, custom factors only": to_gtsam(problem, state, native=False),
    }
    names = list(graphs)
    times: dict[str, list[float]] = {name: [] for name in graphs}
    for _ in range(repeats):
        for name, (graph, values) in graphs.items():
            times[name].append(seconds_per_iteration(graph, values))
    print("\n### GTSAM's Levenberg-Marquardt: time per iteration, bundle adjustment\n")
    print("| graph | factors | custom | linearize, ms | iteration, ms | ratio (median of pairs) |\n|" + "---|" * 6)
    for name, (graph, values) in graphs.items():
        began = time.perf_counter()
        graph.linearize(values)
        linearize = time.perf_counter() - began
        custom = sum(isinstance(graph.at(i), gtsam.CustomFactor) for i in range(graph.size()))
        ratio = np.median(np.array(times[name]) / np.array(times[names[0]]))
        print(
            f"| {name} | {graph.size()} | {custom} | {1e3 * linearize:.1f} | {1e3 * np.median(times[name]):.1f} | "
            f"{ratio:.2f} |", flush=True,
        )  # fmt: skip


def main() -> None:
    """Reconstruct and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path, nargs="?", help="a synthetic scene without")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--step", type=int, default=1, help="take every STEP-th frame of the sequence")
    parser.add_argument("--grid", type=int, nargs=2, default=(26, 20), help="columns and rows of tracks")
    parser.add_argument("--tables", nargs="+", default=["agreement", "end", "cost"])
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    columns, rows = arguments.grid
    if arguments.sequence is None:
        sequence = make_synthetic_sequence(
            SyntheticSceneConfig(num_frames=arguments.frames, grid_columns=columns, grid_rows=rows, render_images=False)
        )
    else:
        sequence = cut(read_sequence(arguments.sequence), arguments.frames, arguments.step)
    quiet = [
        "output.clouds=false", "output.pictures=false",
        f"tracking.grid_columns={columns}", f"tracking.grid_rows={rows}", "tracking.query_interval=12",
    ]  # fmt: skip
    config = load_config("default", quiet)
    with tempfile.TemporaryDirectory() as folder:
        reconstruct(sequence, Path(folder) / "run", config)
        stages = stage_graphs(Path(folder) / "run")
        order = [kind for kind in ("camera_init", "bundle_adjustment", "structure", "nonrigid") if kind in stages]
        stages = {kind: stages[kind] for kind in order}
        for kind, stage in stages.items():
            sizes = ", ".join(f"{len(array)} {v}" for v, array in stage.final_state.arrays.items())
            print(f"{kind}: {sum(len(b) for b in stage.problem.batches)} factors on {sizes}")
        if "agreement" in arguments.tables:
            print_agreement(stages, config, sequence.ground_truth.world_T_cam)
        if "end" in arguments.tables:
            reconstruct(sequence, Path(folder) / "tight", load_config("default", [*quiet, *TIGHT]))
            print_end(stages, stage_graphs(Path(folder) / "tight"))
        if "cost" in arguments.tables:
            print_cost(stages["bundle_adjustment"], arguments.repeats)


if __name__ == "__main__":
    main()
