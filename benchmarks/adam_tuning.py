"""Is the Adam baseline at its best? The same solves with other learning rates, schedules and arithmetic.

    python benchmarks/adam_tuning.py [--scene 30x2000] [--windows 4]

Takes the solves of every stage, as the faithful program's own previous stage leaves them, and repeats each with a
variant of the configuration. Prints, per preset and kind of solve, the final exact energy, the iterations done,
and the iterations a variant needs to reach the final energy of the faithful one. Iterations, not seconds, so that
the table does not depend on the machine. Of stage 1 only the first windows are taken.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from scenes import PRESETS, SCENES, scene

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.compare.solvers import SolverVariant
from uni4d_fg.pipeline.compare.task import Task, TaskRecorder
from uni4d_fg.pipeline.compare.trace import Trace, trace_solve
from uni4d_fg.pipeline.steps import bundle_adjustment_step, camera_init_step, nonrigid_step

STAGES = ("camera_init", "bundle_adjustment", "nonrigid")
RATES = ("pose_learning_rate", "point_learning_rate", "log_scale_learning_rate", "intrinsics_learning_rate")


def scaled(factor: float) -> list[str]:
    """Return every learning rate of every stage times a factor."""
    adam = Config().adam
    return [f"adam.{stage}.{rate}={factor * getattr(getattr(adam, stage), rate)}" for stage in STAGES for rate in RATES]


def every(*changes: str) -> list[str]:
    """Return changes of a schedule for every stage."""
    return [f"adam.{stage}.{change}" for stage in STAGES for change in changes]


VARIANTS: dict[str, list[str]] = {
    "faithful": [],
    "float64": ["adam.precision=float64"],
    "keep the best": ["adam.keep_best=true"],
    "plain Adam": ["adam.amsgrad=false"],
    "rates x 0.1": [*scaled(0.1), *every("min_learning_rate=1e-6")],
    "rates x 0.3": [*scaled(0.3), *every("min_learning_rate=1e-5")],
    "rates x 3": scaled(3.0),
    "floor 1e-6": every("min_learning_rate=1e-6"),
    "floor 1e-6, patience x 3": every("min_learning_rate=1e-6", "plateau_patience=60", "stop_patience=400"),
}


def solves(sequence: Sequence, preset: str, windows: int) -> Iterator[tuple[str, list[Task]]]:
    """Yield the solves of every stage by kind, as the faithful program meets them."""
    config = load_config(preset)
    assert sequence.tracks is not None
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    run, hooks = SolverVariant("adam", ("solver=adam",)).runner(config), Hooks()
    first, second, third = TaskRecorder(run), TaskRecorder(run), TaskRecorder(run)
    cameras = camera_init_step(sequence, labelled, config, hooks, first).arrays
    yield "camera_init", first.tasks[:windows]
    scene = bundle_adjustment_step(sequence, labelled, cameras, config, hooks, second).arrays
    for kind in dict.fromkeys(task.kind for task in second.tasks):
        yield kind, [task for task in second.tasks if task.kind == kind]
    nonrigid_step(labelled, scene, config, hooks, third)
    yield "nonrigid", third.tasks


def iterations_to(traces: list[Trace], goals: list[float]) -> int | None:
    """Return the iterations until every goal is reached, summed over the solves; None if one never is."""
    total = 0
    for trace, goal in zip(traces, goals, strict=True):
        reached = np.flatnonzero(trace.energies <= goal * (1 + 1e-9))
        if len(reached) == 0:
            return None
        total += int(reached[0])
    return total


def runner(preset: str, changes: list[str]) -> StageRunner:
    return SolverVariant("variant", ("solver=adam", *changes)).runner(load_config(preset))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default="30x2000")
    parser.add_argument("--windows", type=int, default=4)
    arguments = parser.parse_args()
    sequence = scene(arguments.scene)
    print("| preset | solve | variant | energy | over the faithful | iterations | to the faithful's energy |")
    print("|---|---|---|---|---|---|---|")
    for preset in PRESETS:
        for kind, tasks in solves(sequence, preset, arguments.windows):
            goals: list[float] = []
            for name, changes in VARIANTS.items():
                traces = [trace_solve(runner(preset, changes), task) for task in tasks]
                goals = goals or [trace.energy for trace in traces]
                energy, done = sum(t.energy for t in traces), sum(t.iterations for t in traces)
                needed = iterations_to(traces, goals)
                cells = [
                    preset,
                    kind,
                    name,
                    f"{energy:.6g}",
                    f"{energy / sum(goals):.5f}",
                    str(done),
                    str(needed or "never"),
                ]
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
