"""Dense depth against the truth: at edges and away from them, frame by frame, moving things, clouds, confidence.

    python benchmarks/depth.py NAME=SEQUENCE[:TRUTH] ... [--work FOLDER] [--set FIELD=VALUE]

SEQUENCE is a folder with true depth; TRUTH is another one with true masks, where those of the first are degraded.
Runs are kept in the working folder, so that the next call repeats fusion alone. Every figure is static and after one
scale for the whole video unless it says otherwise; each is given for the cue and, after the arrow, for fused depth:

- away, edge: AbsRel away from depth edges, and within 7 px of jumps by 15 %; flat: both together;
- broken: AbsRel of the worst frame whose cue shows nothing, over that of the median frame; named: found, missed, wrong;
- moving: AbsRel of what moves, with the scale of the static scene;
- SC: depth of frames side by side, compared through the cameras;
- off: part of the static cloud's points that are farther than 3 % of their depth from every true static surface;
- told: the error that the summary tells over the true one; sure: of the pixels with confidence above 0.9, the part
  within 3 %, and how many pixels those are.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.store import StageStore
from uni4d_fg.results.clouds import read_ply
from uni4d_fg.results.confidence_store import read_confidence
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.protocols.consistency import score_consistency
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

_EDGE_RATIO, _EDGE_PX = 1.15, 7
_FLAT_CUE = 0.01
"""A cue whose logarithm varies by less shows nothing."""


@dataclass(frozen=True)
class Scored:
    """Depth against truth."""

    scale: float
    away: float
    edge: float
    flat: float
    moving: float
    frames: FloatArray
    """(T,) static AbsRel of each frame."""


def edges(truth: Float32Array) -> BoolArray:
    """Return the pixels (H, W) near jumps of the true depth."""
    known = truth > 0
    low = cv2.erode(np.where(known, truth, np.float32(1e6)), np.ones((3, 3), np.uint8))
    high = cv2.dilate(np.where(known, truth, np.float32(0)), np.ones((3, 3), np.uint8))
    jump = ((high > _EDGE_RATIO * low) & known).astype(np.uint8)
    return np.asarray(cv2.dilate(jump, np.ones((2 * _EDGE_PX + 1,) * 2, np.uint8)) > 0)


def score(
    depths: FrameSource[Float32Array], truth: FrameSource[Float32Array], masks: FrameSource[Int32Array]
) -> Scored:
    """Score depth maps; missing pixels are left out."""
    ratios = []
    for frame in range(len(truth)):
        d, g, m = (np.asarray(source[frame])[::4, ::4] for source in (depths, truth, masks))
        with np.errstate(invalid="ignore"):
            good = (d > 0) & (g > 0) & (m == 0)
        ratios.append(np.log(g[good] / d[good]))
    scale = float(np.exp(np.median(np.concatenate(ratios))))
    sums: dict[str, list[float]] = {name: [0.0, 0.0] for name in ("away", "edge", "moving")}
    frames = np.full(len(truth), np.nan)
    for frame in range(len(truth)):
        d, g, m = (np.asarray(source[frame]) for source in (depths, truth, masks))
        with np.errstate(invalid="ignore"):
            good = (d > 0) & (g > 0)
            error = np.abs(scale * d / g - 1)
        near = edges(g)
        for name, region in (("away", (m == 0) & ~near), ("edge", (m == 0) & near), ("moving", m > 0)):
            sums[name][0] += float(error[good & region].sum())
            sums[name][1] += float(np.count_nonzero(good & region))
        frames[frame] = error[good & (m == 0)].mean()
    total = (sums["away"][0] + sums["edge"][0]) / (sums["away"][1] + sums["edge"][1])
    parts = {name: s / n if n else np.nan for name, (s, n) in sums.items()}
    return Scored(scale, parts["away"], parts["edge"], total, parts["moving"], frames)


def off_surface(
    points: FloatArray, result: Reconstruction, truth: FrameSource[Float32Array], masks: FrameSource[Int32Array],
    scale: float,
) -> float:  # fmt: skip
    """Return the part of the points (N, 3) that no frame's true static depth has within 3 %."""
    height, width = result.image_size
    off = np.ones(len(points), dtype=bool)
    for frame in range(result.num_frames):
        left = np.flatnonzero(off)
        x = world_to_camera(result.world_T_cam[frame], points[left])
        front = x[:, 2] > 1e-6
        left, x = left[front], x[front]
        uv = np.rint(
            result.lens.real_pixels(result.frame_intrinsics[frame], project(result.frame_intrinsics[frame], x))
        )
        inside = (uv >= 0).all(axis=1) & (uv[:, 0] < width) & (uv[:, 1] < height)
        left, z, (u, v) = left[inside], scale * x[inside, 2], uv[inside].astype(np.int64).T
        g = np.where(np.asarray(masks[frame]) == 0, np.asarray(truth[frame]), np.nan)
        for dv, du in ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)):
            at = g[np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)]
            with np.errstate(invalid="ignore"):
                off[left[np.abs(z / at - 1) < 0.03]] = False
    return float(off.mean())


def broken_truth(cue: FrameSource[Float32Array]) -> list[int]:
    """Return the frames whose cue is constant."""
    found = []
    for frame in range(len(cue)):
        depth = np.asarray(cue[frame])[::4, ::4]
        with np.errstate(invalid="ignore"):
            known = depth[np.isfinite(depth) & (depth > 0)]
        if known.size and float(np.log(known).std()) < _FLAT_CUE:
            found.append(frame)
    return found


def run_scene(name: str, sequence: Sequence, masks: FrameSource[Int32Array], work: Path, config: Config) -> str:
    """Fuse one scene anew and return its row."""
    folder = RunFolder(work / name)
    StageStore(folder.root / "stages").discard("fusion")
    summary = reconstruct(sequence, folder.root, config, resume=folder.root.exists())
    stage = summary.stages["fusion"]
    result = load_reconstruction(folder.reconstruction)
    truth = sequence.ground_truth.depths
    assert truth is not None
    depth = read_depth(folder.depth)
    cue, fused = score(sequence.depths, truth, masks), score(depth, truth, masks)
    broken, named = set(broken_truth(sequence.depths)), set(stage.get("broken_frames", []))
    worst = max((fused.frames[frame] for frame in broken), default=np.nan) / np.nanmedian(fused.frames)
    consistency = score_consistency(depth, masks, result.world_T_cam, result.intrinsics, lens=result.lens)
    points, _ = read_ply(folder.static_cloud)
    off = off_surface(points, result, truth, masks, fused.scale)
    told = stage.get("depth_error", np.nan) / fused.flat
    sure = _sure(folder, depth, truth, masks, fused.scale)
    pairs = [
        f"{a:.4f}>{b:.4f} ({b / a:.2f})"
        for a, b in ((getattr(cue, part), getattr(fused, part)) for part in ("flat", "away", "edge", "moving"))
    ]
    row = [
        name, *pairs, f"{worst:.2f}", f"{len(broken & named)}/{len(broken - named)}/{len(named - broken)}",
        "-" if consistency is None else f"{consistency.mean:.4f}", f"{100 * off:.2f} %", f"{told:.2f}", sure,
        f"{stage['seconds']:.0f} s",
    ]  # fmt: skip
    return "| " + " | ".join(row) + " |"


def _sure(
    folder: RunFolder, depth: FrameSource[Float32Array], truth: FrameSource[Float32Array],
    masks: FrameSource[Int32Array], scale: float,
) -> str:  # fmt: skip
    """Say how many of the static pixels that are said to be sure are right."""
    if not folder.confidence.exists():
        return "-"
    height, width = np.asarray(truth[0]).shape
    confidence = read_confidence(folder.confidence, (height, width))
    right = said = known = 0
    for frame in range(len(truth)):
        d, g, m = (np.asarray(source[frame]) for source in (depth, truth, masks))
        with np.errstate(invalid="ignore"):
            good = (d > 0) & (g > 0) & (m == 0)
            near = np.abs(scale * d / g - 1) < 0.03
        chosen = good & (np.asarray(confidence[frame]) > 0.9)
        right, said, known = right + int((chosen & near).sum()), said + int(chosen.sum()), known + int(good.sum())
    return f"{right / max(said, 1):.3f} of {said / max(known, 1):.2f}"


def main() -> None:
    """Print one row per scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--work", type=Path, default=Path("runs"))
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    options = parser.parse_args()
    config = load_config("default", ["output.pictures=false", *options.overrides])
    columns = ["scene", "flat", "away", "edge", "moving", "broken", "named", "SC", "off", "told", "sure", "fusion"]
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns))
    for scene in options.scenes:
        name, _, folders = scene.partition("=")
        given, _, true = folders.partition(":")
        sequence = read_sequence(Path(given))
        other = read_sequence(Path(true)) if true else sequence
        masks = other.masks if other.ground_truth.masks is None else other.ground_truth.masks
        assert masks is not None
        print(run_scene(name, sequence, masks, options.work, config), flush=True)


if __name__ == "__main__":
    main()
