"""Tracks of a scene seen by cameras with a lens or a zoom, and the cameras that are found from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cues.start_scenes import GUESS, SIZE, K, TrackedScene, camera_path, observed

from uni4d_fg.config.load import load_config
from uni4d_fg.cues.structure.motion import Structure, structure_from_motion
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.progress import SilentReporter
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.lens.camera_model import CameraModel

FRAMES = 20


def through(scene: TrackedScene, camera: CameraModel) -> TrackedScene:
    """Return the observations of a scene as another camera has them, as far as they are in its image."""
    seen = scene.observations
    uv = camera.real(seen.uv, seen.frame)
    height, width = SIZE
    inside = (uv >= 0).all(axis=1) & (uv <= [width - 1, height - 1]).all(axis=1)
    return replace(scene, observations=replace(seen, uv=uv).select(inside).with_min_observations(2))


def panned(seed: int, points: int) -> TrackedScene:
    """Return what a camera sees that turns by 92 degrees and moves by 0.3 m, of points 3 to 40 m away all around."""
    rng = np.random.default_rng(seed)
    yaw, away = rng.uniform(-0.8, 2.4, points), np.exp(rng.uniform(np.log(3.0), np.log(40.0), points))
    places = away[:, None] * np.stack([np.sin(yaw), rng.uniform(-0.5, 0.5, points), np.cos(yaw)], axis=1)
    poses = camera_path(FRAMES, (0.3, 0.0, 0.05), (0.0, 1.6, 0.0))
    rows = list[tuple[np.ndarray, ...]]()
    for frame, pose in enumerate(poses):
        there = world_to_camera(pose, places)
        uv = project(K, there) + rng.normal(0, 0.2, (points, 2))
        # Wider than the image: a lens may bring more of it in.
        seen = np.flatnonzero((there[:, 2] > 0.3) & (np.abs(uv - K[2:]) < 1.25 * max(SIZE)).all(axis=1))
        rows.append((seen, np.full(len(seen), frame), uv[seen]))
    return TrackedScene(observed(rows), poses, np.zeros(points, dtype=bool))


def ramp(ratio: float) -> np.ndarray:
    """Return the zoom of the frames, (T,), from one end to the other; the longest is 1."""
    zoom = ratio ** np.linspace(0.0, 1.0, FRAMES)
    return zoom / zoom.max()


def structure(scene: TrackedScene, *changes: str, camera: CameraModel | None = None) -> Structure:
    found = structure_from_motion(
        scene.observations, FRAMES, SIZE, GUESS, load_config("default", list(changes)), SilentReporter(),
        lambda: False, camera=camera, any_camera=True,
    )  # fmt: skip
    assert found is not None
    return found


def path_error(found: Structure, scene: TrackedScene) -> float:
    extent = np.linalg.norm(np.ptp(scene.world_T_cam[:, :3, 3], axis=0))
    return evaluate_trajectory(found.world_T_cam, scene.world_T_cam).ate_m / float(extent)
