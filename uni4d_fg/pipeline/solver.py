"""What solves the stages of a run, as the configuration says."""

from __future__ import annotations

from uni4d_fg.config.base import Section
from uni4d_fg.config.models import Config
from uni4d_fg.stages.stage import StageRunner, run_stage


def stage_runner(config: Config) -> StageRunner:
    """Return the configured minimiser.

    Raises:
        MissingDependencyError: If it needs a package that is not installed.
        SolverError: If it needs a device that is not there.
    """
    if config.solver == "lm":
        return run_stage
    from uni4d_fg.adam.runner import AdamRunner

    return AdamRunner(config.adam)


def solver_settings(config: Config) -> tuple[str | Section, ...]:
    """Return what of the configuration the minimiser reads besides the stages' own sections."""
    return (config.solver,) if config.solver == "lm" else (config.solver, config.adam)
