"""Small videos and tasks that several tests of benchmarks use."""

from __future__ import annotations

from pathlib import Path

from uni4d_fg.pipeline.benchmark.task import Configuration, Task

SCENE = [
    "--frames", "7", "--width", "80", "--height", "60", "--set", "focal=75", "--set", "grid_columns=14",
    "--set", "grid_rows=10", "--set", "query_interval=4", "--set", "margin_px=3", "--quiet",
]  # fmt: skip
"""Options of ``synthesize``."""
CONFIG = ("output.clouds=false", "output.pictures=false", "camera.zoom=off")
"""Seven frames of 80 px are too few to tell a zoom, and other programs' files have one K."""


def synthesize(root: Path, layout: str, *videos: str, scene: list[str] = SCENE) -> None:
    """Write videos in the layout of a dataset, their cues in ``root/cues``."""
    from uni4d_fg.cli import main

    for seed, video in enumerate(videos):
        words = ["synthesize", str(root), "--as", layout, "--video", video, "--seed", str(seed), *scene]
        assert main.run(words) == 0


def sintel_task(root: Path, out: Path, **changes: object) -> Task:
    """The video alley_2 by the preset 'fast'."""
    ways = Configuration("fast", "fast", CONFIG, **changes)  # type: ignore[arg-type]
    return Task("sintel", str(root), "alley_2", ways, str(out), str(root / "cues"), None, ("sim3",), ("uni4d-scale",))
