"""Stage 1 side by side: this package with and without C++, and GTSAM.

    python benchmarks/camera_init.py [--frames 50] [--gtsam-frames 4] [--presets default paper] [--repeats 3]
                                     [--threads 2] [--solvers cpp python gtsam] [--plot FILE.png]

Camera initialization of the synthetic scene (320 x 240, given tracks, default noise), all windows one after the other
as in a run, in a process of its own for every solver, so that its peak memory is its own. All go through the same
Levenberg-Marquardt driver and must arrive at the same final energy: the largest relative difference of a window to that
of the first solver is printed, and the program fails if one is above 1e-6. Printed are the fastest of the repeats.
'added' is what the stage adds to the process that holds tracks and depth.

GTSAM has no factor of its own for depth reprojection: each is a custom factor that calls Python, hundreds of times as
slow as an array of them. It is therefore run once, on the first `--gtsam-frames` frames, in a table of its own with the
other solvers on as many frames. Its time includes making the graph, as theirs includes planning.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

from side_by_side import EQUAL, Times, draw_times, run_apart, run_main, with_memory

from uni4d_fg.config.load import load_config
from uni4d_fg.factors.state import State
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.optim.backend import choose_backend
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import LevenbergMarquardtRunner, Stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.pipeline.steps import camera_init_step

SOLVERS = ("cpp", "python", "gtsam")
PRESETS = ("default", "paper")
MODULES = {"cpp": "uni4d_fg.optim.cpp_pairs", "gtsam": "uni4d_fg.optim.gtsam_objective"}
"""What a solver loads when it is first used."""
PHASES = ("linearize", "solve", "evaluate")


def run_here(solver: Any, preset: str, frames: int) -> None:
    """Solve once in this process and print the result as JSON."""
    config = load_config(preset)
    sequence = make_synthetic_sequence(SyntheticSceneConfig(num_frames=frames, render_images=False))
    assert sequence.tracks is not None
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    minimize = LevenbergMarquardtRunner(choose_backend(solver))
    if solver in MODULES:
        importlib.import_module(MODULES[solver])
    windows: list[SolveSummary] = []

    def run(stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        state, summary = minimize(stage, state, hooks)
        windows.append(summary)
        return state, summary

    def solve() -> dict[str, Any]:
        began = time.perf_counter()
        camera_init_step(sequence, labelled, config, Hooks(), run)
        return {"total": time.perf_counter() - began}

    result = with_memory(solve)
    result |= {phase: sum(window.seconds[phase] for window in windows) for phase in PHASES}
    result["iterations"] = sum(len(window.iterations) for window in windows)
    result["factors"] = sum(window.num_factors for window in windows)
    result["energies"] = [window.final_energy for window in windows]
    print(json.dumps(result))


def difference(energies: list[float], reference: list[float]) -> float:
    """Return the largest relative difference of a window's final energy."""
    if len(energies) != len(reference):
        return float("inf")
    return max((abs(energy / other - 1.0) for energy, other in zip(energies, reference, strict=True)), default=0.0)


def table(preset: str, frames: int, results: dict[str, dict[str, Any]]) -> bool:
    """Print one preset and return whether the final energies are equal."""
    reference, first = next(iter(results.items()))
    windows = len(first["energies"])
    factors = first["factors"] / max(windows, 1)
    print(f"\n### {preset}, {frames} frames: {windows} windows, {factors:.0f} factors in each on average\n")
    phases = " | ".join(f"{phase}, s" for phase in PHASES)
    print(f"| solver | total, s | total / {reference} | iterations | ms / iteration | {phases} |", end="")
    print(" peak memory, MB | added, MB | final energy | difference |\n|" + "---|" * (9 + len(PHASES)))
    equal = True
    for name, r in results.items():
        apart = difference(r["energies"], first["energies"])
        equal &= apart <= EQUAL
        print(
            f"| {name} | {r['total']:.3f} | {r['total'] / first['total']:.1f} | {r['iterations']} | "
            f"{1e3 * r['total'] / max(r['iterations'], 1):.2f} | {' | '.join(f'{r[phase]:.3f}' for phase in PHASES)} | "
            f"{r['peak_mb']:.0f} | {r['added_mb']:.0f} | {sum(r['energies']):.6g} | "
            f"{apart:.1e}{'' if apart <= EQUAL else ' (!)'} |",
            flush=True,
        )
    return equal


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--gtsam-frames", type=int, default=4, help="frames of the table with GTSAM")
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--solvers", nargs="+", default=list(SOLVERS), choices=SOLVERS)
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the times")
    parser.add_argument("--here", choices=SOLVERS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.here:
        run_here(arguments.here, arguments.presets[0], arguments.frames)
        return
    ours = [solver for solver in arguments.solvers if solver != "gtsam"]
    runs = [(arguments.frames, ours)] if ours else []
    if "gtsam" in arguments.solvers:
        runs.append((arguments.gtsam_frames, arguments.solvers))
    seconds: dict[str, dict[str, float]] = {}
    equal = True
    for frames, solvers in runs:
        for preset in arguments.presets:
            results = {}
            for solver in solvers:
                options = ["--here", solver, "--presets", preset, "--frames", str(frames)]
                repeats = 1 if solver == "gtsam" else arguments.repeats
                result = run_apart(__file__, options, repeats, arguments.threads)
                if result is not None:
                    results[solver] = result
                    seconds.setdefault(solver, {})[f"{preset}, {frames} frames"] = result["total"]
            if results:
                equal &= table(preset, frames, results)
    if arguments.plot:
        draw_times(arguments.plot, [Times("Camera initialization", "", seconds)])
    if not equal:
        sys.exit("final energies differ by more than 1e-6: marked with (!)")


if __name__ == "__main__":
    run_main(main)
