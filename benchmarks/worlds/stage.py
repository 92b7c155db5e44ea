"""A world's triangles at one time, ready for rays: what stands still is sorted once, what moves for every time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.worlds.surface import Material, Piece, normals_of
from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.optional import import_open3d

MOVING_M_PER_S = 0.02
"""Speed of its fastest point from which on a thing counts as moving."""


@dataclass(frozen=True, eq=False)
class Thing:
    """What moves: rigid parts that are carried by frames."""

    pieces: list[Piece]
    """In the coordinates of their frames."""
    frame: list[int]
    """Which frame carries each piece."""
    poses: Callable[[float], FloatArray]
    """Maps a time in seconds to (P, 4, 4) transforms from the frames to the world."""

    @classmethod
    def rigid(cls, pieces: list[Piece], pose: Callable[[float], FloatArray]) -> Thing:
        """Return what moves as one, by (4, 4) poses."""
        return cls(pieces, [0] * len(pieces), lambda time: pose(time)[None])


@dataclass(frozen=True)
class Meet:
    """Where N rays first meet a triangle."""

    distance: Float32Array
    """(N,) in lengths of the ray's direction, infinite where nothing is met."""
    triangle: Int32Array
    """(N,) index of the triangle, static ones first; -1 where nothing is met."""
    weight: Float32Array
    """(N, 2) barycentric weights of the second and third corner."""


class Caster:
    """Triangles sorted for rays; one thread, float32 in and out."""

    def __init__(self, vertices: Float32Array, triangles: Int32Array) -> None:
        open3d = import_open3d()
        self._tensor: Any = open3d.core.Tensor
        self._scene: Any = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.is_empty = len(triangles) == 0
        if not self.is_empty:
            self._scene.add_triangles(
                self._tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
                self._tensor(np.ascontiguousarray(triangles, dtype=np.uint32)),
            )

    def cast(self, rays: Float32Array) -> Meet:
        """Return where rays (N, 6) of origin and direction meet the triangles."""
        if self.is_empty or not len(rays):
            return Meet(
                np.full(len(rays), np.inf, np.float32), np.full(len(rays), -1, np.int32),
                np.zeros((len(rays), 2), np.float32),
            )  # fmt: skip
        answer = self._scene.cast_rays(self._tensor(rays), 1)
        distance = answer["t_hit"].numpy()
        triangle = np.where(np.isfinite(distance), answer["primitive_ids"].numpy().astype(np.int32), np.int32(-1))
        return Meet(distance, triangle, answer["primitive_uvs"].numpy())

    def hides(self, rays: Float32Array, far: float) -> BoolArray:
        """Return whether anything lies on rays (N, 6) within ``far`` lengths of their direction."""
        if self.is_empty or not len(rays):
            return np.zeros(len(rays), dtype=bool)
        found = self._scene.test_occlusions(self._tensor(rays), 0.0, far, 1)
        return np.asarray(found.numpy(), dtype=bool)


@dataclass(frozen=True)
class Moment:
    """The world at one time."""

    normals: Float32Array
    """(F, 3, 3) unit normals at the corners of all triangles."""
    moving: Caster
    bodies: list[FloatArray]
    """Vertices (n, 3) of each thing, meters."""


class Stage:
    """Static pieces and moving things with one numbering of vertices, triangles and materials.

    Args:
        static: What stands still, in the world.
        things: What moves; the first has instance number 1.
    """

    def __init__(self, static: list[Piece], things: list[Thing]) -> None:
        self.things = things
        pieces = [*static, *(piece for thing in things for piece in thing.pieces)]
        starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
        triangles = np.concatenate([p.triangles + n for p, n in zip(pieces, starts[:-1], strict=True)])
        self.uv: Float32Array = np.concatenate([piece.uv for piece in pieces]).astype(np.float32)
        self.materials: list[Material] = list(dict.fromkeys(piece.material for piece in pieces))
        number = {material: i for i, material in enumerate(self.materials)}
        counts = [len(piece.triangles) for piece in pieces]
        self.material: Int32Array = np.repeat([number[piece.material] for piece in pieces], counts).astype(np.int32)
        owner = [0] * len(static) + [i + 1 for i, thing in enumerate(things) for _ in thing.pieces]
        self.instance = np.repeat(owner, counts).astype(np.uint8)

        self.static_triangles = sum(counts[: len(static)])
        fixed = int(starts[len(static)])
        vertices = np.concatenate([piece.vertices for piece in static])
        still = triangles[: self.static_triangles]
        self._static_normals = normals_of(vertices, still)[still].astype(np.float32)
        self.caster = Caster(vertices.astype(np.float32), still.astype(np.int32))
        self._moving_triangles = (triangles[self.static_triangles :] - fixed).astype(np.int32)
        self._rest_normals = [[normals_of(p.vertices, p.triangles) for p in thing.pieces] for thing in things]

    def poses(self, time: float) -> list[FloatArray]:
        """Return the (P, 4, 4) frames of each thing at a time in seconds."""
        return [thing.poses(time) for thing in self.things]

    def bodies(self, poses: list[FloatArray]) -> list[FloatArray]:
        """Return the vertices (n, 3) of each thing, meters, by the frames that :meth:`poses` returns."""
        return [
            np.concatenate([piece.placed(own[f]).vertices for piece, f in zip(thing.pieces, thing.frame, strict=True)])
            for thing, own in zip(self.things, poses, strict=True)
        ]

    def at(self, time: float) -> Moment:
        """Return the world at a time in seconds."""
        poses = self.poses(time)
        normals = []
        for thing, rest, own in zip(self.things, self._rest_normals, poses, strict=True):
            normals += [n @ own[f, :3, :3].T for n, f in zip(rest, thing.frame, strict=True)]
        bodies = self.bodies(poses)
        if not bodies:
            return Moment(self._static_normals, Caster(np.zeros((0, 3), np.float32), self._moving_triangles), [])
        corners = np.concatenate(normals)[self._moving_triangles].astype(np.float32)
        caster = Caster(np.concatenate(bodies).astype(np.float32), self._moving_triangles)
        return Moment(np.concatenate((self._static_normals, corners)), caster, bodies)

    def cast(self, moment: Moment, rays: Float32Array, may_move: BoolArray | None = None) -> Meet:
        """Return what rays (N, 6) meet first; ``may_move`` (N,) is False where nothing that moves can be met."""
        still = self.caster.cast(rays)
        rows = np.arange(len(rays)) if may_move is None else np.flatnonzero(may_move)
        moved = moment.moving.cast(np.ascontiguousarray(rays[rows]))
        nearer = moved.distance < still.distance[rows]
        if not nearer.any():
            return still
        distance, triangle, weight = still.distance.copy(), still.triangle.copy(), still.weight.copy()
        rows = rows[nearer]
        distance[rows], weight[rows] = moved.distance[nearer], moved.weight[nearer]
        triangle[rows] = moved.triangle[nearer] + np.int32(self.static_triangles)
        return Meet(distance, triangle, weight)

    def hidden(self, moment: Moment, rays: Float32Array, far: float) -> BoolArray:
        """Return whether anything lies on rays (N, 6) within ``far`` lengths of their direction."""
        result = self.caster.hides(rays, far)
        rows = np.flatnonzero(~result)
        result[rows] = moment.moving.hides(np.ascontiguousarray(rays[rows]), far)
        return result

    def moves(self, time: float, step_s: float = 0.02) -> BoolArray:
        """Return (1 + things,) whether each instance moves around a time in seconds; static is False."""
        before, after = (self.bodies(self.poses(time + step)) for step in (-step_s, step_s))
        fastest = [np.linalg.norm(b - a, axis=-1).max() / (2 * step_s) for a, b in zip(before, after, strict=True)]
        return np.array([False, *(speed > MOVING_M_PER_S for speed in fastest)])
