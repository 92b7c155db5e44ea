"""Rendering of one frame: color, exact depth and instance ids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.frontend.synthetic.raycast import Hits, RayCaster, interpolate, triangle_normals
from uni4d_fg.frontend.synthetic.scene import Scene
from uni4d_fg.frontend.synthetic.texture import reflectance
from uni4d_fg.geometry.camera import unproject
from uni4d_fg.geometry.lens import PINHOLE, Lens

_LIGHT = np.array([-0.35, -0.75, -0.56])  # unit vector from the surface to the light
_AMBIENT = 0.7
_SUPERSAMPLES = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


@dataclass(frozen=True)
class RenderedFrame:
    """What the camera sees at one time."""

    depth: Float32Array
    """(H, W) exact z-depth, meters, NaN where nothing is met."""
    instance: Int32Array
    """(H, W) instance ids, 0 where static."""
    image: ImageArray | None
    """(H, W, 3) RGB, or None when color was not asked for."""


def pixel_grid(height: int, width: int) -> FloatArray:
    """Return (H * W, 2) pixel centers (x, y) in row-major order; centers are at integers."""
    v, u = np.mgrid[:height, :width]
    return np.stack((u.ravel(), v.ravel()), axis=-1).astype(np.float64)


def cast_pixels(
    caster: RayCaster, world_T_cam: FloatArray, intrinsics: FloatArray, uv: FloatArray, lens: Lens = PINHOLE
) -> Hits:
    """Cast rays through pixels; the directions have unit z in the camera, so distances are z-depths.

    Args:
        caster: The mesh at the frame's time.
        world_T_cam: (4, 4) camera to world.
        intrinsics: (4,) fx, fy, cx, cy, px.
        uv: (N, 2) pixels.
        lens: Distortion of the camera.
    """
    ideal = lens.ideal_pixels(intrinsics, uv)
    direction = unproject(intrinsics, ideal, np.ones(len(uv))) @ world_T_cam[:3, :3].T
    return caster.cast(world_T_cam[:3, 3], direction)


def _shade(scene: Scene, vertices: FloatArray, center: FloatArray, hits: Hits) -> FloatArray:
    """Return (N, 3) RGB in [0, 1]: texture times a Lambertian term of a light fixed in the world."""
    color = np.zeros((len(hits.triangle), 3))
    facing_light = np.zeros(len(hits.triangle))
    valid = np.flatnonzero(hits.valid)
    triangle, barycentric = hits.triangle[valid], hits.barycentric[valid]
    normals = triangle_normals(vertices, scene.triangles)
    first_corner = vertices[scene.triangles[:, 0]]
    # Normals are turned towards the camera: walls are seen from inside, objects from outside.
    side = np.where(np.sum(normals * (center - first_corner), axis=-1) < 0, -1.0, 1.0)
    facing_light[valid] = np.maximum(side * (normals @ _LIGHT), 0.0)[triangle]
    rest = interpolate(scene.rest_vertices, scene.triangles, triangle, barycentric)
    owner = scene.triangle_object[triangle]
    for index in np.unique(owner):
        mine = owner == index
        color[valid[mine]] = reflectance(scene.objects[index].style, rest[mine])
    result: FloatArray = color * (_AMBIENT + (1.0 - _AMBIENT) * facing_light)[:, None]
    return result


def render_frame(
    scene: Scene,
    vertices: FloatArray,
    caster: RayCaster,
    world_T_cam: FloatArray,
    intrinsics: FloatArray,
    image_size: tuple[int, int],
    with_image: bool = True,
    lens: Lens = PINHOLE,
) -> RenderedFrame:
    """Render one frame.

    Depth and ids are those of the ray through the pixel's center; color alone is anti-aliased by 2 x 2
    supersampling.

    Args:
        scene: Topology, texture and instance ids.
        vertices: (V, 3) the scene's vertices at this time, meters.
        caster: Ray caster on those vertices.
        world_T_cam: (4, 4) camera to world.
        intrinsics: (4,) fx, fy, cx, cy, px.
        image_size: (height, width), px.
        with_image: Whether to shade color.
        lens: Distortion of the camera.
    """
    height, width = image_size
    uv = pixel_grid(height, width)
    hits = cast_pixels(caster, world_T_cam, intrinsics, uv, lens)
    depth = np.where(hits.valid, hits.distance, np.nan).astype(np.float32).reshape(height, width)
    instance = np.where(hits.valid, scene.triangle_instance[hits.triangle], 0).astype(np.int32)
    image = None
    if with_image:
        total = np.zeros((len(uv), 3))
        for offset in _SUPERSAMPLES:
            sample = cast_pixels(caster, world_T_cam, intrinsics, uv + np.asarray(offset), lens)
            total += _shade(scene, vertices, world_T_cam[:3, 3], sample)
        mean = total / len(_SUPERSAMPLES)
        image = np.round(255.0 * mean).astype(np.uint8).reshape(height, width, 3)
    return RenderedFrame(depth, instance.reshape(height, width), image)
