"""Pieces that worlds are built from: triangle meshes with texture coordinates and one material each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from benchmarks.worlds.textures import Texture
from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.frontend.synthetic.mesh import Mesh, box, sphere, surface_of_revolution

Vector = tuple[float, float, float]
Point: TypeAlias = FloatArray | Vector
"""Three numbers, meters."""


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface answers light."""

    texture: Texture
    period_m: float = 2.0
    """Width that one period of the texture covers, meters."""
    tint: Vector = (1.0, 1.0, 1.0)
    """Factor of the texture's linear RGB."""
    mirror: float = 0.0
    """Part of the light that is mirrored when one looks straight at it; more does at a glance."""
    macro: float = 0.0
    """Relative deviation of the brightness over several periods, so that repetitions differ."""
    leafy: bool = False
    """Whether light shines through, as through leaves and thin cloth."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A mesh of one material."""

    vertices: FloatArray
    """(V, 3) meters."""
    triangles: IntArray
    """(F, 3) vertex indices."""
    uv: FloatArray
    """(F, 3, 2) texture coordinates of the corners, meters."""
    material: Material

    def moved(self, offset: Point = (0.0, 0.0, 0.0), yaw: float = 0.0) -> Piece:
        """Return the piece turned about y by ``yaw`` rad (z towards x), then moved by ``offset`` meters."""
        return replace(self, vertices=self.vertices @ turn_y(yaw).T + np.asarray(offset))

    def placed(self, frame: FloatArray) -> Piece:
        """Return the piece moved by a (4, 4) transform."""
        return replace(self, vertices=self.vertices @ frame[:3, :3].T + frame[:3, 3])


def turn_y(yaw: float) -> FloatArray:
    """Return the (3, 3) rotation about the axis that points down, which takes z towards x by ``yaw`` rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def turn_x(pitch: float) -> FloatArray:
    """Return the (3, 3) rotation about x, which takes z towards y by ``pitch`` rad."""
    c, s = np.cos(pitch), np.sin(pitch)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


def frame_of(position: Point, rotation: FloatArray | None = None) -> FloatArray:
    """Return the (4, 4) transform of a position, meters, and a rotation (3, 3)."""
    result = np.eye(4)
    result[:3, 3] = position
    if rotation is not None:
        result[:3, :3] = rotation
    return result


def normals_of(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Return (V, 3) unit normals: the mean of those of the triangles around, by area."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    total = np.stack([np.bincount(triangles.ravel(), np.repeat(n, 3), len(vertices)) for n in cross.T], axis=-1)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    result: FloatArray = total / np.where(length > 0, length, 1.0)
    return result


def flat_uv(mesh: Mesh, shift: FloatArray) -> FloatArray:
    """Return (F, 3, 2) coordinates that drop each triangle's main direction; y stays along v where it can."""
    corner = mesh.vertices[mesh.triangles]
    main = np.abs(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])).argmax(axis=-1)
    kept = np.array([[2, 1], [0, 2], [0, 1]])[main]
    result: FloatArray = np.take_along_axis(corner, kept[:, None, :], axis=-1) + shift
    return result


def round_uv(mesh: Mesh, radius: float, shift: FloatArray) -> FloatArray:
    """Return (F, 3, 2) coordinates around y, by angle times ``radius`` in meters, and along y."""
    corner = mesh.vertices[mesh.triangles]
    angle = np.arctan2(corner[..., 2], corner[..., 0])
    # Triangles at the seam go on beyond half a turn.
    angle = angle[:, :1] + np.mod(angle - angle[:, :1] + np.pi, 2 * np.pi) - np.pi
    result: FloatArray = np.stack((radius * angle, corner[..., 1]), axis=-1) + shift
    return result


def _shift_of(key: Point) -> FloatArray:
    """Return a (2,) shift in meters that is another one at another place, so that equal shapes differ."""
    x, y, z = np.asarray(key, dtype=np.float64)
    return np.array([np.mod(3.71 * x + 1.93 * z + 0.77 * y, 7.3), np.mod(1.37 * y + 2.11 * z - 0.83 * x, 5.9)])


def slab(size: Vector, center: Point, material: Material, yaw: float = 0.0) -> Piece:
    """Return a box of a size at a center, meters."""
    mesh = box(size)
    return Piece(mesh.vertices, mesh.triangles, flat_uv(mesh, _shift_of(center)), material).moved(center, yaw)


def lathe(
    profile: list[tuple[float, float]], center: Point, material: Material, segments: int = 20,
    squash: tuple[float, float] = (1.0, 1.0),
) -> Piece:  # fmt: skip
    """Return what a profile of (radius, y), meters, makes around y at a center; ``squash`` scales x and z."""
    rings = np.asarray(profile, dtype=np.float64)
    mesh = surface_of_revolution(rings, segments)
    uv = round_uv(mesh, float(rings[:, 0].max()), _shift_of(center))
    vertices = mesh.vertices * (squash[0], 1.0, squash[1])
    return Piece(vertices, mesh.triangles, uv, material).moved(center)


def ball(radius: float, center: Point, material: Material, squash: Vector = (1.0, 1.0, 1.0)) -> Piece:
    """Return a ball, squashed along the axes."""
    mesh = sphere(radius, 20)
    uv = round_uv(mesh, radius, _shift_of(center))
    return Piece(mesh.vertices * squash, mesh.triangles, uv, material).moved(center)


def along(start: Point, end: Point, hint: Point = (0, 0, 1)) -> FloatArray:
    """Return the (4, 4) frame at ``start`` whose y axis points to ``end`` and whose z axis is nearest to ``hint``."""
    y = np.asarray(end, dtype=np.float64) - np.asarray(start, dtype=np.float64)
    y /= max(float(np.linalg.norm(y)), 1e-9)
    z = np.asarray(hint, dtype=np.float64)
    z = z - (z @ y) * y
    if np.linalg.norm(z) < 1e-3:
        z = np.cross(np.array([1.0, 0.0, 0.0]), y)
    z /= np.linalg.norm(z)
    return frame_of(np.asarray(start, dtype=np.float64), np.stack((np.cross(y, z), y, z), axis=-1))


def limb(
    length: float, first: float, last: float, material: Material, squash: float = 1.0, segments: int = 16
) -> Piece:
    """Return a rod with round ends from the origin along y, of radius ``first`` there and ``last`` at its end."""
    angle = np.linspace(0.0, 0.5 * np.pi, 5)
    top = [(first * float(np.sin(a)), -first * float(np.cos(a))) for a in angle]
    bottom = [(last * float(np.sin(a)), length + last * float(np.cos(a))) for a in angle[::-1]]
    return lathe(top + bottom, (0.0, 0.0, 0.0), material, segments, (1.0, squash))


def pole(start: Point, end: Point, radius: float, material: Material, segments: int = 10) -> Piece:
    """Return a rod between two points, meters."""
    length = float(np.linalg.norm(np.subtract(end, start)))
    rod = limb(length, radius, radius, material, segments=segments)
    return replace(rod, uv=rod.uv + _shift_of(start)).placed(along(start, end))


def sheet(points: FloatArray, material: Material) -> Piece:
    """Return the surface through a grid of points (R, C, 3); texture runs along rows and columns by length."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    u = np.zeros((rows, columns))
    v = np.zeros((rows, columns))
    u[:, 1:] = np.cumsum(np.linalg.norm(np.diff(points, axis=1), axis=-1), axis=1)
    v[1:] = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1), axis=0)
    coordinates = np.stack((u, v), axis=-1).reshape(-1, 2) + _shift_of(points[0, 0])
    return Piece(points.reshape(-1, 3), triangles, coordinates[triangles], material)


def quad(corner: Point, side: Point, down: Point, material: Material) -> Piece:
    """Return a parallelogram from a corner along two edges, meters."""
    first, u, v = (np.asarray(x, dtype=np.float64) for x in (corner, side, down))
    return sheet(np.stack((np.stack((first, first + u)), np.stack((first + v, first + u + v)))), material)


def extruded(outline: list[tuple[float, float]], width: float, material: Material, narrow: float = 1.0) -> Piece:
    """Return a solid whose side view is an outline.

    Args:
        outline: Corners (z, y) in order, meters; every one is seen from the middle of them all.
        width: Extent along x, meters.
        material: Material.
        narrow: Width at the outline's top as a part of that at its bottom.
    """
    corner = np.asarray(outline, dtype=np.float64)
    count = len(corner)
    high = (corner[:, 1].max() - corner[:, 1]) / np.ptp(corner[:, 1])
    half = 0.5 * width * (1.0 + (narrow - 1.0) * high)
    meshes: list[FloatArray] = []
    sides = [np.stack((sign * half, corner[:, 1], corner[:, 0]), axis=-1) for sign in (-1.0, 1.0)]
    for side in sides:
        middle = side.mean(axis=0)
        meshes += [np.stack((middle, side[i], side[(i + 1) % count])) for i in range(count)]
    for i in range(count):
        j = (i + 1) % count
        meshes += [np.stack((sides[0][i], sides[0][j], sides[1][j])), np.stack((sides[0][i], sides[1][j], sides[1][i]))]
    mesh = Mesh(np.concatenate(meshes), np.arange(3 * len(meshes), dtype=np.int64).reshape(-1, 3))
    return Piece(mesh.vertices, mesh.triangles, flat_uv(mesh, np.zeros(2)), material)


def cards(centers: FloatArray, size_m: float, material: Material, rng: np.random.Generator) -> Piece:
    """Return leaves: one rhombus of random direction, size and color at each of the centers (N, 3), meters."""
    count = len(centers)
    side = rng.standard_normal((count, 3))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    other = np.cross(side, rng.standard_normal((count, 3)))
    other /= np.linalg.norm(other, axis=-1, keepdims=True)
    scale = size_m * rng.uniform(0.6, 1.4, (count, 1))
    vertices = centers[:, None] + np.stack(
        (-scale * side, -0.5 * scale * other, scale * side, 0.5 * scale * other), axis=1
    )  # fmt: skip
    first = 4 * np.arange(count)[:, None]
    triangles = np.concatenate((first + np.array([0, 1, 2]), first + np.array([0, 2, 3])))
    place = np.array([[-1.0, 0.0], [0.0, -0.5], [1.0, 0.0], [0.0, 0.5]]) * size_m
    uv = (rng.uniform(0, 8, (count, 1, 2)) + place).reshape(-1, 2)
    return Piece(vertices.reshape(-1, 3), triangles, uv[triangles], material)
