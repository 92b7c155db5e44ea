"""Verbs about results and settings: ``evaluate``, ``config``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.runs import SequenceInput, read_stored, stored_input
from uni4d_fg.frontend.sequence.model import Sequence


def evaluate(
    run: options.RunPath,
    sequence: Annotated[Path | None, typer.Option(help="Sequence with the ground truth, if not the run's.")] = None,
    layout: options.Layout = LayoutChoice.auto,
    depth: options.Depth = None,
    depth_gt_scale: options.DepthScale = 1000.0,
    max_depth: Annotated[float, typer.Option(help="Depth beyond this is not scored, m.", min=0.1)] = 70.0,
    json: options.Json = False,
) -> None:
    """Score a run against the ground truth of its sequence."""
    from uni4d_fg.results.evaluate.run import evaluate_run
    from uni4d_fg.results.evaluate.table import format_report
    from uni4d_fg.results.shot_list import finished_shots, is_split, refuse_split

    if sequence is not None:
        refuse_split(run)
    reports = []
    for folder in finished_shots(run) if is_split(run) else [run]:
        stored = stored_input(folder)
        if sequence is None:
            truth = read_stored(stored, folder)
        elif sequence.is_file():  # the run's own video, elsewhere: its cues are in the run
            truth = stored.moved_to(sequence).read()
        else:
            given = SequenceInput.of(
                sequence, layout, depth, None, None, depth_gt_scale=depth_gt_scale, known_intrinsics=False
            )
            truth = _frames_of_run(given, stored, folder)
        reports.append(evaluate_run(folder, truth, max_depth_m=max_depth))
    if json:
        print_json([report.to_dict() for report in reports] if is_split(run) else reports[0].to_dict())
    else:
        typer.echo("\n".join(format_report(report) for report in reports), nl=False)


def _frames_of_run(given: SequenceInput, stored: SequenceInput, run: Path) -> Sequence:
    """Return a sequence as it is, or the frames of it that a run was made from where that makes their number right."""
    from uni4d_fg.results.io import load_reconstruction
    from uni4d_fg.results.run_folder import RunFolder

    whole = given.read()
    chosen = replace(given, start=stored.start, stop=stored.stop, stride=stored.stride, max_size=stored.max_size)
    if chosen == given:
        return whole
    num_frames = load_reconstruction(RunFolder(run).reconstruction).num_frames
    if whole.num_frames == num_frames:
        return whole
    part = chosen.read()
    return part if part.num_frames == num_frames else whole


def config(
    config: options.ConfigChoice = None,
    preset: Annotated[str | None, typer.Option(help="The same as --config.", show_default=False)] = None,
    changes: options.Overrides = None,
    everything: Annotated[bool, typer.Option("--all", help="Print every field, advanced ones too.")] = False,
) -> None:
    """Print a configuration as it would be used: the basic fields, and the others where they are not at the default."""
    from uni4d_fg.config.load import dump_config, load_config
    from uni4d_fg.config.written import basic_fields, commented_yaml

    chosen = load_config(config or preset, changes or ())
    typer.echo(dump_config(chosen) if everything else commented_yaml(basic_fields(chosen)), nl=False)
