"""Exact point tracks: material points of the surface followed through the moving mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, Int32Array, IntArray
from uni4d_fg.frontend.synthetic.raycast import RayCaster, interpolate, triangle_normals
from uni4d_fg.frontend.synthetic.render import cast_pixels
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.geometry.lens import PINHOLE, Lens

_OCCLUSION_TOLERANCE = 1e-3
_MIN_DEPTH_M = 0.05


@dataclass(frozen=True)
class SurfacePoints:
    """K material points: fixed to a triangle, wherever it moves."""

    triangle: IntArray
    """(K,) triangle index."""
    barycentric: FloatArray
    """(K, 3) weights of the triangle's vertices."""
    query_frame: Int32Array
    """(K,) frame in which each point was picked."""

    @staticmethod
    def concatenate(parts: list[SurfacePoints]) -> SurfacePoints:
        """Join the points of several query frames."""
        return SurfacePoints(
            np.concatenate([p.triangle for p in parts]),
            np.concatenate([p.barycentric for p in parts]),
            np.concatenate([p.query_frame for p in parts]),
        )

    def positions(self, vertices: FloatArray, triangles: IntArray) -> FloatArray:
        """Return (K, 3) positions on the mesh with the given ``vertices`` (V, 3)."""
        return interpolate(vertices, triangles, self.triangle, self.barycentric)


@dataclass(frozen=True)
class ExactTracks:
    """K noise-free tracks over T frames."""

    points: FloatArray
    """(K, T, 3) world positions, meters, in every frame whether seen or not."""
    uv: FloatArray
    """(K, T, 2) projections, px, NaN for points less than 5 cm in front of the camera."""
    visible: BoolArray
    """(K, T) inside the image and not occluded."""
    query_frame: Int32Array
    """(K,) frame in which the point was picked."""
    instance: Int32Array
    """(K,) instance id of the surface, 0 where static."""


def query_grid(image_size: tuple[int, int], columns: int, rows: int, margin_px: float) -> FloatArray:
    """Return (columns * rows, 2) evenly spaced pixels, ``margin_px`` away from the image border."""
    height, width = image_size
    u, v = np.meshgrid(
        np.linspace(margin_px, width - 1 - margin_px, columns),
        np.linspace(margin_px, height - 1 - margin_px, rows),
    )
    return np.stack((u.ravel(), v.ravel()), axis=-1)


def pick_points(
    caster: RayCaster, world_T_cam: FloatArray, intrinsics: FloatArray, uv: FloatArray, frame: int,
    lens: Lens = PINHOLE,
) -> SurfacePoints:  # fmt: skip
    """Pick the surface points seen at pixels ``uv`` (N, 2) of one frame; pixels that see nothing are left out."""
    hits = cast_pixels(caster, world_T_cam, intrinsics, uv, lens)
    keep = hits.valid
    query_frame = np.full(int(keep.sum()), frame, dtype=np.int32)
    return SurfacePoints(hits.triangle[keep], hits.barycentric[keep], query_frame)


def project_points(
    points: FloatArray, world_T_cam: FloatArray, intrinsics: FloatArray, image_size: tuple[int, int],
    lens: Lens = PINHOLE,
) -> tuple[FloatArray, BoolArray]:  # fmt: skip
    """Project world points into one frame.

    Returns:
        (K, 2) pixels, NaN for points less than 5 cm in front of the camera, and (K,) whether the pixel lies
        inside the image (between the centers of its outermost pixels).
    """
    height, width = image_size
    point_cam = world_to_camera(world_T_cam, points)
    ideal = np.asarray(project(intrinsics, point_cam))
    uv = lens.real_pixels(intrinsics, np.where(point_cam[:, 2:] > _MIN_DEPTH_M, ideal, np.nan))
    if not lens.is_pinhole:
        # Beyond the fold of a lens, directions far outside of the image would come to lie in it.
        back = lens.ideal_pixels(intrinsics, uv)
        with np.errstate(invalid="ignore"):
            uv = np.where(np.abs(back - ideal).max(axis=1, keepdims=True) < 1e-3, uv, np.nan)
    inside = (uv >= 0).all(axis=-1) & (uv[:, 0] <= width - 1) & (uv[:, 1] <= height - 1)
    return uv, inside


def facing(normal: FloatArray, points: FloatArray, center: FloatArray) -> BoolArray:
    """Return (K,) whether the camera ``center`` lies on the side of the surface that its normal points to."""
    return np.asarray(np.sum(normal * (center - points), axis=-1) > 0)


def unoccluded(caster: RayCaster, center: FloatArray, points: FloatArray) -> BoolArray:
    """Return (K,) whether nothing lies between the camera ``center`` and ``points``, to 1e-3 of the distance."""
    return np.asarray(caster.cast(center, points - center).distance >= 1.0 - _OCCLUSION_TOLERANCE)


class TrackFollower:
    """Follows surface points frame by frame, filling preallocated arrays.

    Args:
        surface: The points.
        triangles: (F, 3) the mesh.
        triangle_instance: (F,) instance ids.
        world_T_cam: (T, 4, 4) camera to world.
        intrinsics: (4,) fx, fy, cx, cy, px.
        image_size: (height, width), px.
        lens: Distortion of the camera.
    """

    def __init__(
        self,
        surface: SurfacePoints,
        triangles: IntArray,
        triangle_instance: Int32Array,
        world_T_cam: FloatArray,
        intrinsics: FloatArray,
        image_size: tuple[int, int],
        lens: Lens = PINHOLE,
    ) -> None:
        self._surface, self._triangles = surface, triangles
        self._world_T_cam, self._intrinsics, self._image_size = world_T_cam, intrinsics, image_size
        self._lens = lens
        k, t = len(surface.triangle), len(world_T_cam)
        self._instance = triangle_instance[surface.triangle]
        self._points = np.empty((k, t, 3))
        self._uv = np.empty((k, t, 2))
        self._unoccluded = np.zeros((k, t), dtype=np.bool_)
        self._facing = np.zeros((k, t), dtype=np.bool_)

    def add_frame(self, frame: int, vertices: FloatArray, caster: RayCaster) -> None:
        """Follow the points into ``frame``, where the mesh has ``vertices`` (V, 3) and ``caster``."""
        pose = self._world_T_cam[frame]
        points = self._surface.positions(vertices, self._triangles)
        uv, inside = project_points(points, pose, self._intrinsics, self._image_size, self._lens)
        normal = triangle_normals(vertices, self._triangles)[self._surface.triangle]
        self._points[:, frame] = points
        self._uv[:, frame] = uv
        self._facing[:, frame] = facing(normal, points, pose[:3, 3])
        candidates = np.flatnonzero(inside)
        seen = unoccluded(caster, pose[:3, 3], points[candidates])
        self._unoccluded[candidates[seen], frame] = True

    def finish(self) -> ExactTracks:
        """Return the tracks once every frame has been added."""
        query_frame = self._surface.query_frame
        # The side of the surface that was picked is the one to be seen, whatever the triangle's winding.
        picked_side = self._facing[np.arange(len(query_frame)), query_frame]
        visible = self._unoccluded & (self._facing == picked_side[:, None])
        return ExactTracks(self._points, self._uv, visible, query_frame, self._instance)
