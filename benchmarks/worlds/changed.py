"""Cameras of rendered worlds whose frames are changed: ``python -m benchmarks.worlds.changed WORLDS``.

WORLDS is what ``python -m benchmarks.worlds`` wrote. Each clip is changed as other cameras, encoders and editors would
have made it, encoded again, and its cues are found from the frames alone. Columns: error of the camera path as a part
of its extent, of rotations per frame, and of focal lengths (mean, and in the worst frame); camera model, k1 and whether
a zoom was taken; seconds until cues are made; and warnings of the cameras: focal length open, ambiguous, other.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.h264 import decoded, encode
from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.load import load_config
from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.plan import plan_cues
from uni4d_fg.cues.scale_notes import NOT_METRIC
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "slam" / "lens"))
from warping import make_warp

_K1 = -0.15
_LAST_ZOOM = 1.5
_NOT_OF_CAMERAS = ("the depth of moving thing", NOT_METRIC)
"""So begin other warnings."""


@dataclass(frozen=True)
class Clip:
    """Frames, and what is true of their cameras."""

    images: ImageArray
    """(T, H, W, 3)."""
    world_T_cam: FloatArray
    """(T, 4, 4)."""
    focal: FloatArray
    """(T,) px."""
    fps: float
    kbps: int = 3500

    def mapped(self, change: Callable[[int, ImageArray], np.ndarray]) -> Clip:
        """Return the clip with frames changed one by one."""
        images = [np.clip(change(t, image), 0, 255).astype(np.uint8) for t, image in enumerate(self.images)]
        return replace(self, images=np.stack(images))

    def every(self, step: int) -> Clip:
        """Return every so many frames; a negative step goes backward."""
        taken = (self.images[::step], self.world_T_cam[::step], self.focal[::step], self.fps / abs(step))
        return Clip(*taken, self.kbps)


def _scaled(image: ImageArray, factor: float) -> ImageArray:
    """Return an image enlarged about its middle."""
    height, width = image.shape[:2]
    shift = [(1 - factor) * (side - 1) / 2 for side in (width, height)]
    matrix = np.array([[factor, 0.0, shift[0]], [0.0, factor, shift[1]]])
    return np.asarray(cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC), np.uint8)


def _through_lens(clip: Clip) -> Clip:
    """Return what a lens would have shown, with corners that the clip has seen."""
    height, width = clip.images.shape[1:3]
    pinhole = np.array([clip.focal[0], clip.focal[0], (width - 1) / 2, (height - 1) / 2])
    warp = make_warp(pinhole, Lens("SIMPLE_RADIAL", (_K1,)), (height, width))
    warped = clip.mapped(lambda _, image: warp.frame(image, cv2.INTER_CUBIC))
    return replace(warped, focal=warp.intrinsics[0] / pinhole[0] * clip.focal)


def _zoomed(clip: Clip) -> Clip:
    zoom = np.linspace(1.0, _LAST_ZOOM, len(clip.images))
    return replace(clip.mapped(lambda t, image: _scaled(image, zoom[t])), focal=zoom * clip.focal)


def _dark(clip: Clip) -> Clip:
    rng = np.random.default_rng(0)
    return clip.mapped(lambda _, image: 0.3 * image + rng.normal(0.0, 5.0, image.shape))


def _exposed(clip: Clip) -> Clip:
    """Return frames whose brightness and blue tint sway."""
    return clip.mapped(lambda t, image: image * (1 + 0.3 * np.sin(t / 6)) * np.array([1, 1, 1 + 0.1 * np.sin(t / 9)]))


CHANGES: dict[str, Callable[[Clip], Clip]] = {
    "reversed": lambda clip: clip.every(-1),
    "every2": lambda clip: clip.every(2),
    "every3": lambda clip: clip.every(3),
    "lens": _through_lens,
    "zoom": _zoomed,
    "dark": _dark,
    "exposure": _exposed,
    "350kbps": lambda clip: replace(clip, kbps=350),
}


def run(clip: Clip, folder: Path) -> str:
    """Find the cues of a clip and return its columns."""
    video = folder / "clip.mp4"
    encode(clip.images, video, clip.fps, clip.kbps, threads=1)
    opened, began = open_video(video), time.perf_counter()
    found, report = gather_cues(opened, plan_cues(opened, bare=True), folder / "cues", load_config("default", []))
    seconds = time.perf_counter() - began
    poses = found.initial_world_T_cam
    assert poses is not None
    metrics = evaluate_trajectory(poses, clip.world_T_cam)
    extent = float(np.linalg.norm(np.ptp(clip.world_T_cam[:, :3, 3], axis=0)))
    focal = found.intrinsics[0] * (np.ones(len(poses)) if found.zoom is None else found.zoom) / clip.focal - 1
    doubts = [line for line in report.warnings if not line.startswith(_NOT_OF_CAMERAS)]
    kinds = [[word in line for line in doubts] for word in ("focal length open", "ambiguous")]
    other = len(doubts) - sum(map(sum, kinds))
    model = found.lens.model + "".join(f" {k1:+.3f}" for k1 in found.lens.parameters[:1])
    told = [name for name, is_so in zip(("open", "ambiguous"), map(any, kinds), strict=True) if is_so]
    return (
        f"{metrics.ate_m / extent:.4f} | {metrics.rpe_rotation_deg or 0.0:.3f} | {focal.mean():+.3f} | "
        f"{np.abs(focal).max():.3f} | {model}{', zoom' if found.zoom is not None else ''} | {seconds:.0f} | "
        f"{', '.join(told + [f'{other} other'] * (other > 0)) or 'none'}"
    )


def main() -> None:
    """Print one row per clip and change."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("worlds", type=Path)
    parser.add_argument("--only", nargs="+", help="names of clips")
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=list(CHANGES))
    options = parser.parse_args()
    print("| clip | change | path | deg | focal | worst | camera | s | warned |\n|---|---|---|---|---|---|---|---|---|")
    for file in sorted((options.worlds / "gt").glob("*.npz")):
        if options.only and file.stem not in options.only:
            continue
        images = decoded(options.worlds / f"{file.stem}.mp4")
        with np.load(file) as truth:
            poses, focal, fps = truth["world_T_cam"], float(truth["K"][0]), float(truth["fps"])
        clip = Clip(images, poses, np.full(len(images), focal), fps)
        for change in options.changes:
            with tempfile.TemporaryDirectory() as folder:
                print(f"| {file.stem} | {change} | {run(CHANGES[change](clip), Path(folder))} |", flush=True)


if __name__ == "__main__":
    main()
