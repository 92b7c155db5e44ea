"""Long walks through static worlds: one that comes back to where it began, and others that never do.

The camera goes round in the furnished room and looks at its walls. Tracks end after a while, and for good when they
are lost from sight: a track that is seen again is a track of its own, as a tracker would make it. In the tiled worlds
every wall repeats the same tiles, so that places look alike that are not the same.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.cue_noise import CueNoise
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic.camera_path import look_at
from uni4d_fg.frontend.synthetic.furniture import furnished_room
from uni4d_fg.frontend.synthetic.mesh import box_faces
from uni4d_fg.frontend.synthetic.motion import Still
from uni4d_fg.frontend.synthetic.scene import Scene, SceneObject
from uni4d_fg.frontend.synthetic.simulate import simulate
from uni4d_fg.frontend.synthetic.texture import SurfaceStyle
from uni4d_fg.frontend.track_model import Tracks

World: TypeAlias = Literal["room", "tiled room", "tiled corridor"]

_RADIUS_M = 0.8
_CORRIDOR_M = (2.6, 2.4, 40.0)
_TILES = SurfaceStyle((0.25, 0.3, 0.4), (0.9, 0.88, 0.8), "checks", 0.64, (0.11, 0.17, 0.05), contrast=0.35)
"""Tiles of 0.64 m with a grain that repeats every 2.56 m, four tiles on: the world looks the same there."""


def circuit(
    num_frames: int = 1000,
    laps: float = 1.04,
    *,
    world: World = "room",
    track_life: int = 30,
    noise: CueNoise | None = None,
    seed: int = 0,
) -> Sequence:
    """Make a walk of 160 x 120 px.

    Args:
        num_frames: T.
        laps: How often the camera goes round; below one minus the part that it has in view (0.17) it sees nothing
            again. In the corridor a lap is as long a way ahead, and nothing is ever seen again.
        world: Where.
        track_life: Frames after which a track is lost at the latest.
        noise: Of the cues; that of a synthetic sequence when None.
        seed: Of the noise, and where the walk begins.

    Raises:
        MissingDependencyError: If Open3D cannot be loaded.
    """
    config = SyntheticSceneConfig(
        num_frames=num_frames, height=120, width=160, focal=130.0, objects="none", grid_columns=12, grid_rows=9,
        query_interval=10, noise=noise or CueNoise(focal_error=0.0), seed=seed,
    )  # fmt: skip
    sequence = simulate(config, _world(world), _walk(num_frames, laps, world, seed)).sequence
    assert sequence.tracks is not None
    return replace(sequence, tracks=forgetful(sequence.tracks, track_life))


def forgetful(tracks: Tracks, life: int, patience: int = 3) -> Tracks:
    """End tracks ``life`` frames after their first view, or when they are out of sight for ``patience`` frames."""
    visible: BoolArray = tracks.visible.copy()
    frame = np.arange(visible.shape[1])
    first = visible.argmax(axis=1)
    visible &= (frame >= first[:, None]) & (frame < first[:, None] + life)
    for row in visible:
        seen = np.flatnonzero(row)
        gaps = np.flatnonzero(np.diff(seen) > patience)
        if len(gaps):
            row[seen[gaps[0]] + 1 :] = False
    uv = np.where(visible[..., None], tracks.uv, np.float32(np.nan))
    return Tracks(uv, visible, tracks.query_frame)


def _walk(num_frames: int, laps: float, world: World, seed: int) -> FloatArray:
    """Return the poses (T, 4, 4)."""
    lap = laps * np.linspace(0.0, 1.0, num_frames)
    tremor = 0.004 * np.stack([np.sin(s * np.arange(num_frames) + s) for s in (0.53, 0.71, 0.37)], axis=1)
    roll = 0.02 * np.sin(0.11 * np.arange(num_frames))
    if world == "tiled corridor":
        way = 2.0 * np.pi * _RADIUS_M * lap
        position = np.stack([0.1 * np.sin(way), 0.05 * np.sin(2.0 * way), way - 10.0 + 0.3 * seed], axis=1) + tremor
        return look_at(position, position + np.array([0.8, 0.1, 1.0]), roll)
    angle = 2.0 * np.pi * lap + 0.7 * seed
    ring = np.stack([np.cos(angle), 0.1 * np.sin(3.0 * angle), np.sin(angle)], axis=1)
    outward = np.stack([np.cos(angle + 0.3), 0.15 * np.sin(2.0 * angle), np.sin(angle + 0.3)], axis=1)
    return look_at(_RADIUS_M * ring + tremor, 2.5 * outward, roll)


def _world(world: World) -> Scene:
    if world == "room":
        return Scene(tuple(SceneObject(mesh, style, 0, Still()) for mesh, style in furnished_room()))
    size = (5.12, 3.0, 5.12) if world == "tiled room" else _CORRIDOR_M
    return Scene(tuple(SceneObject(mesh, _TILES, 0, Still()) for mesh in box_faces(size)))
