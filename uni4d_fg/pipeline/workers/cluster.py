"""Opening worker processes: of this machine, or of a cluster that somebody started."""

from __future__ import annotations

import logging
import multiprocessing
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from uni4d_fg.allocation import SETTINGS
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.optional import import_distributed
from uni4d_fg.pipeline.workers.options import WorkerOptions

_CONNECT_SECONDS = 30.0
_START_SECONDS = 300.0
_RESTART = "1 h"
_PRELOAD = "uni4d_fg.pipeline.workers.guarded"


@contextmanager
def open_workers(options: WorkerOptions, count: int, folder: Path, module: str | None = None) -> Iterator[Any]:
    """Give a ``distributed.Client`` with workers; those that were started here end with the context.

    Args:
        options: Where they are.
        count: Processes, if they are of this machine.
        folder: Where tasks write; workers of a cluster must see it under the same path.
        module: Loaded as workers of this machine start, not by their first task.

    Raises:
        MissingDependencyError: If ``distributed`` is not installed.
        InputError: If the scheduler does not answer, or its workers do not see the folder.
        ConfigError: If its workers have several threads, or another version of this package; or if processes of this
            machine cannot start.
    """
    distributed = import_distributed()
    with ExitStack() as stack:
        _quiet(stack)
        if options.scheduler is not None:
            client = stack.enter_context(_connect(distributed, options.scheduler))
            _check_workers(client, options.scheduler, folder)
        else:
            client = stack.enter_context(_local(distributed, options, count, module))
        yield client


@contextmanager
def _local(distributed: Any, options: WorkerOptions, count: int, module: str | None) -> Iterator[Any]:
    import dask

    # Dask's own trim threshold of 64 KiB has every large array mapped anew: a third of a run's time.
    variables = {**dict.fromkeys(_THREAD_VARIABLES, options.threads), **SETTINGS}
    environment = {f"distributed.nanny.pre-spawn-environ.{name}": str(value) for name, value in variables.items()}
    modules = [_PRELOAD, *([] if module is None else [module])]
    changed = {
        "distributed.worker.multiprocessing-method": _start_method(distributed, modules),
        # Retries are counted by who gives the tasks out: the scheduler says at once that a worker died.
        "distributed.scheduler.allowed-failures": 0,
        # A worker that is started again is given up for good if it is not there by then; a busy machine takes long.
        "distributed.deploy.lost-worker-timeout": _RESTART,
        # Tracks and landmarks of a part of a video are more than what Dask takes for a mistake.
        "distributed.admin.large-graph-warning-threshold": "1 GB",
        # Dask's profiler takes the interpreter from the task a hundred times a second, and what watches its event loops
        # and the machine does so fifty times.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.tick.cycle": "10s",
        "distributed.admin.system-monitor.interval": "60s",
        **environment,
    }
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(changed))
        try:
            cluster = stack.enter_context(distributed.LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, memory_limit=0,
                dashboard_address="127.0.0.1:0", host="127.0.0.1", preload=modules, silence_logs=logging.CRITICAL,
            ))  # fmt: skip
        except RuntimeError as error:
            raise ConfigError(
                "worker processes did not start; they load the script that asks for them, which must do so under "
                '`if __name__ == "__main__":` and be a file; where that is so, what they printed says why'
            ) from error
        client = stack.enter_context(distributed.Client(cluster, timeout=_START_SECONDS))
        client.wait_for_workers(1, timeout=_START_SECONDS)
        yield client


def _start_method(distributed: Any, modules: list[str]) -> str:
    """Return how processes are started: on Linux as forks of one that has loaded the modules, once for all of them.

    That process has no threads, for it does nothing but fork. It ends with this one.
    """
    if not sys.platform.startswith("linux"):
        return "spawn"
    import dask

    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        distributed.utils.get_mp_context()  # has the process load what Dask's own tests need; ours takes its place
    multiprocessing.get_context("forkserver").set_forkserver_preload(["distributed.nanny", *modules])
    return "forkserver"


_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def _connect(distributed: Any, address: str) -> Any:
    try:
        return distributed.Client(address, timeout=_CONNECT_SECONDS)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at {address} ({' '.join(str(error).split())}); start one with `dask scheduler`"
        ) from error


def _check_workers(client: Any, address: str, folder: Path) -> None:
    """Look at the workers that are there; a cluster may add others later."""
    for worker, threads in client.nthreads().items():
        if threads != 1:
            raise ConfigError(f"{worker}: has {threads} threads; start the workers with `--nthreads 1`")
    try:
        told = client.run(_seen_by_worker, str(folder))
    except ModuleNotFoundError as error:
        raise ConfigError(f"{address}: a worker lacks the package {error.name!r}; install it there") from error
    here = _version()
    for worker, (there, is_there) in told.items():
        if there != here:
            raise ConfigError(f"{worker}: has uni4d-fg {there}, here is {here}; install the same")
        if not is_there:
            raise InputError(f"{worker}: sees no folder {folder}; choose one that all machines share")


def _seen_by_worker(folder: str) -> tuple[str, bool]:
    return _version(), Path(folder).is_dir()


def _version() -> str:
    try:
        return version("uni4d-fg")
    except PackageNotFoundError:  # a source tree that is not installed
        return "from source"


def _quiet(stack: ExitStack) -> None:
    """Keep Dask's logs of lost workers off the terminal: what became of a task, its result says."""
    for name in ("distributed", "distributed.nanny", "distributed.scheduler", "distributed.core"):
        logger = logging.getLogger(name)
        stack.callback(logger.setLevel, logger.level)
        logger.setLevel(logging.CRITICAL)
