"""Drift of the built-in tracker on compressed video, and what it does to the scale of the camera's path.

    pip install av; python benchmarks/drift.py [--kbps 1000] [--set tracking.refine=off]

A synthetic scene of 640 x 480 is rendered, encoded as H.264 and decoded. The built-in tracker follows a coarse grid
through it. Drift is the distance of a static point from where the point of its query pixel projects in truth, after 5,
20 and 40 frames. Then the cameras are solved with true depth and true intrinsics: their path is longer or shorter than
the truth by what the tracks say wrongly.
"""

from __future__ import annotations

import argparse
import io
import time
from dataclasses import dataclass, replace

import numpy as np
from h264 import decoded, encode

from uni4d_fg.config.load import load_config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic.simulate import simulate
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.depth_sampling import sample_depth
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver

RATE = 30
COARSE = ["grid_columns=16", "grid_rows=16", "query_interval=20", "reseed_spacing=null"]


def compressed(images: np.ndarray, kbps: int) -> np.ndarray:
    """Return images (T, H, W, 3) as they come out of an H.264 file of a bit rate."""
    file = io.BytesIO()
    encode(images, file, RATE, kbps)
    file.seek(0)
    return decoded(file)


@dataclass(frozen=True)
class Truth:
    """Where the points of tracks are in truth."""

    uv: np.ndarray
    """(K, T, 2) px."""
    seen: np.ndarray
    """(K, T) static, in the image and not hidden."""

    @classmethod
    def of(cls, tracks: Tracks, scene: Sequence, masks: np.ndarray) -> Truth:
        """Lift the query pixels with true depth, and project them into every frame."""
        poses, intrinsics, depths = (
            scene.ground_truth.world_T_cam, scene.ground_truth.intrinsics, scene.ground_truth.depths,
        )  # fmt: skip
        assert poses is not None
        assert intrinsics is not None
        assert depths is not None
        height, width = scene.image_size
        frames = np.arange(tracks.num_frames)
        points = np.full((tracks.num_tracks, 3), np.nan)
        for t in frames:
            row = np.flatnonzero(tracks.query_frame == t)
            uv = tracks.uv[row, t]
            # Its reciprocal is linear on a plane.
            z = 1.0 / sample_depth((1.0 / depths[int(t)]).astype(np.float32), uv, 0.01, 100.0, 0.03).astype(float)
            z[masks[t][np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)] != 0] = np.nan
            x = unproject(intrinsics, uv.astype(float), z)
            points[row] = camera_to_world(np.broadcast_to(poses[t], (len(row), 4, 4)), x)
        uv, seen = np.full(tracks.uv.shape, np.nan), np.zeros(tracks.visible.shape, bool)
        for t in frames:
            x = world_to_camera(np.broadcast_to(poses[t], (len(points), 4, 4)), points)
            uv[:, t] = project(intrinsics, x)
            inside = ((uv[:, t] >= 0) & (uv[:, t] <= (width - 1, height - 1))).all(axis=1)
            column, line = np.rint(np.where(inside[:, None], uv[:, t], 0)).astype(int).T
            same = np.abs(depths[int(t)][line, column] / x[:, 2] - 1) < 0.03
            seen[:, t] = inside & same & (masks[t][line, column] == 0)
        return cls(uv, seen)


def report_drift(tracks: Tracks, truth: Truth) -> None:
    """Print the drift by the distance from the query frame, and how many points are still followed."""
    error = np.linalg.norm(tracks.uv - truth.uv, axis=2)
    age = np.abs(np.arange(tracks.num_frames) - tracks.query_frame[:, None])
    for frames in (5, 20, 40):
        there = (age == frames) & truth.seen
        found = error[there & tracks.visible]
        print(
            f"after {frames} frames: median {np.median(found):.3f} px, 90 % within {np.quantile(found, 0.9):.2f} px, "
            f"{len(found) / there.sum():.3f} of those in sight"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kbps", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--path", default="handheld")
    parser.add_argument("--objects", default="none")
    parser.add_argument("--set", nargs="*", default=[], help="changes of the configuration")
    arguments = parser.parse_args()
    simulation = simulate(
        SyntheticSceneConfig(
            num_frames=arguments.frames, height=480, width=640, focal=600.0, frame_rate=RATE, path=arguments.path,
            objects=arguments.objects, grid_columns=2, grid_rows=2,
        )
    )  # fmt: skip
    scene = simulation.sequence
    truth, intrinsics = scene.ground_truth.world_T_cam, scene.ground_truth.intrinsics
    assert truth is not None
    assert intrinsics is not None
    assert scene.ground_truth.depths is not None
    images = np.stack(list(scene.images))
    seen = compressed(images, arguments.kbps)
    noise = 10 * np.log10(255.0**2 / np.mean((seen.astype(float) - images) ** 2))
    config = load_config(None, [*(f"tracking.{field}" for field in COARSE), *arguments.set])
    began = time.perf_counter()
    tracks = track_grid(ArrayFrames(seen), config.tracking)
    print(
        f"{arguments.kbps} kbit/s, PSNR {noise:.1f} dB, {tracks.num_tracks} tracks, {time.perf_counter() - began:.1f} s"
    )
    report_drift(tracks, Truth.of(tracks, scene, simulation.masks))
    given = replace(
        scene, images=ArrayFrames(seen), depths=scene.ground_truth.depths, masks=ArrayFrames(simulation.masks),
        intrinsics=intrinsics, tracks=tracks,
    )  # fmt: skip
    labelled = label_tracks(tracks, given, config.labels, config.input)
    solver = StaticSceneSolver(config, stage_runner(config), timestamps=given.timestamps)
    start = solver.initialize(labelled, intrinsics, free_intrinsics=False)
    solved = solver.adjust(labelled, start.cameras, intrinsics, Freedom(poses=True, intrinsics=False))
    found = evaluate_trajectory(solved.cameras.world_T_cam, truth)
    print(f"path {100 * (1 / found.scale - 1):+.2f} % too long, ATE {1e3 * found.ate_m:.2f} mm")


if __name__ == "__main__":
    main()
