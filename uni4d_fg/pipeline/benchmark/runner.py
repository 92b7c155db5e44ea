"""Doing tasks: each on its own, its result on disk, whatever becomes of the others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

from uni4d_fg.errors import Cancelled, Uni4dFgError
from uni4d_fg.frontend.datasets.registry import find_dataset
from uni4d_fg.optim.threads import thread_limit
from uni4d_fg.pipeline.benchmark.prepare import prepare
from uni4d_fg.pipeline.benchmark.score import Estimate, estimates_of_run, poses_of_stages, score_estimate
from uni4d_fg.pipeline.benchmark.task import Task, TaskResult, stored_result
from uni4d_fg.pipeline.run import reconstruct
from uni4d_fg.progress import Reporter, SilentReporter

Execute: TypeAlias = Callable[[list[Task]], Iterable[TaskResult]]
"""Does tasks in any order and place, with :func:`run_task`, and gives their results as they come."""


def run_task(task: Task, reporter: Reporter | None = None, should_stop: Callable[[], bool] | None = None) -> TaskResult:
    """Do one task and write its result; one that failed is written as failed.

    Raises:
        Cancelled: If ``should_stop`` turned true; stages that are finished are taken over next time.
        OutputError: If the result cannot be written.
    """
    try:
        result = _done(task, reporter or SilentReporter(), should_stop or (lambda: False))
    except Cancelled:
        raise
    except Uni4dFgError as error:
        result = TaskResult(task.key, task.video, task.configuration.name, failed=str(error))
    except Exception as error:  # one video must not stop the others, whatever is wrong with it
        said = f"unexpected {type(error).__name__}: {error}"
        result = TaskResult(task.key, task.video, task.configuration.name, failed=said)
    result.save(task.result_file)
    return result


def run_tasks(tasks: list[Task], execute: Execute, *, fresh: bool = False) -> Iterator[tuple[TaskResult, bool]]:
    """Do the tasks whose finished results are not on disk.

    Args:
        tasks: Independent of each other.
        execute: Does those that are left.
        fresh: Do all of them.

    Yields:
        Every task's result, and whether it was there already; these come first.
    """
    left = []
    for task in tasks:
        stored = None if fresh else stored_result(task)
        if stored is None:
            left.append(task)
        else:
            yield stored, True
    for result in execute(left):
        yield result, False


def one_after_the_other(
    reporter: Reporter | None = None, should_stop: Callable[[], bool] | None = None, threads: int = 1
) -> Execute:
    """Return what does tasks in this process, in their order, each with a number of threads."""

    def execute(tasks: list[Task]) -> Iterator[TaskResult]:
        for task in tasks:
            with thread_limit(threads):
                result = run_task(task, reporter, should_stop)
            yield result

    return execute


def _done(task: Task, reporter: Reporter, should_stop: Callable[[], bool]) -> TaskResult:
    began = time.perf_counter()
    prepared = prepare(task, reporter, should_stop)
    cue_seconds = time.perf_counter() - began
    summary = reconstruct(
        prepared.sequence, task.run_folder, prepared.config, resume=True, reporter=reporter, should_stop=should_stop,
        cues=prepared.cues,
    )  # fmt: skip
    sequence, video = prepared.sequence, prepared.video
    estimate, cue = estimates_of_run(task.run_folder, sequence)
    protocols, masks = (task.pose_protocols, task.depth_protocols), (sequence.masks, prepared.mask_source)
    scores = score_estimate(video, estimate, task.dataset, *protocols, *masks)
    scores["depth_cue"] = score_estimate(video, cue, task.dataset, (), protocols[1], *masks)
    scores["stages"] = {
        stage: score_estimate(video, Estimate(poses), task.dataset, protocols[0], ())
        for stage, poses in poses_of_stages(task.run_folder).items()
    }
    stages = {name: float(stage["seconds"]) for name, stage in summary.stages.items()}
    memory = [float(stage["peak_memory_mb"]) for stage in summary.stages.values() if stage.get("peak_memory_mb")]
    return TaskResult(
        task.key, task.video, task.configuration.name, None, sequence.num_frames, scores,
        {"cues": cue_seconds if prepared.cues is not None else 0.0, **stages}, max(memory, default=None),
        (*find_dataset(task.dataset).notes(Path(task.root), task.video), *summary.warnings),
    )  # fmt: skip
