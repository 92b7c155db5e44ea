"""A run in progress: what its steps share, and how one of them is resumed, reported and stored."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from uni4d_fg.allocation import LARGE, return_free_memory
from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.optim.added_factors import FactorSource
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem_io import save_stage_graph
from uni4d_fg.optim.stage_graph import RecordingRunner
from uni4d_fg.pipeline.graphs import kinds_of, remove_graphs
from uni4d_fg.pipeline.steps import STOPPED, Arrays
from uni4d_fg.pipeline.store import StageRecord, StageStore
from uni4d_fg.pipeline.summary import RunSummary, peak_memory_mb
from uni4d_fg.pipeline.window_workers import WindowWorkers
from uni4d_fg.pipeline.workers.options import WorkerOptions
from uni4d_fg.pipeline.written_beside import WrittenBeside
from uni4d_fg.progress import Reporter
from uni4d_fg.results.run_folder import RunFolder


@dataclass
class RunInProgress:
    """What the steps of one run share."""

    sequence: Sequence
    config: Config
    folder: RunFolder
    store: StageStore
    resume: bool
    reporter: Reporter
    should_stop: Callable[[], bool]
    summary: RunSummary
    recorder: RecordingRunner
    written: WrittenBeside
    """What writes the files of finished steps."""
    sources: tuple[FactorSource, ...]
    """What is added to the stages."""
    imu: ImuSamples | None = None
    options: WorkerOptions | None = None
    """How windows are solved; None: here, with all threads."""
    workers: WindowWorkers | None = None
    """Where they are, if not here."""

    def step(self, name: str, key: str, compute: Callable[[Hooks], StageRecord], total: int | None = None) -> Arrays:
        """Return a stage's arrays: stored ones of the same key when resuming, else computed and stored.

        ``total`` is the work that the stage reports itself, in units of its own.
        """
        began = time.perf_counter()
        record = self.store.load(name, key) if self.resume else None
        resumed = record is not None
        if record is None:
            self._check_cancelled()
            # A step may write files besides its record: an old record must not vouch for half-new ones.
            self.store.discard(name)
            remove_graphs(self.folder, name, done=self.summary.stages)
            self.recorder.solved.clear()
            self.reporter.begin(name.replace("_", " "), total)
            counter = iter(range(1, 1 << 30))
            hooks = Hooks(
                on_iteration=lambda solve, _, energy: self.reporter.advance(
                    next(counter), f"{solve}: energy {energy:.5g}"
                ),
                should_stop=self.should_stop,
            )
            return_free_memory(LARGE)
            record = compute(hooks)
            for kind in kinds_of(name):
                if kind in self.recorder.solved:
                    self.written.put(partial(save_stage_graph, self.folder.graph(kind), self.recorder.solved[kind]))
            self.recorder.solved.clear()
            self.written.put(partial(self.store.save, name, key, record))
            self.reporter.end()
        self.note(name, record.summary, time.perf_counter() - began, resumed)
        return record.arrays

    def forget(self, name: str) -> None:
        """Remove what an earlier run left of a step that this one does not have."""
        self.store.discard(name)
        remove_graphs(self.folder, name)

    def track_progress(self, done: int, total: int) -> None:
        """Report the tracker's steps."""
        self.reporter.advance(done, f"step {done} of {total}")

    def note(self, name: str, summary: dict[str, Any], seconds: float, resumed: bool) -> None:
        """Add what a step says to the summary of the run."""
        warnings = summary.get("warnings", [])
        rest = {field: value for field, value in summary.items() if field != "warnings"}
        self.summary.stages[name] = {
            "seconds": seconds, "peak_memory_mb": peak_memory_mb(), "resumed": resumed, **rest
        }  # fmt: skip
        self.summary.warnings += warnings

    def _check_cancelled(self) -> None:
        if self.should_stop():
            raise Cancelled(STOPPED)
