"""The verb ``compare``."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import one_line
from uni4d_fg.cli.interruption import Interruption, resume_command
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.runs import SequenceInput
from uni4d_fg.errors import Cancelled, ConfigError, OutputError
from uni4d_fg.reading import resolved

COMPARISON_FILE = "comparison.json"
_QUIET_OUTPUT = ("output.clouds=false", "output.pictures=false")


def compare(
    sequences: Annotated[
        list[Path], typer.Argument(metavar="SEQ...", help="Folders of sequences.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Folder of the comparison.")] = Path("runs/comparison"),
    presets: Annotated[
        list[str] | None,
        typer.Option("--config", metavar="PRESET|FILE", help="Compared in turn; 'default' and 'paper' if not given."),
    ] = None,
    changes: options.Overrides = None,
    variants: Annotated[
        list[str] | None,
        typer.Option("--variant", metavar="NAME:FIELD=VALUE,...", help="A further Adam beside the faithful one."),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Repetitions of every solve.")] = 3,
    budget: Annotated[
        float, typer.Option(min=0.0, help="A solver does not repeat a stage once it has used this long, s.")
    ] = 30.0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue; finished parts are kept.")] = False,
    layout: options.Layout = LayoutChoice.auto,
    depth: options.Depth = None,
    masks: options.Masks = None,
    tracks: options.Tracks = None,
    depth_gt_scale: options.DepthScale = 1000.0,
    known_intrinsics: options.KnownIntrinsics = False,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Compare Levenberg-Marquardt with the Adam baseline (needs the extra 'adam'), stage by stage."""
    from uni4d_fg.config.load import load_config
    from uni4d_fg.optional import import_torch
    from uni4d_fg.pipeline.compare.comparison import Budget, Comparison, compare_sequence
    from uni4d_fg.pipeline.compare.machine import machine
    from uni4d_fg.pipeline.compare.markdown import section
    from uni4d_fg.pipeline.compare.report import draw_comparison, write_report
    from uni4d_fg.pipeline.compare.solvers import solver_variants

    import_torch()  # one side of every comparison: said before minutes are spent on the other
    described = machine()
    solvers = solver_variants(variants or [])
    configs = {
        _name(preset): load_config(preset, [*_QUIET_OUTPUT, *(changes or ())])
        for preset in presets or ("default", "paper")
    }
    for solver in solvers:
        for config in configs.values():
            solver.config(config)
    sources = [
        SequenceInput.of(
            s, layout, depth, masks, tracks, depth_gt_scale=depth_gt_scale, known_intrinsics=known_intrinsics
        )
        for s in sequences
    ]
    names = [resolved(path).name for path in sequences]
    if len(set(names)) < len(names):
        raise ConfigError(f"two sequences have the same folder name ({', '.join(names)}); compare them one by one")
    opened = [source.read() for source in sources]  # whether all are there is known before the first takes minutes
    done: list[Comparison] = []
    _prepare_folder(out, resume)
    command = shlex.join(["uni4d-fg", *sys.argv[1:]])
    with Interruption() as stop, progress_reporter(quiet) as reporter:
        for name, sequence in zip(names, opened, strict=True):
            for preset, config in configs.items():
                folder = out / name / preset
                try:
                    comparison = compare_sequence(
                        sequence, preset, config, solvers, folder, Budget(repeats, budget), resume=resume,
                        reporter=reporter, should_stop=stop,
                    )  # fmt: skip
                except Cancelled as error:
                    raise Cancelled(f"finished parts are kept in {out}; continue with: {resume_command()}") from error
                done.append(comparison)
                draw_comparison(folder, sequence, comparison, folder)
                write_report(out, done, described, command)
    if json:
        typer.echo((out / COMPARISON_FILE).read_text(encoding="utf-8"))
    else:
        typer.echo("\n".join([*(line for comparison in done for line in section(comparison)), f"report: {out}"]))


def _name(preset: str) -> str:
    return Path(preset).stem if preset.endswith((".yaml", ".yml")) else preset


def _prepare_folder(folder: Path, resume: bool) -> None:
    """Make sure that a comparison may be written to ``folder``.

    Raises:
        OutputError: If it holds anything and is not to be continued, or is a file.
    """
    try:
        if folder.is_dir() and any(folder.iterdir()) and not resume:
            raise OutputError(f"{folder}: is not empty; continue it with --resume or choose another --out")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made or read ({one_line(error)}); choose another --out") from error
