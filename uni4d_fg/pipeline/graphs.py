"""The factor graphs of a run: what each stage solved, in the run folder."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from uni4d_fg.files import atomic_write_text, remove_file
from uni4d_fg.optim.problem_io import load_stage_graph
from uni4d_fg.results.run_folder import RunFolder

_KINDS = {
    "lens": ("lens",),
    "camera_init": ("camera_init",),
    "bundle_adjustment": ("camera_init", "bundle_adjustment", "structure"),
    "nonrigid": ("nonrigid",),
    "joint": ("joint", "joint_structure"),
}
"""Kinds of solves that a step of the pipeline makes; in windows, stage 1 is part of bundle adjustment."""

KEPT = frozenset(kind for kinds in _KINDS.values() for kind in kinds)
"""Kinds of solves whose graphs a run keeps."""


def kinds_of(step: str) -> tuple[str, ...]:
    """Return the kinds of solves whose graphs a step of the pipeline leaves; others it makes on the way."""
    return _KINDS.get(step, ())


def remove_graphs(folder: RunFolder, step: str, done: Iterable[str] = ()) -> None:
    """Remove the graphs that an earlier run of a step left.

    Args:
        folder: The run.
        step: The step that is about to begin.
        done: Steps that this run is through with, whose graphs are kept. What is on disk does not tell: their files
            may still be on the way.

    Raises:
        OutputError: If one cannot be removed.
    """
    kept = {kind for other in done for kind in kinds_of(other)}
    for kind in kinds_of(step):
        if kind in kept:
            continue
        for path in (folder.graph(kind), *(folder.graphs / f"{kind}.{end}.values" for end in ("initial", "final"))):
            remove_file(path)


@dataclass(frozen=True)
class GraphValues:
    """The values of a run's graphs as GTSAM's text."""

    text: dict[str, str]
    """By file name."""
    sizes: dict[str, dict[str, int]]
    """How many factors and variables the graphs have, by kind."""

    @classmethod
    def of(cls, folder: RunFolder) -> GraphValues:
        """Read every graph that a run has stored.

        Raises:
            InputError: If one cannot be read.
        """
        values = cls({}, {})
        for path in sorted(folder.graphs.glob("*.graph.npz")) if folder.graphs.is_dir() else ():
            values._add(path)
        return values

    def _add(self, path: Path) -> None:
        # A function of its own, so that no two graphs are in memory: of a long video each is hundreds of MB.
        stage = load_stage_graph(path)
        self.text.update(stage.values_text())
        factors = sum(len(batch) for batch in stage.problem.batches)
        self.sizes[stage.kind] = {"factors": factors, "variables": stage.num_variables}

    def write(self, folder: RunFolder) -> None:
        """Write the files beside the graphs.

        Raises:
            OutputError: If one cannot be written.
        """
        for name, text in self.text.items():
            atomic_write_text(folder.graphs / name, text)
