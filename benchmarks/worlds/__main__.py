"""Render worlds: ``python -m benchmarks.worlds OUT [--only NAME ...] [--frames N] [--check]``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.h264 import decoded, encode
from benchmarks.worlds.catalog import WORLDS
from benchmarks.worlds.film import Filming, World
from benchmarks.worlds.truth import FrameTruth, frame_truth, save, warp_difference
from uni4d_fg.arrays import ImageArray


def render(world: World, out: Path, frames: int) -> None:
    """Write a world's video and truth, and print seconds per frame."""
    began = time.perf_counter()
    filming = Filming(world)
    built = time.perf_counter()
    truths: list[FrameTruth] = []

    def images() -> Iterator[ImageArray]:
        for frame in range(frames):
            truths.append(frame_truth(filming, frame))
            yield filming.image(frame)

    out.mkdir(parents=True, exist_ok=True)
    encode(images(), out / f"{world.name}.mp4", world.fps, world.kbps, threads=1)
    spent = (time.perf_counter() - built) / frames
    save(out / "gt" / f"{world.name}.npz", filming, truths)
    share = np.mean([truth.moving.mean() for truth in truths])
    print(
        f"{world.name}: {frames} frames of {world.width} x {world.height} at {world.fps:g} Hz, built in "
        f"{built - began:.1f} s, {spent:.2f} s per frame, {100 * share:.1f} % moving",
        flush=True,
    )


def check(name: str, out: Path) -> None:
    """Print how well static points keep their gray value from frame to frame."""
    images = decoded(out / f"{name}.mp4")
    with np.load(out / "gt" / f"{name}.npz") as truth:
        arrays = {key: truth[key] for key in truth.files}
    if len(images) < 2:
        return
    parts = (images, arrays["world_T_cam"], arrays["K"], arrays["depth"], arrays["instance"])
    near, far = (warp_difference(*parts, gap) for gap in (1, min(10, len(images) - 1)))
    print(f"{name}: median gray difference {near:.2f} after 1 frame, {far:.2f} after 10", flush=True)


def main() -> None:
    """Render the worlds that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="*", choices=sorted(WORLDS), default=list(WORLDS))
    parser.add_argument("--frames", type=int, help="fewer than the world has")
    parser.add_argument("--check", action="store_true", help="compare images across frames instead of rendering")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for name in arguments.only:
        if not arguments.check:
            world = WORLDS[name]()
            render(world, arguments.out, min(arguments.frames or world.frames, world.frames))
        check(name, arguments.out)


if __name__ == "__main__":
    main()
