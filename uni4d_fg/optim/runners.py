"""What solves the stages of a run, as the configuration says."""

from __future__ import annotations

from uni4d_fg.config.base import Section
from uni4d_fg.config.models import Config
from uni4d_fg.optim.backend import choose_backend
from uni4d_fg.optim.stage import LevenbergMarquardtRunner, StageRunner


def stage_runner(config: Config) -> StageRunner:
    """Return the configured minimizer.

    Raises:
        MissingDependencyError: If it needs a package that is not installed.
        SolverError: If it needs a device that is not there.
    """
    if config.solver == "lm":
        return LevenbergMarquardtRunner(choose_backend(config.backend))
    from uni4d_fg.optim.adam.runner import AdamRunner

    return AdamRunner(config.adam)


def solver_settings(config: Config) -> tuple[str | Section, ...]:
    """Return what of the configuration the minimizer reads besides the stages' own sections.

    The backend counts as the one that is used: 'auto' is another one once the C++ extension is installed.

    Raises:
        MissingDependencyError: If the backend is not installed.
    """
    if config.solver == "lm":
        return (config.solver, choose_backend(config.backend).name)
    return (config.solver, config.adam)


def solver_facts(config: Config) -> dict[str, str]:
    """Return what the run's summary says of the minimizer: 'solver', and for 'lm' its 'backend' and a 'hint'."""
    if config.solver != "lm":
        return {"solver": config.solver}
    backend = choose_backend(config.backend)
    facts: dict[str, str] = {"solver": config.solver, "backend": backend.name}
    return {**facts, "hint": backend.hint} if backend.hint else facts
