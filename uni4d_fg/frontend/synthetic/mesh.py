"""Triangle meshes of the primitives that the synthetic scene is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in its rest pose."""

    vertices: FloatArray
    """(V, 3) meters."""
    triangles: IntArray
    """(F, 3) vertex indices."""

    def translated(self, offset: tuple[float, float, float]) -> Mesh:
        """Return the mesh moved by ``offset`` meters."""
        return Mesh(self.vertices + np.asarray(offset, dtype=np.float64), self.triangles)


def concatenate(meshes: list[Mesh]) -> Mesh:
    """Join meshes into one, keeping their order."""
    first_vertex = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + n for m, n in zip(meshes, first_vertex, strict=True)]),
    )


def box_faces(size: tuple[float, float, float]) -> list[Mesh]:
    """Return the six faces of a box centered at the origin, two triangles each.

    Args:
        size: Extent along x, y and z, meters.

    Returns:
        Faces in the order -x, +x, -y, +y, -z, +z.
    """
    half = 0.5 * np.asarray(size, dtype=np.float64)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int64)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            vertices = np.empty((4, 3))
            vertices[:, axis] = side
            vertices[:, [(axis + 1) % 3, (axis + 2) % 3]] = corners
            faces.append(Mesh(vertices * half, triangles if side > 0 else triangles[:, ::-1]))
    return faces


def box(size: tuple[float, float, float]) -> Mesh:
    """Return a box of extent ``size`` meters centered at the origin."""
    return concatenate(box_faces(size))


def surface_of_revolution(profile: FloatArray, segments: int) -> Mesh:
    """Turn a profile around the y axis; both ends are closed by a single vertex on the axis.

    Args:
        profile: (N, 2) radius and y of the rings in meters; the first and last radius are taken as zero.
        segments: Vertices per ring.

    Returns:
        A closed mesh with ``(N - 2) * segments + 2`` vertices.
    """
    angle = 2.0 * np.pi * np.arange(segments) / segments
    ring = np.stack((np.cos(angle), np.zeros(segments), np.sin(angle)), axis=-1)
    inner = profile[1:-1]
    rings = inner[:, 0, None, None] * ring
    rings[..., 1] = inner[:, 1, None]
    poles = np.array([[0.0, profile[0, 1], 0.0], [0.0, profile[-1, 1], 0.0]])
    vertices = np.concatenate((rings.reshape(-1, 3), poles))

    here, following = np.arange(segments), np.roll(np.arange(segments), -1)
    lower = (np.arange(len(inner) - 1) * segments)[:, None]
    upper = lower + segments
    sides = np.concatenate(
        (
            np.stack((lower + here, upper + here, upper + following), axis=-1).reshape(-1, 3),
            np.stack((lower + here, upper + following, lower + following), axis=-1).reshape(-1, 3),
        )
    )
    first_pole, last_pole = len(vertices) - 2, len(vertices) - 1
    last_ring = (len(inner) - 1) * segments
    first_cap = np.stack((np.full(segments, first_pole), here, following), axis=-1)
    last_cap = np.stack((np.full(segments, last_pole), last_ring + following, last_ring + here), axis=-1)
    return Mesh(vertices, np.concatenate((sides, first_cap, last_cap)).astype(np.int64))


def sphere(radius: float, segments: int = 48) -> Mesh:
    """Return a sphere of ``radius`` meters centered at the origin."""
    angle = np.linspace(0.0, np.pi, segments // 2 + 1)
    return surface_of_revolution(radius * np.stack((np.sin(angle), -np.cos(angle)), axis=-1), segments)


def capsule(radius: float, height: float, segments: int = 48, rings: int = 40) -> Mesh:
    """Return a capsule along y centered at the origin.

    Args:
        radius: Radius, meters.
        height: Total height, at least twice the radius, meters.
        segments: Vertices per ring.
        rings: Rings along the straight part.
    """
    angle = np.linspace(0.0, 0.5 * np.pi, segments // 4 + 1)
    straight = 0.5 * height - radius
    cap = radius * np.stack((np.sin(angle), -np.cos(angle)), axis=-1) - [0.0, straight]
    side_y = np.linspace(-straight, straight, rings + 2)[1:-1]
    side = np.stack((np.full(rings, radius), side_y), axis=-1)
    return surface_of_revolution(np.concatenate((cap, side, cap[::-1] * [1.0, -1.0])), segments)
