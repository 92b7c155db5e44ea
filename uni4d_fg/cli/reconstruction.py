"""Verbs that reconstruct: ``reconstruct``, ``demo``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json
from uni4d_fg.cli.interruption import Interruption, resume_command
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.runs import SequenceInput, prepare_run_folder
from uni4d_fg.errors import Cancelled

if TYPE_CHECKING:
    from uni4d_fg.config.models import Config
    from uni4d_fg.pipeline import RunSummary
    from uni4d_fg.sequence.model import Sequence


def reconstruct(
    seq: options.SequenceFolder,
    out: Annotated[Path | None, typer.Option(help="Folder of the run; runs/NAME if not given.")] = None,
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    solver: options.Solver = None,
    resume: options.Resume = False,
    overwrite: options.Overwrite = False,
    layout: options.Layout = LayoutChoice.auto,
    depth: options.Depth = None,
    masks: options.Masks = None,
    tracks: options.Tracks = None,
    depth_gt_scale: options.DepthScale = 1000.0,
    known_intrinsics: options.KnownIntrinsics = False,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Reconstruct a sequence: cameras, static points, motion and depth, written to a run folder."""
    from uni4d_fg.config.load import load_config

    chosen = [] if solver is None else [f"solver={solver.value}"]
    settings = load_config(config, [*(changes or ()), *chosen])
    source = SequenceInput.of(
        seq, layout, depth, masks, tracks, depth_gt_scale=depth_gt_scale, known_intrinsics=known_intrinsics
    )
    run = out or Path("runs") / seq.resolve().name
    sequence = source.read()
    prepare_run_folder(run, resume=resume, overwrite=overwrite)
    source.save(run)
    summary = run_pipeline(sequence, run, settings, resume=resume, quiet=quiet)
    if json:
        print_json(summary.to_dict())
    else:
        typer.echo("\n".join([*summary.lines(), f"results: {run}"]))


def demo(
    out: Annotated[Path, typer.Option(help="Folder of the run.")] = Path("runs/demo"),
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    fast: Annotated[bool, typer.Option("--fast", help="A smaller scene and the preset 'fast'.")] = False,
    resume: options.Resume = False,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Make a moving scene, reconstruct it, and score the result against the exact truth."""
    from uni4d_fg.cli import demonstration
    from uni4d_fg.config.load import load_config
    from uni4d_fg.evaluate.run import evaluate_run

    settings = load_config(config or ("fast" if fast else None), changes or ())
    demonstration.prepare_demo_folder(out, resume=resume)
    source = demonstration.demo_input(out, fast=fast, quiet=quiet)
    source.save(out)
    sequence = source.read()
    summary = run_pipeline(sequence, out, settings, resume=resume, quiet=quiet)
    report = evaluate_run(out, sequence)
    if json:
        print_json({"summary": summary.to_dict(), "evaluation": report.to_dict()})
    else:
        typer.echo("\n".join(demonstration.demo_lines(out, sequence, summary, report)))


def run_pipeline(sequence: Sequence, run: Path, config: Config, *, resume: bool, quiet: bool) -> RunSummary:
    """Reconstruct with progress; Ctrl-C ends the run cleanly and says how to go on.

    Raises:
        Uni4dFgError: As the pipeline does.
    """
    from uni4d_fg.pipeline import reconstruct as reconstruct_sequence

    with Interruption() as stop, progress_reporter(quiet) as reporter:
        try:
            return reconstruct_sequence(sequence, run, config, resume=resume, reporter=reporter, should_stop=stop)
        except Cancelled as error:
            raise Cancelled(f"finished stages are kept in {run}; continue with: {resume_command()}") from error
