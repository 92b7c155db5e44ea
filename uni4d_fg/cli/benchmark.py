"""Verbs over whole datasets: ``benchmark`` and ``ablate``."""

from __future__ import annotations

import shlex
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import one_line
from uni4d_fg.cli.interruption import Interruption
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.scenes import CUES
from uni4d_fg.errors import Cancelled, ConfigError, InputError, OutputError
from uni4d_fg.progress import Reporter
from uni4d_fg.reading import resolved

if TYPE_CHECKING:
    from uni4d_fg.frontend.datasets.base import Dataset
    from uni4d_fg.pipeline.benchmark.runner import Execute
    from uni4d_fg.pipeline.benchmark.task import Configuration, Task
    from uni4d_fg.pipeline.workers.options import WorkerOptions

DatasetName = Annotated[
    str,
    typer.Argument(metavar="DATASET", help="sintel, tum-dynamics, bonn, kitti, davis, native, ...", show_default=False),
]
Root = Annotated[
    Path | None,
    typer.Option(
        help="Folder of the dataset, as its archives unpack. Not needed for 'synthetic': OUT/scenes.",
        show_default=False,
    ),
]
Out = Annotated[Path, typer.Option(help="Folder of runs, results and tables.")]
Split = Annotated[
    str | None, typer.Option(help="Split of the dataset; its usual one if not given.", show_default=False)
]
Videos = Annotated[
    list[str] | None, typer.Option("--video", help="This video only; may be repeated.", show_default=False)
]
Cues = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER", help="Depth, masks, tracks: a folder per video; ROOT/cues if that is there.",
        show_default=False,
    ),
]  # fmt: skip
Protocols = Annotated[
    list[str] | None,
    typer.Option(
        "--protocol",
        help="Way to score poses or depth; may be repeated; all but slow ones if not given.",
        show_default=False,
    ),
]
Read = Annotated[
    list[str] | None,
    typer.Option(
        "--read", metavar="LAYOUT:NAME=FOLDER", help="Score what another program wrote: monst3r, megasam, vipe, ...",
        show_default=False,
    ),
]  # fmt: skip
PublishedToo = Annotated[bool, typer.Option("--published/--no-published", help="Show printed numbers, marked as such.")]
MaxSize = Annotated[int | None, typer.Option(help="Longer side of the images at most, px.", show_default=False)]
Fresh = Annotated[bool, typer.Option("--fresh", help="Do everything again, finished results too.")]
Check = Annotated[
    bool, typer.Option("--check", help="Only look whether every video and its cues are there and can be opened.")
]
Pictures = Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw paths, depth and runtimes.")]

Processes = Annotated[
    int | None,
    typer.Option(
        "--workers", help="Runs at once, each in its own process; 1: in this one. Else what cores and memory allow.",
        show_default=False,
    ),
]  # fmt: skip
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Dask scheduler of a cluster whose workers do the runs.", show_default=False),
]
Threads = Annotated[int, typer.Option(help="Threads of a run.")]
TimeLimit = Annotated[
    float, typer.Option(metavar="MINUTES", help="A run in a process of its own is ended after this, and tried again.")
]
Retries = Annotated[int, typer.Option(help="How often a run is tried again whose process died or was ended.")]


def benchmark(
    dataset: DatasetName,
    root: Root = None,
    out: Out = Path("runs/benchmark"),
    split: Split = None,
    videos: Videos = None,
    cues: Cues = None,
    presets: Annotated[
        list[str] | None,
        typer.Option("--config", metavar="PRESET|FILE", help="A row each; 'default' if not given.", show_default=False),
    ] = None,
    changes: options.Overrides = None,
    intrinsics: Annotated[
        str, typer.Option(metavar="unknown|known|both", help="True intrinsics: held, or not told.")
    ] = "unknown",
    grid: Annotated[
        Path | None, typer.Option(metavar="YAML", help="Rows of the tables from a file.", show_default=False)
    ] = None,
    read: Read = None,
    protocols: Protocols = None,
    published: PublishedToo = True,
    max_size: MaxSize = None,
    fresh: Fresh = False,
    pictures: Pictures = True,
    check: Check = False,
    workers: Processes = None,
    scheduler: Scheduler = None,
    threads: Threads = 1,
    time_limit: TimeLimit = 360.0,
    retries: Retries = 2,
    quiet: options.Quiet = False,
) -> None:
    """Run a dataset and make its tables. A video that fails is counted; a restart does only what is missing."""
    from uni4d_fg.pipeline.benchmark.grid import configurations, read_grid
    from uni4d_fg.pipeline.workers.options import WorkerOptions

    if check:
        _check(dataset, _root(dataset, root, out), split, videos, cues)
        return
    if grid is not None:
        if presets or changes or intrinsics != "unknown":
            raise ConfigError("--grid says what each row is; leave out --config, --set and --intrinsics")
        rows = read_grid(grid)
    else:
        if intrinsics not in ("unknown", "known", "both"):
            raise ConfigError(f"--intrinsics {intrinsics}: choose unknown, known or both")
        told = ("unknown", "known") if intrinsics == "both" else (intrinsics,)
        named = [
            (f"{Path(preset).stem}{'*' if known == 'known' else ''}", {"preset": preset, "intrinsics": known})
            for preset in presets or ["default"]
            for known in told
        ]
        rows = configurations(named, {"set": list(changes or ())}, "--config")
    _experiment(
        dataset, root, out, split, videos, cues, rows, read, protocols, published, max_size, fresh, pictures, quiet,
        WorkerOptions(workers, scheduler, threads, 60.0 * time_limit, retries),
    )  # fmt: skip


def ablate(
    dataset: DatasetName,
    root: Root = None,
    grid: Annotated[
        Path | None, typer.Argument(metavar="[GRID.yaml]", help="Rows; those of --rows if not given.")
    ] = None,
    out: Out = Path("runs/ablation"),
    split: Split = None,
    videos: Videos = None,
    cues: Cues = None,
    changes: options.Overrides = None,
    ready: Annotated[
        str | None,
        typer.Option("--rows", metavar="paper|standard|full", help="Rows without a file; 'standard' if not given."),
    ] = None,
    protocols: Protocols = None,
    max_size: MaxSize = None,
    fresh: Fresh = False,
    workers: Processes = None,
    scheduler: Scheduler = None,
    threads: Threads = 1,
    time_limit: TimeLimit = 360.0,
    retries: Retries = 2,
    quiet: options.Quiet = False,
) -> None:
    """Compare configurations on a dataset: terms, cues, solver, preset; cameras are scored after every stage too."""
    from uni4d_fg.pipeline.benchmark.grid import read_grid, ready_made
    from uni4d_fg.pipeline.workers.options import WorkerOptions

    if grid is not None and (changes or ready):
        raise ConfigError("--set and --rows are for rows without a file; a grid has a base for what its rows share")
    if grid is not None:
        rows = read_grid(grid)
    else:
        rows, missing = ready_made(ready or "standard", {"set": list(changes or ())})
        if missing:
            typer.echo(f"left out, for `pip install 'uni4d-fg[adam]'`: {'; '.join(missing)}", err=True)
    _experiment(
        dataset, root, out, split, videos, cues, rows, None, protocols, False, max_size, fresh, False, quiet,
        WorkerOptions(workers, scheduler, threads, 60.0 * time_limit, retries),
    )  # fmt: skip


def _experiment(
    name: str,
    given_root: Path | None,
    out: Path,
    split: str | None,
    videos: list[str] | None,
    cues: Path | None,
    rows: list[Configuration],
    read: list[str] | None,
    protocols: list[str] | None,
    published: bool,
    max_size: int | None,
    fresh: bool,
    pictures: bool,
    quiet: bool,
    work: WorkerOptions,
) -> None:
    from uni4d_fg.pipeline.benchmark.methods import read_method
    from uni4d_fg.pipeline.benchmark.prepare import masks_of_run
    from uni4d_fg.pipeline.benchmark.published import read_published
    from uni4d_fg.pipeline.benchmark.report import Facts, draw_pictures, write_tables
    from uni4d_fg.pipeline.benchmark.runner import run_tasks
    from uni4d_fg.pipeline.benchmark.tables import Method, all_tables
    from uni4d_fg.pipeline.benchmark.task import Task, TaskResult
    from uni4d_fg.pipeline.compare.machine import machine

    root = _root(name, given_root, out)
    dataset, wanted, cue_folder = _wanted(name, root, split, videos, cues)
    poses, depths = _chosen(protocols)
    tasks = [
        Task(
            name, str(root), video, row, str(resolved(out)), None if cue_folder is None else str(resolved(cue_folder)),
            max_size, poses, depths,
        )
        for row in rows
        for video in wanted
    ]  # fmt: skip
    _make_folder(out)
    found: dict[str, dict[str, TaskResult]] = {row.name: {} for row in rows}
    facts = Facts(
        name, dataset.card.title, split or dataset.card.default_split, dataset.card.convention,
        shlex.join(["uni4d-fg", *sys.argv[1:]]), machine(),
    )  # fmt: skip
    with Interruption() as stop, progress_reporter(quiet) as reporter:
        try:
            for result, _ in run_tasks(tasks, _execution(work, tasks, reporter, stop), fresh=fresh):
                found[result.method][result.video] = result
                if result.failed is not None and not quiet:
                    typer.echo(f"{result.video}, {result.method}: failed: {result.failed}", err=True)
        except Cancelled as error:
            raise Cancelled(f"finished videos are kept in {out}; the same command goes on from them") from error
        methods = [Method(row.name, {v: found[row.name][v] for v in wanted if v in found[row.name]}) for row in rows]
        # What others wrote is scored with the masks of the first row's runs.
        masks = cache(lambda task: masks_of_run(task, reporter, stop))
        methods += [read_method(text, tasks[: len(wanted)], masks) for text in read or ()]
        printed = read_published() if published else []
        tables = all_tables(name, dataset.card.title, methods, poses, depths, printed)
        page = write_tables(out, facts, tables, methods)
        if pictures:
            reporter.begin("pictures", None)
            drawn = draw_pictures(out, root, name, methods, tables)
            reporter.end()
            page = write_tables(out, facts, tables, methods, drawn)
    typer.echo(page)
    if all(result.failed is not None for results in found.values() for result in results.values()):
        first = next(result.failed for results in found.values() for result in results.values())
        raise InputError(f"every video failed, the first with: {first}")


def _execution(asked: WorkerOptions, tasks: list[Task], reporter: Reporter, stop: Interruption) -> Execute:
    """Return what does the runs: here one by one, or in worker processes."""
    from uni4d_fg.pipeline.benchmark.on_workers import on_workers
    from uni4d_fg.pipeline.benchmark.runner import one_after_the_other

    if asked.scheduler is not None or (asked.workers or 0) > 1:
        return on_workers(asked, reporter, stop)
    # One run gains nothing from a process of its own, and without Dask there is no choice.
    if asked.workers == 1 or len(tasks) == 1 or find_spec("distributed") is None:
        return one_after_the_other(reporter, stop, asked.threads)
    return on_workers(asked, reporter, stop)


def _wanted(
    name: str, root: Path, split: str | None, videos: list[str] | None, cues: Path | None
) -> tuple[Dataset, tuple[str, ...], Path | None]:
    """Return the dataset, the names of the videos that are asked for, and the folder of their cues."""
    from uni4d_fg.frontend.datasets.registry import find_dataset

    dataset = find_dataset(name)
    wanted = dataset.videos(root, split)
    if videos:
        absent = sorted(set(videos) - {*wanted, *dataset.found(root)})
        if absent:
            raise InputError(f"{root}: holds no video {absent[0]!r}; found {', '.join(dataset.found(root))}")
        wanted = tuple(videos)
    if cues is not None and not cues.is_dir():
        raise InputError(f"{cues}: no such folder; give one that holds a folder of cues per video")
    return dataset, wanted, cues or (root / CUES if (root / CUES).is_dir() else None)


def _check(name: str, root: Path, split: str | None, videos: list[str] | None, cues: Path | None) -> None:
    """Say of every video whether it can be opened, and what is missing; raises InputError if anything is."""
    from uni4d_fg.errors import Uni4dFgError
    from uni4d_fg.pipeline.benchmark.prepare import open_task
    from uni4d_fg.pipeline.benchmark.task import Configuration, Task

    _, wanted, folder = _wanted(name, root, split, videos, cues)
    missing = 0
    for video in wanted:
        task = Task(name, str(root), video, Configuration("check"), "", None if folder is None else str(folder))
        try:
            found = open_task(task)
        except Uni4dFgError as error:
            missing += 1
            typer.echo(f"{video}: {error}")
            continue
        truth = found.ground_truth
        known = {"poses": truth.world_T_cam, "depth": truth.depths, "masks": truth.masks, "tracks": truth.track_points}
        given = {"depth": found.depths, "masks": found.masks, "tracks": found.tracks}
        height, width = found.image_size
        texts = [", ".join(n for n, v in parts.items() if v is not None) or "none" for parts in (known, given)]
        typer.echo(f"{video}: {found.num_frames} frames of {width} x {height} px; truth: {texts[0]}; cues: {texts[1]}")
    if missing:
        raise InputError(f"{root}: {missing} of {len(wanted)} videos cannot be used")


def _root(name: str, given: Path | None, out: Path) -> Path:
    """Return the folder of a dataset. Raises ConfigError if it must be given and is not."""
    from uni4d_fg.frontend.datasets.registry import find_dataset

    if given is None and not find_dataset(name).card.is_made:
        raise ConfigError(f"--root is missing: give the folder of {find_dataset(name).card.title}")
    return resolved(given or out / "scenes")


def _chosen(protocols: list[str] | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the protocols of poses and of depth. Raises ConfigError for an unknown one."""
    from uni4d_fg.results.evaluate.protocols.depth import DEPTH_PROTOCOLS, SLOW_PROTOCOLS
    from uni4d_fg.results.evaluate.protocols.pose import POSE_PROTOCOLS

    if protocols is None:
        return ("sim3",), tuple(p for p in DEPTH_PROTOCOLS if p not in SLOW_PROTOCOLS)
    for name in protocols:
        if name not in POSE_PROTOCOLS and name not in DEPTH_PROTOCOLS:
            raise ConfigError(
                f"--protocol {name}: there is none; choose from {', '.join([*POSE_PROTOCOLS, *DEPTH_PROTOCOLS])}"
            )
    return tuple(p for p in protocols if p in POSE_PROTOCOLS), tuple(p for p in protocols if p in DEPTH_PROTOCOLS)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({one_line(error)}); choose another --out") from error
