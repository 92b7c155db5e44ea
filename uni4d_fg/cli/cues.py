"""The verb ``cues``: make the cues of a video, and nothing else."""

from __future__ import annotations

import shutil
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import one_line, print_json
from uni4d_fg.cli.interruption import Interruption
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.reconstruction import class_list
from uni4d_fg.cli.runs import SequenceInput
from uni4d_fg.errors import Cancelled, OutputError
from uni4d_fg.results.run_contents import COMMAND_LINE, is_free, is_run, mark_run, remove_leftovers, run_lock


class WrittenLayout(str, Enum):
    """Layouts that can be written."""

    native = "native"
    uni4d = "uni4d"


def cues(
    seq: options.VideoPath,
    out: Annotated[Path, typer.Option(help="Folder to make: a sequence with all cues.", show_default=False)],
    layout: Annotated[WrittenLayout, typer.Option(help="Layout that is written.")] = WrittenLayout.native,
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    max_size: options.MaxSize = None,
    depth: options.DepthFiles = None,
    depth_model: options.DepthModel = None,
    masks: options.MaskFiles = None,
    mask_model: options.MaskModel = None,
    classes: options.Classes = None,
    tracks: options.TrackFiles = None,
    track_model: options.TrackModel = None,
    intrinsics: options.IntrinsicsFile = None,
    known_intrinsics: options.KnownIntrinsics = False,
    keep: Annotated[bool, typer.Option("--keep", help="Keep OUT-unfinished, from which another call goes on.")] = False,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Make the cues of a video (depth, masks, tracks, intrinsics) and write it with them as a sequence folder.

    What is done is kept in OUT-unfinished until all is: the same command goes on after a crash or Ctrl-C.
    """
    from dataclasses import replace

    from uni4d_fg.config.load import load_config
    from uni4d_fg.cues.gather import gather_cues
    from uni4d_fg.frontend.sequence.write import write_native, write_uni4d

    settings = load_config(config, changes or ())
    source = SequenceInput.of(
        seq, options.LayoutChoice.auto, depth, masks, tracks, depth_gt_scale=1000.0, known_intrinsics=known_intrinsics,
        intrinsics=intrinsics, start=start, stop=stop, stride=stride, max_size=max_size, depth_model=depth_model,
        mask_model=mask_model, classes=class_list(classes), track_model=track_model,
    )  # fmt: skip
    try:
        taken = out.exists() and not (out.is_dir() and not any(out.iterdir()))
    except OSError as error:
        raise OutputError(f"{out}: cannot be read ({one_line(error)}); choose another --out") from error
    if taken:
        raise OutputError(f"cannot write {out}: it exists already; remove it or choose another --out")
    opened = source.open()
    plan = replace(source.plan(opened), keep_built_in_tracks=True)
    plan.check()
    work = out.with_name(f"{out.name}-unfinished")
    if not (is_free(work) or is_run(work)):
        raise OutputError(f"{work}: is needed for what is unfinished, but holds something else; choose another --out")
    with run_lock(work, COMMAND_LINE), Interruption() as stopped, progress_reporter(quiet) as reporter:
        mark_run(work)
        remove_leftovers(work)
        try:
            sequence, report = gather_cues(opened.video, plan, work, settings, reporter=reporter, should_stop=stopped)
        except Cancelled as error:
            raise Cancelled(f"{error}; what is done is in {work}: the same command goes on from there") from error
        reporter.begin("writing", None)
        (write_uni4d if layout is WrittenLayout.uni4d else write_native)(sequence, out)
        reporter.end()
    if not keep:
        shutil.rmtree(work, ignore_errors=True)
    if json:
        print_json({"folder": out, "layout": layout.value, "num_frames": sequence.num_frames, **report.to_dict()})
        return
    typer.echo(f"{sequence.num_frames} frames of {sequence.image_size[1]} x {sequence.image_size[0]} px: {out}")
    for cue, origin in report.sources.items():
        typer.echo(f"    {cue}: {origin}")
    for text in report.facts:
        typer.echo(f"    {text}")
    for text in report.warnings:
        typer.echo(f"warning: {text}", err=True)
