"""Everything measured about one sequence and preset; finished parts are kept, so that it can be resumed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from uni4d_fg.config.models import Config
from uni4d_fg.errors import InputError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, POSE
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.compare.benchmark import Benchmark, run_benchmark
from uni4d_fg.pipeline.compare.solvers import ADAM, LM, SolverVariant
from uni4d_fg.pipeline.compare.stored_results import ResultStore
from uni4d_fg.pipeline.compare.task import Task, TaskRecorder
from uni4d_fg.pipeline.compare.whole_run import WholeRun, whole_run
from uni4d_fg.pipeline.fingerprint import sequence_digest, stage_key
from uni4d_fg.pipeline.steps import Arrays, bundle_adjustment_step, camera_init_step, nonrigid_step
from uni4d_fg.pipeline.store import StageStore
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.stages.camera_init import PairSource
from uni4d_fg.slam.stages.energy import energy_of
from uni4d_fg.slam.stages.terms import camera_motion_terms

COMMON = "common"
"""Start of stage 1: there is no previous stage."""


@dataclass(frozen=True)
class Budget:
    """How long to measure."""

    repeats: int = 3
    seconds: float = 30.0
    """A solver does not repeat a benchmark once it has used this much."""


@dataclass(frozen=True)
class Comparison:
    """All solvers on one sequence with one preset."""

    sequence: str
    preset: str
    frames: int
    tracks: dict[str, int]
    """Number of tracks per label."""
    runs: dict[str, WholeRun]
    """Per solver."""
    camera_init_energy: dict[str, dict[str, float]]
    """Per solver, exact energy per term of its stage 1 as a whole: every pair of frames within a window."""
    benchmarks: list[Benchmark]


def compare_sequence(
    sequence: Sequence,
    preset: str,
    config: Config,
    solvers: list[SolverVariant],
    folder: Path,
    budget: Budget,
    *,
    resume: bool = False,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Comparison:
    """Measure one sequence with one preset.

    Every solver reconstructs on its own first. Then the solves of each stage are written down as they follow
    from LM's and from Adam's own previous stage, and every solver repeats each of them from the same start.

    Args:
        sequence: With tracks, or they are made once for all runs.
        preset: Name of the configuration.
        config: The configuration, without a choice of solver.
        solvers: Who takes part; 'lm' and 'adam' must.
        folder: Where runs and finished parts go.
        budget: How often every solver repeats.
        resume: Take over finished parts whose input and configuration have not changed.
        reporter: Progress.
        should_stop: Polled often; True ends the comparison, finished parts are kept.

    Raises:
        Uni4dFgError: As :func:`uni4d_fg.pipeline.reconstruct`.
    """
    reporter, should_stop = reporter or SilentReporter(), should_stop or (lambda: False)
    if sequence.tracks is None:
        reporter.begin(f"{sequence.name}: tracking", 2 * (sequence.num_frames - 1))
        tracks = track_grid(sequence.images, config.tracking, lambda done, _: reporter.advance(done), should_stop)
        reporter.end()
        sequence = replace(sequence, tracks=tracks)
    parts, key = ResultStore(folder / "parts", resume), sequence_digest(sequence, should_stop).key
    runs: dict[str, WholeRun] = {}
    for solver in solvers:
        own = solver.config(config)
        reconstruct = partial(
            whole_run, sequence, folder / solver.name, own, reporter=reporter, should_stop=should_stop
        )
        runs[solver.name] = parts.get(f"run-{solver.name}", stage_key(key, own), WholeRun, reconstruct)
    labelled = load_labels(RunFolder(folder / LM).labels)
    key = stage_key(key, config, asdict(budget), *(part for s in solvers for part in (s.name, *s.changes)))
    runners = {solver.name: solver.runner(config) for solver in solvers}
    benchmarks: list[Benchmark] = []
    for stage, start, step in _stages(sequence, labelled, config, folder):
        reporter.begin(f"{sequence.name}, {preset}: {stage} from {start}", None)
        recorded_with = runners[LM if start == COMMON else start]
        measure = partial(_benchmarks, step, start, recorded_with, runners, budget, reporter, should_stop)
        benchmarks += parts.get(f"{stage}-{start}", key, list[Benchmark], measure)
        reporter.end()
    energies = {
        solver.name: camera_init_energy(labelled, stage_arrays(folder / solver.name, "camera_init"), config)
        for solver in solvers
        if config.input.poses == "estimate"
    }
    return Comparison(sequence.name, preset, sequence.num_frames, labelled.counts(), runs, energies, benchmarks)


StageStep: TypeAlias = Callable[[StageRunner], object]
"""Does one stage with a runner for its solves."""


def _stages(
    sequence: Sequence, labelled: LabelledTracks, config: Config, folder: Path
) -> Iterator[tuple[str, str, StageStep]]:
    """Yield (stage, start, step): stage 1 once, stages 2 and 3 from both solvers' own results."""
    hooks = Hooks()
    if config.input.poses == "estimate":
        yield "camera_init", COMMON, partial(camera_init_step, sequence, labelled, config, hooks)
    for start in (LM, ADAM):
        cameras, scene = (stage_arrays(folder / start, stage) for stage in ("camera_init", "bundle_adjustment"))
        yield "bundle_adjustment", start, partial(bundle_adjustment_step, sequence, labelled, cameras, config, hooks)
        yield "nonrigid", start, partial(nonrigid_step, labelled, scene, config, hooks)


def _benchmarks(
    step: StageStep,
    start: str,
    recorded_with: StageRunner,
    runners: Mapping[str, StageRunner],
    budget: Budget,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> list[Benchmark]:
    """Write the solves of a stage down, then run one benchmark per kind of solve."""
    recorder = TaskRecorder(recorded_with)
    step(recorder)
    return [
        run_benchmark(
            kind, start, tasks, runners, repeats=budget.repeats, budget_seconds=budget.seconds,
            should_stop=should_stop, on_progress=lambda text: reporter.advance(0, text),
        )
        for kind, tasks in _by_kind(recorder.tasks).items()
    ]  # fmt: skip


def _by_kind(tasks: list[Task]) -> dict[str, list[Task]]:
    out: dict[str, list[Task]] = {}
    for task in tasks:
        out.setdefault(task.kind, []).append(task)
    return out


def stage_arrays(run: Path, stage: str) -> Arrays:
    """Return what a stage of a run left behind.

    Raises:
        InputError: If it is not there.
    """
    record = StageStore(run / "stages").load(stage)
    if record is None:
        raise InputError(f"{run}: holds no result of stage {stage}; run the comparison again without --resume")
    return record.arrays


def camera_init_energy(labelled: LabelledTracks, cameras: Arrays, config: Config) -> dict[str, float]:
    """Score stage 1 as a whole: depth reprojection of every ordered pair of frames that share a window, and E_cam."""
    poses = cameras["world_T_cam"]
    pairs = [(i, j) for i in range(len(poses)) for j in range(len(poses)) if 0 < abs(i - j) < config.camera_init.window]
    stage, energy = config.camera_init, energy_of(config)
    source = PairSource(labelled, stage.max_tracks_per_pair)
    linked = [pair for pair in pairs if len(source.tracks(*pair))]
    problem = Problem().add(source.batch(linked, stage, energy))
    problem.add(camera_motion_terms(np.arange(len(poses)), stage.camera_motion, energy))
    return problem.energies(State({POSE: poses, INTRINSICS: cameras["intrinsics"][None]}), exact=True)
