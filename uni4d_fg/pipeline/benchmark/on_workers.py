"""An experiment's runs on worker processes: the same bytes as one after the other, with failures that cost a retry."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from uni4d_fg.errors import Uni4dFgError
from uni4d_fg.frontend.datasets.registry import find_dataset
from uni4d_fg.optim.threads import thread_count
from uni4d_fg.pipeline.benchmark.runner import Execute, run_task
from uni4d_fg.pipeline.benchmark.task import Task, TaskResult
from uni4d_fg.pipeline.workers.cluster import open_workers
from uni4d_fg.pipeline.workers.memory import free_bytes, reconstruction_bytes, worker_count
from uni4d_fg.pipeline.workers.options import WorkerOptions
from uni4d_fg.pipeline.workers.spread import Lost, spread
from uni4d_fg.progress import Reporter, SilentReporter


def on_workers(
    options: WorkerOptions, reporter: Reporter | None = None, should_stop: Callable[[], bool] | None = None
) -> Execute:
    """Return what does tasks on worker processes.

    Args:
        options: Where and how.
        reporter: Told how many runs are finished.
        should_stop: Polled often; runs that are not finished are abandoned, their finished stages kept.

    Raises:
        MissingDependencyError: When tasks are done and ``distributed`` is not installed.
        InputError: Then, if the scheduler or the folder cannot be reached.
        ConfigError: Then, if the workers are not fit.
    """
    told = reporter or SilentReporter()

    def execute(tasks: list[Task]) -> Iterator[TaskResult]:
        if not tasks:
            return
        count = options.workers or fitting_workers(tasks, options.threads)
        told.begin(f"{len(tasks)} runs", len(tasks))
        with open_workers(options, min(count, len(tasks)), Path(tasks[0].out), run_task.__module__) as client:
            traces = [hang_file(task) for task in tasks]
            found = spread(client, run_task, tasks, options, traces, should_stop)
            for done, (index, result) in enumerate(found, start=1):
                task = tasks[index]
                if isinstance(result, Lost):
                    result = TaskResult(task.key, task.video, task.configuration.name, failed=result.why)
                    result.save(task.result_file)
                told.advance(done, f"{task.video}, {task.configuration.name}")
                yield result
        told.end()

    return execute


def hang_file(task: Task) -> Path:
    """Return the file that says where a run was when its time was up."""
    return task.result_file.with_suffix(".hang.txt")


def fitting_workers(tasks: list[Task], threads: int) -> int:
    """Return how many of these runs this machine has the cores and the free memory for, at least 1."""
    need = 0
    for task in {(task.dataset, task.video, task.max_size): task for task in tasks}.values():
        try:
            frames, image_size = find_dataset(task.dataset).size(Path(task.root), task.video)
        except Uni4dFgError:  # its run will say so
            continue
        need = max(need, reconstruction_bytes(frames, image_size))
    return worker_count(len(tasks), need, max(thread_count() // threads, 1), free_bytes())
