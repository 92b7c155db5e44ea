"""The factor graphs of a run: what each stage solved, in the run folder."""

from __future__ import annotations

from uni4d_fg.files import remove_file
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


def kinds_of(step: str) -> tuple[str, ...]:
    """Return the kinds of solves whose graphs a step of the pipeline leaves; others it makes on the way."""
    return _KINDS.get(step, ())


def remove_graphs(folder: RunFolder, step: str) -> None:
    """Remove the graphs that an earlier run of a step left.

    Raises:
        OutputError: If one cannot be removed.
    """
    kinds = kinds_of(step)
    if step == "bundle_adjustment" and (folder.root / "stages" / "camera_init.npz").exists():
        kinds = kinds[1:]
    for kind in kinds:
        for path in (folder.graph(kind), *(folder.graphs / f"{kind}.{end}.values" for end in ("initial", "final"))):
            remove_file(path)


def write_graph_values(folder: RunFolder) -> dict[str, dict[str, int]]:
    """Write the values of every stored graph as GTSAM's text; return how large the graphs are, by kind.

    Raises:
        InputError: If a stored graph cannot be read.
        OutputError: If a file cannot be written.
    """
    sizes = {}
    for path in sorted(folder.graphs.glob("*.graph.npz")) if folder.graphs.is_dir() else ():
        stage = load_stage_graph(path)
        stage.write_values(folder.graphs)
        factors = sum(len(batch) for batch in stage.problem.batches)
        sizes[stage.kind] = {"factors": factors, "variables": int(stage.final.size())}
    return sizes
