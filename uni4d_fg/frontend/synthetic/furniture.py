"""The static part of the synthetic world: walls, furniture and their paint."""

from __future__ import annotations

from uni4d_fg.frontend.synthetic.mesh import Mesh, box, box_faces, concatenate, sphere
from uni4d_fg.frontend.synthetic.texture import SurfaceStyle

ROOM_SIZE_M = (5.0, 3.0, 5.0)
"""Width, height and depth of the room, meters."""

_WALLPAPER = SurfaceStyle((0.62, 0.66, 0.75), (0.85, 0.8, 0.7), "dots", 0.45, contrast=0.3)
_SIDE_WALL = SurfaceStyle((0.75, 0.66, 0.55), (0.6, 0.62, 0.6), "stripes", 0.6, (0.4, 0.9, 0.1))
_FLOOR = SurfaceStyle((0.5, 0.33, 0.2), (0.75, 0.58, 0.4), "checks", 0.5, (1.1, 0.3, 0.8))
_CEILING = SurfaceStyle((0.85, 0.85, 0.82), (0.65, 0.65, 0.68), "none", 1.0, (0.2, 2.0, 0.7))
_WOOD = SurfaceStyle((0.45, 0.27, 0.14), (0.72, 0.5, 0.3), "stripes", 0.18, (0.9, 1.3, 0.6))
_CABINET = SurfaceStyle((0.25, 0.35, 0.5), (0.55, 0.6, 0.65), "checks", 0.34, (2.1, 0.5, 1.4))
_SHELF = SurfaceStyle((0.7, 0.62, 0.4), (0.4, 0.25, 0.2), "dots", 0.3, (0.6, 1.9, 2.2))
_CUSHION = SurfaceStyle((0.5, 0.2, 0.45), (0.85, 0.65, 0.75), "dots", 0.16, (1.5, 1.2, 0.2))
_GLOBE = SurfaceStyle((0.15, 0.4, 0.65), (0.8, 0.85, 0.75), "none", 1.0, (0.1, 0.6, 1.8))
_PAINTING = SurfaceStyle((0.9, 0.75, 0.25), (0.2, 0.25, 0.45), "checks", 0.28, (2.3, 1.6, 0.4))


def _table() -> Mesh:
    """Return a table whose top is 0.75 m above the floor."""
    legs = [box((0.06, 0.7, 0.06)).translated((x, 0.38, z)) for x in (-0.6, 0.6) for z in (-0.3, 0.3)]
    return concatenate([box((1.3, 0.05, 0.7)), *legs]).translated((0.35, 0.77, 1.35))


def furnished_room() -> list[tuple[Mesh, SurfaceStyle]]:
    """Return the static meshes, in world coordinates and meters, with their paint."""
    left, right, ceiling, floor, front, back = box_faces(ROOM_SIZE_M)
    return [
        (left, _SIDE_WALL),
        (right, _SIDE_WALL),
        (ceiling, _CEILING),
        (floor, _FLOOR),
        (front, _WALLPAPER),
        (back, _WALLPAPER),
        (_table(), _WOOD),
        (box((1.0, 1.3, 0.6)).translated((-1.5, 0.85, 1.9)), _CABINET),
        (box((0.7, 2.0, 0.5)).translated((1.75, 0.5, 1.7)), _SHELF),
        (box((0.5, 0.45, 0.5)).translated((-1.0, 1.275, 0.45)), _CUSHION),
        (sphere(0.2).translated((0.1, 0.545, 1.35)), _GLOBE),
        (box((0.24, 0.16, 0.2)).translated((0.72, 0.665, 1.3)), _PAINTING),
        (box((1.1, 0.75, 0.06)).translated((0.2, -0.55, 2.46)), _PAINTING),
        (box((0.4, 0.5, 0.4)).translated((-1.55, -0.05, 1.85)), _SHELF),
        (sphere(0.3).translated((1.3, 1.2, 0.65)), _CUSHION),
    ]
