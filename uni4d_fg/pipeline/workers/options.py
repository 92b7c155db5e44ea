"""How independent tasks are spread over processes."""

from __future__ import annotations

from dataclasses import dataclass

from uni4d_fg.errors import ConfigError


@dataclass(frozen=True)
class WorkerOptions:
    """Where tasks run and what happens to one that does not come back.

    Raises:
        ConfigError: On construction, if a number is out of range or two fields contradict each other.
    """

    workers: int | None = None
    """Processes of this machine; 1: this process alone; None: as many as cores and free memory allow."""
    scheduler: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""
    threads: int = 1
    """Threads of every task, here or there: what networks find may depend on them in the last digits."""
    time_limit: float | None = 6 * 3600.0
    """A task that takes longer is ended, s; needs processes of their own."""
    retries: int = 2
    """How often a task is tried again whose process died or was ended."""
    workerless_limit: float = 300.0
    """With no worker left for so long, s, the wait for another ends."""

    def __post_init__(self) -> None:
        for name, value, least in (
            ("workers", self.workers, 1), ("threads", self.threads, 1), ("retries", self.retries, 0),
        ):  # fmt: skip
            if value is not None and value < least:
                raise ConfigError(f"--{name} {value}: must be at least {least}")
        if self.time_limit is not None and not self.time_limit > 0:
            raise ConfigError(f"time limit of {self.time_limit:g} s: must be above 0")
        if not self.workerless_limit > 0:
            raise ConfigError(f"limit of {self.workerless_limit:g} s without workers: must be above 0")
        if self.scheduler is not None and self.workers is not None:
            raise ConfigError("--workers starts processes here, --scheduler uses those of a cluster: give one of them")
