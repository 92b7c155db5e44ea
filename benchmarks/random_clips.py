"""Cameras and masks of random synthetic clips without masks, from the video alone or beside a depth cue.

    python benchmarks/random_clips.py [--first 0] [--count 20] [--depth] [--set geometric_depth.trim_rounds=0]

Clips differ in size (240 to 640 px), length (10 to 49 frames), rate, path, speed, focal length, in what moves and how
large it is, and in blur, noise and brightness. Columns: error of the camera path as a part of its extent and of
rotations per frame, focal length (of the longer image side) with its interval, recall and precision of the masks,
seconds of one core, and what the command warns of. Cameras are wrong from 4 % of the extent or 0.2 degrees per frame
on; those that nothing is said of are counted. A camera that only turns has no path: rotations are judged.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.plan import plan_cues
from uni4d_fg.cues.scale_notes import NOT_METRIC
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence, Video
from uni4d_fg.frontend.synthetic import make_synthetic_sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.run_folder import RunFolder

WRONG_PATH, WRONG_DEGREES = 0.04, 0.2
_PATHS = ("handheld", "handheld", "forward", "rotation")


def clip(number: int) -> tuple[Sequence, Video]:
    """Return a random scene with its truth, and its bare video."""
    rng = np.random.default_rng(1000 + number)
    frames, width = int(rng.integers(10, 50)), int(rng.choice([240, 320, 480, 640]))
    height = int(width * rng.choice([0.5625, 0.75])) // 2 * 2
    if rng.random() < 0.2:
        width, height = height, width
    objects, path = rng.choice(["none", "rigid", "deforming", "both", "both"]), rng.choice(_PATHS)
    focal, speed = max(width, height) * rng.uniform(0.7, 1.3), rng.uniform(0.15, 0.9)
    scale, kinds = rng.uniform(0.6, 1.6), int(rng.integers(1, 3))
    blur, noise = float(rng.choice([0, 0, 1, 2])), float(rng.choice([0, 2, 6]))
    sequence = make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=frames, height=height, width=width, focal=float(focal), path=str(path), objects=str(objects),
            camera_speed=float(speed), object_scale=float(scale), objects_per_kind=kinds, grid_columns=4, grid_rows=4,
            seed=number, frame_rate=float(rng.choice([10, 15, 30])),
        )
    )  # fmt: skip
    images = np.stack(list(sequence.images)).astype(np.float64)
    if blur:
        images = np.stack([cv2.GaussianBlur(image, (0, 0), blur) for image in images])
    images += rng.normal(scale=noise, size=images.shape) if noise else 0.0
    gain = 1.0 + 0.1 * np.sin(np.arange(frames) / 3) * (rng.random() < 0.3)
    images = np.clip(images * gain[:, None, None, None], 0, 255).astype(np.uint8)
    return sequence, Video(f"clip {number}", ArrayFrames(images), sequence.image_size, sequence.timestamps)


def score(number: int, with_depth: bool, config: Config) -> tuple[bool, bool]:
    """Print the row of a clip; return whether its cameras are wrong, and whether anything is said of them."""
    sequence, video = clip(number)
    if with_depth:
        video = replace(video, depths=sequence.depths)
    truth, began = sequence.ground_truth, time.process_time()
    assert truth.world_T_cam is not None
    assert truth.intrinsics is not None
    with tempfile.TemporaryDirectory() as folder:
        made, report = gather_cues(video, plan_cues(video, bare=True), Path(folder), config)
        poses, warnings = made.initial_world_T_cam, [w for w in report.warnings if w != NOT_METRIC]
        if poses is None:
            poses = reconstruct(made, Path(folder) / "run", config).world_T_cam
            warnings += json.loads(RunFolder(Path(folder) / "run").summary.read_text(encoding="utf-8"))["warnings"]
        masks = np.stack([np.asarray(mask) != 0 for mask in made.masks])
    seconds = time.process_time() - began
    true = np.stack([np.asarray(mask) != 0 for mask in (truth.masks or sequence.masks)])
    metrics = evaluate_trajectory(poses, truth.world_T_cam)
    extent = float(np.linalg.norm(np.ptp(truth.world_T_cam[:, :3, 3], axis=0)))
    path = metrics.ate_m / extent if extent > 1e-6 else 0.0
    degrees = metrics.rpe_rotation_deg or 0.0
    side = max(video.image_size)
    low, high = (px / side for px in report.start.get("focal_interval_px", (0.0, 0.0)))
    focal = report.start.get("focal_px", 0.0) / side
    both = float((masks & true).sum())
    height, width = video.image_size
    row = (
        number, f"{len(masks)} of {width}x{height}", f"{100 * path:.2f} %", f"{degrees:.3f}",
        f"{focal:.2f} ({low:.2f} to {high:.2f}; true {truth.intrinsics[0] / side:.2f})", f"{100 * true.mean():.0f}",
        f"{both / max(true.sum(), 1):.2f}", f"{both / max(masks.sum(), 1):.2f}", f"{seconds:.0f}", "; ".join(warnings),
    )  # fmt: skip
    print(f"| {' | '.join(str(cell) for cell in row)} |", flush=True)
    return path > WRONG_PATH or degrees > WRONG_DEGREES, bool(warnings)


def main() -> None:
    """Print one row per clip, and how many cameras are wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--depth", action="store_true", help="give the scene's depth cue")
    parser.add_argument("--set", nargs="*", default=[], help="of the configuration")
    options = parser.parse_args()
    config = load_config("default", ["output.clouds=false", "output.pictures=false", *options.set])
    columns = "clip, frames, path, deg/frame, focal length, moving %, recall, precision, s, warnings"
    print(f"| {columns.replace(', ', ' | ')} |\n|{'---|' * len(columns.split(', '))}")
    results = [score(number, options.depth, config) for number in range(options.first, options.first + options.count)]
    wrong = [said for is_wrong, said in results if is_wrong]
    print(f"\n{len(wrong)} of {len(results)} wrong, {wrong.count(False)} of them without a word")


if __name__ == "__main__":
    main()
