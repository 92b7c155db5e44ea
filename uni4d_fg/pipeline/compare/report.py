"""What a comparison leaves on disk: ``comparison.json``, ``comparison.md`` and pictures."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from uni4d_fg.files import atomic_write_json, atomic_write_text
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline.compare.comparison import Comparison
from uni4d_fg.pipeline.compare.markdown import markdown
from uni4d_fg.pipeline.compare.plots import draw_depths, draw_energies, draw_paths
from uni4d_fg.pipeline.compare.ratios import losses, stage_ratios
from uni4d_fg.pipeline.compare.solvers import LM
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder


def write_report(folder: Path, comparisons: list[Comparison], machine: dict[str, str], command: str) -> None:
    """Write ``comparison.json`` and ``comparison.md``.

    Raises:
        OutputError: If a file cannot be written.
    """
    results = [to_dict(comparison) for comparison in comparisons]
    atomic_write_json(folder / "comparison.json", {"command": command, "machine": machine, "comparisons": results})
    atomic_write_text(folder / "comparison.md", markdown(comparisons, machine, command))


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """Return plain data: everything measured, the ratios and where LM is behind. Infinite ratios become null."""
    ratios = [asdict(r) for name in comparison.runs if name != LM for r in stage_ratios(comparison, name)]
    return {**asdict(comparison), "ratios": ratios, "lm_is_behind": losses(comparison)}


def draw_comparison(folder: Path, sequence: Sequence, comparison: Comparison, runs: Path) -> list[Path]:
    """Draw energies, paths and depths of one comparison; return the files.

    Args:
        folder: Where the pictures go.
        sequence: What was reconstructed.
        comparison: Its figures.
        runs: Folder that holds the run of every solver.

    Raises:
        InputError: If a result of a run cannot be read.
        OutputError: If a file cannot be written.
    """
    title = f"{comparison.sequence}, {comparison.preset}"
    folders = {name: runs / name for name in comparison.runs}
    poses = {name: load_reconstruction(RunFolder(run).reconstruction).world_T_cam for name, run in folders.items()}
    files = [folder / f"{what}.png" for what in ("energy", "trajectory", "depth")]
    draw_energies(files[0], comparison.benchmarks, title)
    draw_paths(files[1], poses, sequence.ground_truth.world_T_cam)
    fused = {name: read_depth(RunFolder(run).depth) for name, run in folders.items()}
    draw_depths(files[2], sequence.images, {"depth cue": sequence.depths, **fused})
    return files
