"""The viewer in a real browser: time to the first picture, frames a second while the view turns, time of a switch.

    python benchmarks/viewer.py [--points 3000000] [--frames 60] [--moving 20000] [--size 800x450] [--seconds 10]

A run is made of the walls of a room and a ball that moves through it; `uni4d-fg view` shows it, and chromium (by
playwright, with software rendering) opens it. The time to the first picture counts from the start of the command to
the first frame in which points are drawn. Frames are counted where the page draws clouds (`window.uni4dDetail`) while
the mouse turns the view, at a frame that has trails, after two seconds in which the page learns how much it can draw.
The time of a switch is that from a key press to the panel telling the next frame, which it does when the picture has
been given to the browser to draw; and, in a second series, to the end of its drawing, when its pixels can be read. The
next key is pressed at once.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.arrays import ImageArray
from uni4d_fg.results.clouds import write_clouds
from uni4d_fg.results.io import save_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

PORT = 8761
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LEARNING_S = 2.0


def room(count: int, rng: np.random.Generator) -> tuple[np.ndarray, ImageArray]:
    """Points on the floor and on three walls of a room in front of the camera, with a pattern."""
    wall = rng.integers(0, 4, count)
    a, b = rng.uniform(-2.0, 2.0, count), rng.uniform(-1.0, 1.0, count)
    depth = 3.0 + rng.uniform(-2.0, 2.0, count)
    points = np.stack((a, b, np.full(count, 5.0)), axis=1)
    points[wall == 1] = np.stack((a, np.full(count, 1.0), depth), axis=1)[wall == 1]
    points[wall == 2] = np.stack((np.full(count, -2.0), b, depth), axis=1)[wall == 2]
    points[wall == 3] = np.stack((np.full(count, 2.0), b, depth), axis=1)[wall == 3]
    checks = (np.floor(4.0 * points).sum(axis=1) % 2)[:, None]
    return points, (60 + 120 * checks + 60 * rng.random((count, 3))).astype(np.uint8)


def make_run(folder: Path, points: int, frames: int, moving: int) -> None:
    """Write a run that is only to be looked at."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.3, 0.3, frames)
    static, colors = room(points, rng)
    ball = rng.normal(size=(moving, 3))
    ball *= 0.3 / np.linalg.norm(ball, axis=1, keepdims=True)
    path = np.stack((np.linspace(-1.0, 1.0, frames), np.zeros(frames), np.full(frames, 3.0)), axis=1)
    tracks = ball[:300, None] + path[None]
    save_reconstruction(
        RunFolder(folder).reconstruction,
        Reconstruction(
            world_T_cam=poses,
            intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
            timestamps=np.arange(frames) / 30.0,
            image_size=(480, 640),
            depth_log_scale=np.zeros(frames),
            landmarks=static[:2000],
            landmark_track=np.arange(2000, dtype=np.int32),
            landmark_color=colors[:2000],
            landmark_error=np.ones(2000, np.float32),
            dynamic_points=tracks,
            dynamic_observed=np.ones(tracks.shape[:2], bool),
            dynamic_track=np.arange(2000, 2300, dtype=np.int32),
            dynamic_instance=np.ones(300, np.int32),
            dynamic_color=np.full((300, 3), 200, np.uint8),
        ),
    )
    RunFolder(folder).summary.write_text("{}")
    shade = (120 + 100 * ball / 0.3).clip(0, 255).astype(np.uint8)
    write_clouds(RunFolder(folder), (static, colors), ((ball + place, shade) for place in path))


def _answers() -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{PORT}"):
            return True
    except OSError:
        return False


def first_picture(page: Any, began: float) -> float:
    """Open the page as soon as it answers; seconds from ``began`` to the first drawn cloud."""
    # A page that cannot be reached costs the browser a page of its own, and the program's start the processor.
    while not _answers():
        time.sleep(0.01)
    page.goto(f"http://127.0.0.1:{PORT}", wait_until="commit")
    page.wait_for_function("window.uni4dDetail && window.uni4dDetail.frames > 0", polling=20, timeout=120_000)
    return time.perf_counter() - began


def turning_rate(page: Any, seconds: float) -> tuple[float, float]:
    """Turn the view; frames a second, and the mean number of points in a frame."""
    page.mouse.move(300, 220)
    page.mouse.down()
    began = time.perf_counter()
    counted, frames, drawn = None, 0, []
    while (passed := time.perf_counter() - began) < LEARNING_S + seconds:
        page.mouse.move(300 + 80 * np.sin(passed), 220)
        state = page.evaluate("[window.uni4dDetail.frames, window.uni4dDetail.drawn]")
        if passed > LEARNING_S:
            counted = counted or (time.perf_counter(), state[0])
            drawn.append(state[1])
        frames = state[0]
    page.mouse.up()
    assert counted is not None
    return (frames - counted[1]) / (time.perf_counter() - counted[0]), float(np.mean(drawn))


_SWITCH = """async (drawn) => {
  const text = () => Number(/frame (\\d+) of/.exec(document.body.textContent)?.[1]);
  const key = (kind) => document.body.dispatchEvent(
    new KeyboardEvent(kind, { key: "ArrowRight", code: "ArrowRight", bubbles: true }));
  const canvas = [...document.querySelectorAll("canvas")].sort((one, other) => other.width - one.width)[0];
  const gl = canvas.getContext("webgl2"), before = text(), began = performance.now();
  key("keydown");
  key("keyup");
  while (text() === before && performance.now() - began < 5000) await new Promise((go) => setTimeout(go, 1));
  if (drawn) gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return performance.now() - began;
}"""
FRAMES_WITH_TRAILS = 12
SWITCHES = 15


def switch_times(page: Any, count: int, *, drawn: bool) -> np.ndarray:
    """Go on by so many frames; milliseconds of each, to the text or to the end of the drawing."""
    before = page.evaluate("window.uni4dDetail.frames")
    times = np.array([page.evaluate(_SWITCH, drawn) for _ in range(count)])
    page.evaluate("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
    assert page.evaluate("window.uni4dDetail.frames") - before >= count, "a switch drew no picture"
    return times


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=3_000_000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--moving", type=int, default=20_000)
    parser.add_argument("--size", default="800x450")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--run", type=Path, help="a run to show instead")
    arguments = parser.parse_args()
    from playwright.sync_api import sync_playwright

    width, height = (int(side) for side in arguments.size.split("x"))
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as driver:
        run = arguments.run or Path(scratch)
        if arguments.run is None:
            make_run(run, arguments.points, arguments.frames, arguments.moving)
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_context(viewport={"width": width, "height": height}).new_page()
        began = time.perf_counter()
        command = [sys.executable, "-m", "uni4d_fg.cli.main", "view", str(run), "--port", str(PORT)]
        process = subprocess.Popen(command, env=os.environ, stdout=subprocess.PIPE, text=True)
        try:
            print(f"first picture: {first_picture(page, began):.1f} s", flush=True)
            wanted = 0
            while wanted < page.evaluate("window.uni4dDetail.wanted") or wanted < 100_000:
                wanted = page.evaluate("window.uni4dDetail.wanted")
                time.sleep(3.0)
                if time.perf_counter() - began > 120.0:
                    break
            print(f"all there: {time.perf_counter() - began:.0f} s, {wanted:.0f} points to see", flush=True)
            switch_times(page, FRAMES_WITH_TRAILS, drawn=True)
            rate, points = turning_rate(page, arguments.seconds)
            print(f"turning: {rate:.1f} frames a second, {points:.0f} points in each", flush=True)
            for what, drawn in (("", False), (", to the end of its drawing", True)):
                times = switch_times(page, SWITCHES, drawn=drawn)
                print(
                    f"switch of frame{what}: median {np.median(times):.0f} ms, worst {times.max():.0f} ms", flush=True
                )
        finally:
            process.terminate()
            process.wait()
            browser.close()


if __name__ == "__main__":
    main()
