"""How much faster worker processes are than one after the other: windows of one long video, and many videos.

    python benchmarks/workers.py windows --frames 1000 --workers 2 [--interval 10]
    python benchmarks/workers.py videos --count 10 --workers 4 --size 320x240

A worker takes some seconds of a core to start, so that videos that are done in less gain nothing. Both ways have one
thread per task and end in the same bytes, which is checked. Wall time says something only on a machine that does
nothing else. Elsewhere the CPU time says what it would be: that of this process, which mostly waits, and that of the
busiest worker, or of all workers over the cores, whichever is more.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from uni4d_fg.allocation import keep_freed_memory
from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.assemble import as_sequence
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.benchmark.on_workers import on_workers
from uni4d_fg.pipeline.benchmark.runner import one_after_the_other
from uni4d_fg.pipeline.benchmark.task import Configuration, Task
from uni4d_fg.pipeline.workers.options import WorkerOptions

_MANY_TRACKS, _FEW_TRACKS = 10, 30
"""Frames between two grids of new tracks; a video of 1,000 frames of 160 x 120 px has 19,200 and 6,528 with them."""
_BARE = ("output.clouds=false", "output.pictures=false")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("windows", "videos"))
    parser.add_argument("--frames", type=int, help="of a video; 1000 for windows, 24 for videos")
    parser.add_argument("--count", type=int, default=10, help="videos")
    parser.add_argument("--size", default="160x120", help="of the images, width x height, px")
    parser.add_argument("--interval", type=int, help="frames between new tracks; 30 for windows, 10 for videos")
    parser.add_argument("--window", type=int, default=100, help="frames of a window")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--root", type=Path, help="folder of the scenes, kept; else a temporary one")
    asked = parser.parse_args()
    keep_freed_memory()  # as the command line does
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = asked.frames or (1000 if asked.what == "windows" else 24)
        count = 1 if asked.what == "windows" else asked.count
        width, height = map(int, asked.size.split("x"))
        interval = asked.interval or (_FEW_TRACKS if asked.what == "windows" else _MANY_TRACKS)
        root = make_scenes(asked.root or folder / "scenes", count, frames, (height, width), interval)
        run = windows if asked.what == "windows" else videos
        both = {}
        for workers in (1, asked.workers):
            out = folder / f"{workers}"
            out.mkdir()
            both[workers] = measure(lambda: run(root, out, workers, asked.window))  # noqa: B023 - called at once
            wall, own, children = both[workers]
            told = ", ".join(f"{seconds:.1f}" for seconds in sorted(children, reverse=True)[:workers])
            print(f"{workers} at once: {wall:.1f} s wall; CPU: {own:.1f} s here, workers {told or 'none'} s")
        cores = len(os.sched_getaffinity(0))
        expected = [own + max(max(children, default=0.0), sum(children) / cores) for _, own, children in both.values()]
        serial, spread = both[1], both[asked.workers]
        print(f"wall {serial[0] / spread[0]:.2f} times faster, by CPU time {expected[0] / expected[1]:.2f} times")
        compare(folder / "1", folder / f"{asked.workers}")


def make_scenes(root: Path, count: int, frames: int, size: tuple[int, int], query_interval: int) -> Path:
    """Make scenes with given tracks where they are not there yet; more tracks in larger images."""
    height, width = size
    for number in range(count):
        if not (root / f"scene_{number}").exists():
            scene = SyntheticSceneConfig(
                num_frames=frames, height=height, width=width, focal=width * 15 / 16, margin_px=3.0,
                grid_columns=width // 10, grid_rows=height // 10, query_interval=query_interval, frame_rate=30.0,
                seed=number,
            )  # fmt: skip
            write_native(make_synthetic_sequence(scene), root / f"scene_{number}")
    return root


def windows(root: Path, out: Path, workers: int, frames: int) -> None:
    """Reconstruct one video in windows."""
    config = load_config("default", [f"windows.frames={frames}", "windows.overlap=20", *_BARE])
    sequence = as_sequence(open_video(root / "scene_0"))
    reconstruct(sequence, out / "run", config, workers=WorkerOptions(workers=workers))


def videos(root: Path, out: Path, workers: int, _: int) -> None:
    """Reconstruct and score every video."""
    row = Configuration("default", "default", _BARE)
    names = sorted(path.name for path in root.iterdir())
    tasks = [Task("native", str(root), name, row, str(out), depth_protocols=("uni4d-scale",)) for name in names]
    execute = one_after_the_other() if workers == 1 else on_workers(WorkerOptions(workers=workers))
    failed = [result.failed for result in execute(tasks) if result.failed is not None]
    if failed:
        raise SystemExit(f"{len(failed)} runs failed: {failed[0]}")


def measure(work: Callable[[], None]) -> tuple[float, float, list[float]]:
    """Return wall time, and the CPU time of this process and of each of its children, s."""
    me, children, end = psutil.Process(), dict[int, float](), threading.Event()

    def watch() -> None:
        while not end.wait(0.3):
            for child in me.children(recursive=True):
                try:
                    spent = child.cpu_times()
                except psutil.Error:  # it has ended
                    continue
                children[child.pid] = spent.user + spent.system

    watcher = threading.Thread(target=watch, daemon=True)
    began, own = time.perf_counter(), time.process_time()
    watcher.start()
    work()
    wall, own = time.perf_counter() - began, time.process_time() - own
    end.set()
    watcher.join()
    return wall, own, list(children.values())


def compare(one: Path, other: Path) -> None:
    """Stop unless all reconstructions and depths are equal to the last bit."""
    files = sorted(p.relative_to(one) for p in one.rglob("*") if p.name in ("reconstruction.npz", "depth.npy"))
    for file in files:
        if file.suffix == ".npy":
            if (one / file).read_bytes() != (other / file).read_bytes():
                raise SystemExit(f"{file}: differs")
            continue
        with np.load(one / file) as a, np.load(other / file) as b:
            if any(a[name].tobytes() != b[name].tobytes() for name in a.files):
                raise SystemExit(f"{file}: differs")
    print(f"{len(files)} files with the same bytes: {', '.join(sorted({file.name for file in files}))}")


if __name__ == "__main__":
    main()
