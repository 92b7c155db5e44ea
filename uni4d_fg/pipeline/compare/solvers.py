"""Who takes part: Levenberg-Marquardt, the Adam baseline, and variants of the baseline."""

from __future__ import annotations

from dataclasses import dataclass

from uni4d_fg.config.load import with_overrides
from uni4d_fg.config.models import Config
from uni4d_fg.errors import ConfigError
from uni4d_fg.optim.adam.runner import AdamRunner
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.optim.stage import StageRunner

LM = "lm"
ADAM = "adam"


@dataclass(frozen=True)
class SolverVariant:
    """One solver by name, with the fields in which its configuration differs."""

    name: str
    changes: tuple[str, ...]

    def config(self, shared: Config) -> Config:
        """Return the configuration of its own whole run.

        Raises:
            ConfigError: If a field is unknown or a value not allowed.
        """
        return with_overrides(shared, self.changes)

    def runner(self, shared: Config) -> StageRunner:
        """Return what solves a single task: as declared, the same variables free for every solver.

        The windows of the Adam program, in which other variables move, belong to its whole run only.

        Raises:
            MissingDependencyError: If PyTorch is needed and not installed.
        """
        config = self.config(shared)
        if config.solver == "adam":
            return AdamRunner(config.adam.model_copy(update={"reference_windows": False}))
        return stage_runner(config)


def solver_variants(variants: list[str]) -> list[SolverVariant]:
    """Return both solvers and the variants ``NAME:FIELD=VALUE[,FIELD=VALUE...]`` of Adam.

    Raises:
        ConfigError: If a variant is not of that form or its name is taken.
    """
    out = [SolverVariant(LM, ("solver=lm",)), SolverVariant(ADAM, ("solver=adam",))]
    for text in variants:
        name, colon, changes = text.partition(":")
        if not colon or not name or not changes:
            raise ConfigError(f"variant {text!r}: write NAME:FIELD=VALUE[,FIELD=VALUE...]")
        if not name.replace("-", "").replace("_", "").isalnum() or name in {variant.name for variant in out}:
            raise ConfigError(f"variant {text!r}: the name must be new, of letters, digits, '-' and '_'")
        out.append(SolverVariant(name, ("solver=adam", *changes.split(","))))
    return out
