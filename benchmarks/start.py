"""Cameras from video alone under changes of the video that should not matter, against each other.

    UNI4D_FG_DATA=... python benchmarks/start.py [--clips lady_running kitchen kitchen_dog] [--synthetic 10]
        [--changes plain 640 480 reversed mirrored every2 trimmed] [--masks] [--incremental]

Neither intrinsics nor depth nor masks are given. Columns: focal length as a part of the longer image side and the
interval that is reported for it; camera path against that of the unchanged video after Sim(3), as a part of its extent
(RMS), and turns per frame; the same against the truth, where there is one; frames posed; CPU seconds; warnings.
``--masks`` takes the cameras that follow when what moves was found; without it, those from all tracks.
``--incremental`` adds pycolmap's incremental mapper (SIFT, the masks found where ``--masks``), one row per clip.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray, IntArray
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.geometric_depth import depth_from_motion
from uni4d_fg.cues.plan import plan_cues
from uni4d_fg.frontend.sequence.calibration import guess_intrinsics
from uni4d_fg.frontend.sequence.model import ArrayFrames, Video
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.resize import resize_video
from uni4d_fg.frontend.synthetic import make_synthetic_sequence
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory

CHANGES = ("plain", "640", "480", "reversed", "mirrored", "every2", "trimmed")
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Cameras:
    """Cameras of some frames of a clip, in the order of the clip and not mirrored."""

    frame: IntArray
    """(t,) ascending."""
    world_T_cam: FloatArray
    """(t, 4, 4)."""
    focal: float = 0.0
    """As a part of the longer image side."""
    interval: tuple[float, float] = (0.0, 0.0)
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    masks: list[ImageArray] | None = None


def clips(names: list[str], synthetic: int) -> Iterator[tuple[str, Video, FloatArray | None]]:
    """Yield name, bare video and true cameras (T, 4, 4), where there are any."""
    for name in names:
        folder = Path(os.environ["UNI4D_FG_DATA"]) / name
        truth = folder / "c2w.npy"
        yield name, bare(open_video(folder)), np.load(truth) if truth.is_file() else None
    kinds = [(path, objects) for objects in ("none", "rigid", "both") for path in ("handheld", "forward")]
    for number in range(synthetic):
        path, objects = kinds[number % len(kinds)]
        config = SyntheticSceneConfig(
            num_frames=48, width=640, height=480, focal=560.0 + 40.0 * (number % 4), path=path, objects=objects,
            camera_speed=0.42 + 0.14 * (number % 3), grid_columns=4, grid_rows=4,
        )  # fmt: skip
        sequence = make_synthetic_sequence(config)
        name = f"synthetic {number} ({path}, {objects})"
        video = Video(name, sequence.images, sequence.image_size, sequence.timestamps)
        yield name, bare(video), sequence.ground_truth.world_T_cam


def bare(video: Video) -> Video:
    """Return a video without any cue, its frames in memory."""
    return Video(video.name, ArrayFrames(np.stack(list(video.images))), video.image_size, video.timestamps)


def changed(video: Video, change: str) -> tuple[Video, IntArray]:
    """Return the changed video and the frame of the clip that each of its frames is."""
    kept = np.arange(video.num_frames)
    if change.isdigit():
        return bare(resize_video(video, int(change))), kept
    kept = {"reversed": kept[::-1], "every2": kept[::2], "trimmed": kept[10:-10]}.get(change, kept)
    frames = np.stack([video.images[frame] for frame in kept.tolist()])
    frames = np.ascontiguousarray(frames[:, :, ::-1]) if change == "mirrored" else frames
    return replace(video, images=ArrayFrames(frames), timestamps=video.timestamps[: len(kept)]), kept


def solve(video: Video, frames: IntArray, change: str, config: Config, with_masks: bool) -> Cameras:
    """Find the cameras of a changed video."""
    side = float(max(video.image_size))
    if with_masks:
        with tempfile.TemporaryDirectory() as folder:
            began = time.process_time()
            sequence, report = gather_cues(video, plan_cues(video, bare=True), Path(folder), config)
            seconds = time.process_time() - began
            assert sequence.initial_world_T_cam is not None
            poses, start, warnings = sequence.initial_world_T_cam, report.start, tuple(report.warnings[1:])
            masks = [np.asarray(mask != 0).astype(np.uint8) for mask in sequence.masks]
    else:
        tracks = track_grid(video.images, config.tracking)
        began = time.process_time()
        static = np.ones(tracks.num_tracks, dtype=bool)
        found = depth_from_motion(video, tracks, static, guess_intrinsics(video.image_size), config)
        seconds = time.process_time() - began
        poses, start, warnings, masks = found.world_T_cam, found.start, found.warnings, None
    if change == "mirrored":
        poses = MIRROR @ poses @ MIRROR
    order = np.argsort(frames)
    low, high = start.get("focal_interval_px", (0.0, 0.0))
    focal = float(start.get("focal_px", 0.0)) / side
    return Cameras(frames[order], poses[order], focal, (low / side, high / side), seconds, warnings, masks)


def incremental(video: Video, masks: list[ImageArray] | None) -> Cameras | None:
    """Return what pycolmap's incremental mapper finds."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("images", "masks"):
            (folder / part).mkdir()
        for frame, image in enumerate(video.images):
            cv2.imwrite(str(folder / "images" / f"{frame:06d}.png"), image[..., ::-1])
            if masks is not None:
                free = np.where(masks[frame] != 0, 0, 255).astype(np.uint8)
                cv2.imwrite(str(folder / "masks" / f"{frame:06d}.png.png"), free)
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_PINHOLE"
        if masks is not None:
            reader.mask_path = str(folder / "masks")
        database = folder / "database.db"
        began = time.process_time()
        pycolmap.extract_features(
            database, folder / "images", camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
        )
        pairing = pycolmap.SequentialPairingOptions()
        pairing.loop_detection = False
        pycolmap.match_sequential(database, pairing_options=pairing)
        maps = pycolmap.incremental_mapping(database, folder / "images", folder)
        if not maps:
            return None
        best = max(maps.values(), key=lambda found: found.num_reg_images())
        poses = {}
        for image in best.images.values():
            if image.has_pose:
                cam_T_world = np.eye(4)
                cam_T_world[:3] = image.cam_from_world().matrix()
                poses[int(image.name[:6])] = np.linalg.inv(cam_T_world)
        camera = next(iter(best.cameras.values()))
        focal = float(camera.params[0]) / max(video.image_size)
        frames = sorted(poses)
        seconds = time.process_time() - began
        return Cameras(np.array(frames), np.stack([poses[f] for f in frames]), focal, (focal, focal), seconds)


def difference(found: Cameras, frames: IntArray, truth: FloatArray) -> str:
    """Return how far cameras are from others after Sim(3), on the frames that both have."""
    common, a, b = np.intersect1d(found.frame, frames, return_indices=True)
    if len(common) < 3:
        return "none | none"
    metrics = evaluate_trajectory(found.world_T_cam[a], truth[b])
    extent = float(np.linalg.norm(np.ptp(truth[b][:, :3, 3], axis=0)))
    return f"{100 * metrics.ate_m / extent:.2f} % | {metrics.rpe_rotation_deg:.3f}"


def main() -> None:
    """Print one row per clip and change."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="*", default=["lady_running", "kitchen", "kitchen_dog"])
    parser.add_argument("--synthetic", type=int, default=10)
    parser.add_argument("--changes", nargs="+", default=list(CHANGES))
    parser.add_argument("--masks", action="store_true")
    parser.add_argument("--incremental", action="store_true")
    options = parser.parse_args()
    config = load_config("default", [])
    columns = "clip, change, focal length, interval, path, deg/frame, to truth: path, deg/frame, frames, s, warnings"
    print(f"| {columns.replace(', ', ' | ')} |")
    print(f"|{'---|' * len(columns.split(', '))}")
    for name, video, truth in clips(options.clips, options.synthetic):
        first: Cameras | None = None
        for change in options.changes:
            if change.isdigit() and int(change) >= max(video.image_size):
                continue
            found = solve(*changed(video, change), change, config, options.masks)
            first = first or found
            row(name, change, found, first, truth)
        if options.incremental and first is not None:
            other = incremental(video, first.masks)
            if other is None:
                print(f"| {name} | incremental | none |")
            else:
                row(name, "incremental", other, first, truth)


def row(name: str, change: str, found: Cameras, first: Cameras, truth: FloatArray | None) -> None:
    """Print one row."""
    against = "| " if truth is None else difference(found, np.arange(len(truth)), truth)
    low, high = found.interval
    print(
        f"| {name} | {change} | {found.focal:.4f} | {low:.4f} to {high:.4f} "
        f"| {difference(found, first.frame, first.world_T_cam)} | {against} | {len(found.frame)} | {found.seconds:.1f} "
        f"| {'; '.join(found.warnings)} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
