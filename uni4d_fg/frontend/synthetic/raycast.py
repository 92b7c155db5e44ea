"""Ray casting on a triangle mesh, through Open3D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.optional import import_open3d


@dataclass(frozen=True)
class Hits:
    """Where N rays first meet the mesh."""

    distance: FloatArray
    """(N,) in units of the ray's direction vector, infinite where nothing is met."""
    triangle: IntArray
    """(N,) index of the triangle, -1 where nothing is met."""
    barycentric: FloatArray
    """(N, 3) weights of the triangle's vertices, summing to one."""

    @property
    def valid(self) -> BoolArray:
        """(N,) True where a triangle was met."""
        return np.asarray(self.triangle >= 0)


class RayCaster:
    """A mesh frozen at one time, ready for ray queries.

    Args:
        vertices: (V, 3) world positions, meters.
        triangles: (F, 3) vertex indices.

    Raises:
        MissingDependencyError: If Open3D cannot be loaded.
    """

    def __init__(self, vertices: FloatArray, triangles: IntArray) -> None:
        open3d = import_open3d()
        self._core = open3d.core
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._core.Tensor(vertices.astype(np.float32)), self._core.Tensor(triangles.astype(np.uint32))
        )

    def cast(self, origin: FloatArray, direction: FloatArray) -> Hits:
        """Cast rays from one point.

        Args:
            origin: (3,) world position, meters.
            direction: (N, 3) world directions of any length.
        """
        rays = np.empty((len(direction), 6), dtype=np.float32)
        rays[:, :3] = origin
        rays[:, 3:] = direction
        answer = self._scene.cast_rays(self._core.Tensor(rays))
        distance = answer["t_hit"].numpy().astype(np.float64)
        triangle = answer["primitive_ids"].numpy().astype(np.int64)
        triangle[~np.isfinite(distance)] = -1
        second, third = answer["primitive_uvs"].numpy().astype(np.float64).T
        return Hits(distance, triangle, np.stack((1.0 - second - third, second, third), axis=-1))


def interpolate(values: FloatArray, triangles: IntArray, triangle: IntArray, barycentric: FloatArray) -> FloatArray:
    """Interpolate a quantity of the vertices at surface points.

    Args:
        values: (V, D) one row per vertex.
        triangles: (F, 3) vertex indices.
        triangle: (N,) triangle of each point.
        barycentric: (N, 3) weights.

    Returns:
        (N, D) interpolated values.
    """
    result: FloatArray = np.einsum("nk,nkd->nd", barycentric, values[triangles[triangle]])
    return result


def triangle_normals(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Return (F, 3) unit normals; the zero vector for a triangle without area."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    result: FloatArray = normal / np.where(length > 0, length, 1.0)
    return result
