"""Runs from frames alone against the truth of rendered worlds: ``python -m benchmarks.worlds.score WORLDS RUNS``.

WORLDS is what ``python -m benchmarks.worlds`` wrote. Clips that have no run in RUNS yet are reconstructed there first
(``--set`` changes fields of the configuration). Columns: error of the camera path as a part of its extent, of rotations
per frame, and of the focal length; AbsRel of static depth (after one scale for the whole video), its median, and that
of moving things; of the static pixels with confidence above 0.9, how many there are and how many are within 3 %; the
error that the summary tells; recall and precision of the masks.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.plan import plan_cues
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.confidence_store import read_confidence
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder

_STEP = 2
"""Every so many pixels are scored, along rows and columns."""
_SURE, _RIGHT = 0.9, 0.03
COLUMNS = ("clip", "path", "deg", "focal", "static", "median", "moving", "sure", "right", "told", "recall", "precision")


def made(video: Path, run: RunFolder, config: Config) -> None:
    """Reconstruct a clip from its frames alone, and keep its masks (T, H, W) beside the run as ``masks.npy``."""
    opened = open_video(video)
    sequence, _ = gather_cues(opened, plan_cues(opened, bare=True), run.root / "cues", config)
    reconstruct(sequence, run.root, config, resume=True)
    np.save(run.root / "masks.npy", np.stack([np.asarray(mask) != 0 for mask in sequence.masks]))


@dataclass(frozen=True)
class Depths:
    """Depth of every second pixel of all frames (T, h, w), in one unit."""

    found: Float32Array
    true: Float32Array
    """0 where the sky is."""
    moving: BoolArray
    confidence: Float32Array

    @classmethod
    def of(cls, run: RunFolder, truth: dict[str, np.ndarray]) -> Depths:
        """Return depth that was found and that of the truth, after one scale for the static scene."""
        true, moving = (truth[name][:, ::_STEP, ::_STEP] for name in ("depth", "moving"))
        size = truth["depth"].shape[1:]
        found = np.stack([np.asarray(depth)[::_STEP, ::_STEP] for depth in read_depth(run.depth)])
        confidence = np.zeros_like(found)
        if run.confidence.exists():
            confidence = np.stack([part[::_STEP, ::_STEP] for part in read_confidence(run.confidence, size)])
        static = (true > 0) & (found > 0) & ~moving
        scale = np.exp(np.median(np.log(true[static] / found[static])))
        return cls(found * np.float32(scale), true, moving, confidence)

    def row(self) -> tuple[float, ...]:
        """Return AbsRel of what is static, its median, that of what moves, and the parts that are sure and right."""
        known = (self.true > 0) & (self.found > 0)
        error = np.abs(self.found / np.where(known, self.true, 1) - 1)
        static, moving = known & ~self.moving, known & self.moving
        sure = static & (self.confidence > _SURE)
        right = float((error[sure] < _RIGHT).mean()) if sure.any() else float("nan")
        return (
            float(error[static].mean()), float(np.median(error[static])),
            float(error[moving].mean()) if moving.any() else float("nan"), float(sure.sum() / static.sum()), right,
        )  # fmt: skip


def score(name: str, run: RunFolder, truth: dict[str, np.ndarray]) -> list[float]:
    """Print the row of a clip and return its numbers."""
    result = load_reconstruction(run.reconstruction)
    metrics = evaluate_trajectory(result.world_T_cam, truth["world_T_cam"])
    extent = float(np.linalg.norm(np.ptp(truth["world_T_cam"][:, :3, 3], axis=0)))
    focal = float(np.mean(result.frame_intrinsics[:, :2]) / np.mean(truth["K"][:2])) - 1
    told = json.loads(run.summary.read_text(encoding="utf-8"))["stages"]["fusion"].get("depth_error", float("nan"))
    masks = np.load(run.root / "masks.npy")
    both = float((masks & truth["moving"]).sum())
    recall, precision = both / max(float(truth["moving"].sum()), 1.0), both / max(float(masks.sum()), 1.0)
    depth = Depths.of(run, truth).row()
    row = [metrics.ate_m / extent, metrics.rpe_rotation_deg or 0.0, focal, *depth, told, recall, precision]
    print(f"| {' | '.join([name, *(f'{value:.4f}' for value in row)])} |", flush=True)
    return row


def main() -> None:
    """Print one row per clip, and their means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("worlds", type=Path)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--only", nargs="+", help="names of clips")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    options = parser.parse_args()
    config = load_config("default", ["output.pictures=false", "output.clouds=false", *options.overrides])
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    rows = []
    for file in sorted((options.worlds / "gt").glob("*.npz")):
        if options.only and file.stem not in options.only:
            continue
        run = RunFolder(options.runs / file.stem)
        if not (run.root / "masks.npy").exists():
            made(options.worlds / f"{file.stem}.mp4", run, config)
        with np.load(file) as truth:
            rows.append(score(file.stem, run, {key: truth[key] for key in truth.files}))
    if rows:
        print(f"| {' | '.join(['mean', *(f'{value:.4f}' for value in np.nanmean(rows, axis=0))])} |")


if __name__ == "__main__":
    main()
