"""What an experiment leaves on disk: tables in four forms, pictures, and one page that shows them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uni4d_fg.counted import counted
from uni4d_fg.errors import InputError
from uni4d_fg.files import atomic_write_json, atomic_write_text
from uni4d_fg.pipeline.benchmark.pictures import draw_runtime, draw_video
from uni4d_fg.pipeline.benchmark.short import is_detail, short_table
from uni4d_fg.pipeline.benchmark.table import Table
from uni4d_fg.pipeline.benchmark.tables import Method

REPORT, DATA = "benchmark.md", "benchmark.json"


@dataclass(frozen=True)
class Facts:
    """What a reader must know of an experiment."""

    dataset: str
    title: str
    split: str
    convention: str
    command: str
    machine: dict[str, str]


def write_tables(
    folder: Path, facts: Facts, tables: list[Table], methods: list[Method], pictures: Sequence[Path] = ()
) -> str:
    """Write every table as ``.md``, ``.tex`` and ``.csv``, the page and ``benchmark.json``.

    Args:
        folder: Of the experiment.
        facts: About it.
        tables: All of them.
        methods: All rows.
        pictures: What the page shows, in the folder.

    Returns:
        The page.

    Raises:
        OutputError: If a file cannot be written.
    """
    short = short_table(facts.title, tables)
    for table in tables if short is None else [short, *tables]:
        for suffix, text in (("md", table.markdown()), ("tex", table.latex()), ("csv", table.comma_separated())):
            atomic_write_text(folder / "tables" / f"{table.name}.{suffix}", text)
    page = _page(facts, tables, methods, [path.relative_to(folder) for path in pictures])
    atomic_write_text(folder / REPORT, page)
    told = {
        "dataset": facts.dataset, "split": facts.split, "convention": facts.convention, "command": facts.command,
        "machine": facts.machine, "tables": [table.data() for table in tables],
        "failed": {m.name: {v: r.failed for v, r in m.results.items() if r.failed} for m in methods},
    }  # fmt: skip
    atomic_write_json(folder / DATA, told)
    return page


def draw_pictures(folder: Path, root: Path, dataset: str, methods: list[Method], tables: list[Table]) -> list[Path]:
    """Draw paths and depth of every video, and runtimes; a video that cannot be opened any more is left out.

    Args:
        folder: Of the experiment.
        root: Folder of the dataset.
        dataset: Its name.
        methods: Of which those that were run are drawn.
        tables: Of which the runtimes are drawn.

    Returns:
        The files.

    Raises:
        OutputError: If a file cannot be written.
    """
    files = []
    runs = [m for m in methods if m.kind == "run"]
    for video in dict.fromkeys(video for method in runs for video in method.results):
        done = {
            m.name: folder / "runs" / m.name / video
            for m in runs
            if video in m.results and m.results[video].failed is None
        }
        if done:
            try:
                files += draw_video(folder / "pictures", root, dataset, video, done)
            except InputError:
                continue
    runtime = next((table for table in tables if table.name == "runtime"), None)
    if runtime is not None:
        files.append(draw_runtime(folder / "pictures" / "runtime.png", runtime))
    return files


def _page(facts: Facts, tables: list[Table], methods: list[Method], pictures: list[Path]) -> str:
    tried = max((len(m.results) for m in methods), default=0)
    lines = [f"# {facts.title}, split `{facts.split}`", "", f"    {facts.command}", ""]
    lines += [f"{counted(tried, 'video')}; {facts.convention}.", ""]
    lines += [", ".join(f"{name} {value}" for name, value in facts.machine.items()), ""]
    failures = [(m.name, v, r.failed) for m in methods for v, r in m.results.items() if r.failed is not None]
    if failures:
        lines += ["## What failed", "", *(f"- {name}, {video}: {why}" for name, video, why in failures), ""]
    short = short_table(facts.title, tables)
    lines += [] if short is None else [short.markdown()]
    lines += [f"![runtime]({path.as_posix()})\n" for path in pictures if path.stem == "runtime"]
    notes = [(video, note) for m in methods for video, r in m.results.items() for note in r.notes]
    lines += ["## Tables", "", *(table.markdown() for table in tables if not is_detail(table, tables))]
    left_out = [f"`tables/{table.name}.md`" for table in tables if is_detail(table, tables)]
    lines += [f"More: {', '.join(left_out)}", ""] if left_out else []
    if notes:
        lines += ["## Notes on videos", "", *dict.fromkeys(f"- {video}: {note}" for video, note in notes), ""]
    shown = [path for path in pictures if path.stem != "runtime"]
    if shown:
        lines += ["## Pictures", "", *(f"![{path.stem}]({path.as_posix()})\n" for path in shown)]
    return "\n".join(lines)
