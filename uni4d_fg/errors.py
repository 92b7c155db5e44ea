"""The one exception family: every message says what is wrong, where, and what to do."""

from __future__ import annotations


class Uni4dFgError(Exception):
    """Base of every error that a user can cause or repair. The CLI prints it as one line.

    Attributes:
        exit_code: Process exit status the CLI returns for this family.
    """

    exit_code = 1


class ConfigError(Uni4dFgError):
    """A configuration field is unknown, out of bounds or contradicts another one."""

    exit_code = 2


class InputError(Uni4dFgError):
    """A sequence, track file or ground-truth file is missing, unreadable or inconsistent."""

    exit_code = 3


class DegenerateProblemError(Uni4dFgError):
    """The input is readable but does not determine what was asked for (no static tracks, say)."""

    exit_code = 4


class SolverError(Uni4dFgError):
    """The optimizer cannot continue: a non-finite residual, a wrong shape, a singular system."""

    exit_code = 5


class OutputError(Uni4dFgError):
    """A result could not be written (permission, disk full); nothing half-written is left behind."""

    exit_code = 6


class MissingDependencyError(Uni4dFgError):
    """An optional package or a system library is not installed; the message names the install command."""

    exit_code = 7


class Cancelled(Uni4dFgError):
    """The user interrupted the run; finished stages are on disk and ``--resume`` continues."""

    exit_code = 130
