"""Where the windows of a video are solved: one after the other here, or at once on worker processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, TypeVar

from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled, SolverError, Uni4dFgError
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.optim.stage_graph import RecordingRunner, StageGraph
from uni4d_fg.optim.threads import thread_count
from uni4d_fg.pipeline.window_tasks import STOPPED, MadeItems
from uni4d_fg.pipeline.workers.cluster import open_workers
from uni4d_fg.pipeline.workers.memory import free_bytes, reconstruction_bytes, worker_count
from uni4d_fg.pipeline.workers.options import WorkerOptions
from uni4d_fg.pipeline.workers.spread import Lost, spread
from uni4d_fg.slam.windows.plan import Window

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


class SolveEach(Protocol):
    """Does the same for every item, each on its own."""

    def __call__(
        self, function: Callable[[ItemT, StageRunner, Hooks], ResultT], items: Sequence[ItemT]
    ) -> Iterator[tuple[int, ResultT]]:
        """Yield index and result of each item, in any order.

        Raises:
            Uni4dFgError: What the function raises.
            Cancelled: If the user interrupts.
        """
        ...


@dataclass(frozen=True)
class InOrder:
    """One after the other, in this process."""

    run: StageRunner
    hooks: Hooks

    def __call__(
        self, function: Callable[[ItemT, StageRunner, Hooks], ResultT], items: Sequence[ItemT]
    ) -> Iterator[tuple[int, ResultT]]:
        """As :class:`SolveEach`."""
        for index in range(len(items)):
            if self.hooks.should_stop is not None and self.hooks.should_stop():
                raise Cancelled(STOPPED)
            yield index, function(items[index], self.run, self.hooks)


NOT_ON_WORKERS = "windows were solved one after the other: added factors are functions of this process"


def window_workers(
    asked: WorkerOptions | None, windows: list[Window], image_size: tuple[int, int], folder: Path, config: Config,
    recorder: RecordingRunner, should_stop: Callable[[], bool],
) -> WindowWorkers | None:  # fmt: skip
    """Return the worker processes that windows are solved on; None if they are solved in this one.

    Args:
        asked: What the user asked for, if anything.
        windows: All windows.
        image_size: (height, width), px.
        folder: Of the stages' records; that of the windows is in it.
        config: The whole configuration.
        recorder: Takes the graphs.
        should_stop: Polled often.
    """
    if asked is None or (asked.workers == 1 and asked.scheduler is None):
        return None
    cores = max(thread_count() // asked.threads, 1)
    need = reconstruction_bytes(max(map(len, windows)), image_size)
    count = min(asked.workers or worker_count(len(windows), need, cores, free_bytes()), len(windows))
    return WindowWorkers(asked, count, folder.resolve() / "windows", config, recorder, should_stop)


@dataclass
class WindowWorkers:
    """On worker processes, which are started when they are asked for or first needed, and end with the context.

    A window whose process dies or hangs is tried again. The graphs that the windows' solves leave are put together as
    if they had been solved in their order.
    """

    options: WorkerOptions
    count: int
    """Processes, if they are of this machine."""
    folder: Path
    """Of the windows' records; workers of a cluster must see it under the same path."""
    config: Config
    recorder: RecordingRunner
    should_stop: Callable[[], bool]
    _stack: ExitStack = field(default_factory=ExitStack)
    _opener: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1))
    _client: Future[Any] | None = None
    _closed: Future[None] | None = None

    def __enter__(self) -> WindowWorkers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        self._opener.shutdown()
        if self._closed is not None:
            self._closed.result()

    def close(self) -> None:
        """End the processes, while this one goes on; more than once does no harm."""
        if self._client is not None:
            # By the thread that opened them: Dask's client is bound to it.
            self._closed, self._client = self._opener.submit(self._stack.close), None

    def at_hand(self) -> WindowWorkers | None:
        """Return these workers if they are running on this machine, and so have its files and may do more."""
        return self if self._client is not None and self.options.scheduler is None else None

    def start(self) -> None:
        """Start the processes, which takes seconds, while this one goes on."""
        if self._client is None:
            self._client = self._opener.submit(self._open)

    def _open(self) -> Any:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self._stack.enter_context(
            open_workers(self.options, self.count, self.folder, "uni4d_fg.pipeline.window_tasks")
        )

    def __call__(
        self, function: Callable[[ItemT, StageRunner, Hooks], ResultT], items: Sequence[ItemT]
    ) -> Iterator[tuple[int, ResultT]]:
        """As :class:`SolveEach`.

        Raises:
            SolverError: If a window was tried as often as allowed and its process died or was ended each time.
        """
        if not items:
            return
        last_of: dict[str, int] = {}
        """Of every kind of solve, the last item that has one."""
        for index, outcome in self._outcomes(_Calls(function, items, self.config, {len(items) - 1})):
            for kind in outcome.kinds:
                last_of[kind] = max(index, last_of.get(kind, index))
            self.recorder.solved.update(outcome.graphs)
            yield index, outcome.result
        # Graphs are large, and only the last item is sure to be needed for its own. Seldom, it lacks a kind.
        earlier = sorted(set(last_of.values()) - {len(items) - 1})
        again = MadeItems(earlier, items.__getitem__)
        for number, outcome in self._outcomes(_Calls(function, again, self.config, set(range(len(again))))):
            own = {kind: graph for kind, graph in outcome.graphs.items() if last_of[kind] == earlier[number]}
            self.recorder.solved.update(own)

    def _outcomes(self, calls: _Calls) -> Iterator[tuple[int, _Outcome]]:
        """Yield what came of each call. Raises as :meth:`__call__`."""
        if not calls:
            return
        self.start()
        assert self._client is not None
        client = self._client.result()
        traces = [self.folder / f"window_{index}.hang.txt" for index in range(len(calls))]
        try:
            for index, outcome in spread(client, _call, calls, self.options, traces, self.should_stop):
                if isinstance(outcome, Lost):
                    raise SolverError(f"a part of the video cannot be solved on the workers: {outcome.why}")
                if outcome.error is not None:
                    raise outcome.error
                yield index, outcome
        except Cancelled as error:
            raise Cancelled(STOPPED) from error


@dataclass(frozen=True)
class _Call:
    """One item on its way to a worker."""

    function: Callable[..., Any]
    item: Any
    config: Config
    with_graphs: bool


@dataclass(frozen=True)
class _Outcome:
    """What came of it."""

    result: Any = None
    error: Uni4dFgError | None = None
    kinds: tuple[str, ...] = ()
    """Of its solves."""
    graphs: dict[str, StageGraph] = field(default_factory=dict)
    """Of these, where they are asked for."""


class _Calls(Sequence[_Call]):
    """The calls of some items, each made when it is given out."""

    def __init__(
        self, function: Callable[..., Any], items: Sequence[Any], config: Config, with_graphs: set[int]
    ) -> None:
        self.function, self.items, self.config, self.with_graphs = function, items, config, with_graphs

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: Any) -> Any:
        return _Call(self.function, self.items[index], self.config, index in self.with_graphs)


def _call(call: _Call) -> _Outcome:
    """Solve one window, in a worker; what goes wrong with it is an answer, for the process is sound."""
    recorder = RecordingRunner(stage_runner(call.config))
    try:
        result = call.function(call.item, recorder, Hooks())
    except Uni4dFgError as error:
        return _Outcome(error=error)
    return _Outcome(result, None, tuple(recorder.solved), recorder.solved if call.with_graphs else {})
