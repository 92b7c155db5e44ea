"""The synthetic world: a furnished room seen from inside, and what moves in it.

World axes: x right, y down, z towards the back wall; the origin is the middle of a room of 5 x 3 x 5 m,
so the floor is the plane y = 1.5. Rigid objects have the odd instance ids 1, 3, ... and deforming ones the
even ids 2, 4, ...; 0 is the static world.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uni4d_fg.arrays import FloatArray, Int32Array, IntArray
from uni4d_fg.config.synthetic import MAX_OBJECTS_PER_KIND, ObjectChoice
from uni4d_fg.frontend.synthetic.furniture import furnished_room
from uni4d_fg.frontend.synthetic.mesh import Mesh, box, capsule
from uni4d_fg.frontend.synthetic.motion import Motion, RigidMotion, Still, WobblyMotion
from uni4d_fg.frontend.synthetic.texture import SurfaceStyle


@dataclass(frozen=True)
class SceneObject:
    """One painted mesh with its motion."""

    mesh: Mesh
    style: SurfaceStyle
    instance: int
    motion: Motion


@dataclass(frozen=True)
class Scene:
    """All objects, addressed as one mesh whose triangles never change and whose vertices move."""

    objects: tuple[SceneObject, ...]

    @cached_property
    def triangles(self) -> IntArray:
        """(F, 3) vertex indices."""
        first = np.cumsum([0] + [len(o.mesh.vertices) for o in self.objects[:-1]])
        return np.concatenate([o.mesh.triangles + n for o, n in zip(self.objects, first, strict=True)])

    @cached_property
    def triangle_object(self) -> IntArray:
        """(F,) index of the object that each triangle belongs to."""
        return np.repeat(np.arange(len(self.objects)), [len(o.mesh.triangles) for o in self.objects])

    @cached_property
    def triangle_instance(self) -> Int32Array:
        """(F,) instance id of each triangle, 0 where static."""
        return np.array([o.instance for o in self.objects], dtype=np.int32)[self.triangle_object]

    @cached_property
    def rest_vertices(self) -> FloatArray:
        """(V, 3) rest-pose coordinates, meters, each object in its own frame: where the texture lives."""
        return np.concatenate([o.mesh.vertices for o in self.objects])

    def vertices(self, time: float) -> FloatArray:
        """Return (V, 3) world positions at ``time`` seconds, meters."""
        return np.concatenate([o.motion(o.mesh.vertices, time) for o in self.objects])

    def rigid_poses(self, times: FloatArray) -> tuple[Int32Array, FloatArray]:
        """Return the poses of the instances that move rigidly.

        Args:
            times: (T,) seconds.

        Returns:
            (J,) instance ids, ascending, and (J, T, 4, 4) world_T_object, meters.
        """
        motions = {o.instance: o.motion for o in self.objects if isinstance(o.motion, RigidMotion)}
        poses = [np.stack([motions[i].pose(time) for time in times.tolist()]) for i in sorted(motions)]
        return np.array(sorted(motions), dtype=np.int32), np.reshape(poses, (len(motions), len(times), 4, 4))


_RIGID_STYLE = SurfaceStyle((0.85, 0.25, 0.15), (0.95, 0.85, 0.55), "checks", 0.22, (0.3, 1.1, 0.5), 0.7)
_DEFORMING_STYLE = SurfaceStyle((0.15, 0.6, 0.3), (0.9, 0.9, 0.35), "checks", 0.14, (1.7, 0.2, 0.9), 0.75)
_DEFORMING_HEIGHT_M = 0.78
_RIGID_CENTERS = ((-0.35, 0.2, 0.15), (-0.9, -0.3, 1.05), (0.25, -0.6, 1.1))
_DEFORMING_CENTERS = ((0.55, 0.33, 0.45), (1.0, -0.3, 1.2), (-0.3, -0.05, 1.75))


def _rigid_object(index: int, size: float) -> SceneObject:
    motion = RigidMotion(
        center=_RIGID_CENTERS[index],
        swing=(0.3, 0.12, 0.2),
        frequency=(0.24, 0.31, 0.2),
        phase=(-0.9 + 1.7 * index, 0.4 + index, 1.0 - index),
        tilt=(0.35, 0.5, 0.1 + index),
        rotation_rate=(0.2, 0.45, 0.15) if index % 2 == 0 else (0.1, -0.4, 0.2),
    )
    scale = size * (1.0 if index == 0 else 0.7)
    mesh = box((0.55 * scale, 0.42 * scale, 0.38 * scale))
    return SceneObject(mesh, _RIGID_STYLE, 2 * index + 1, motion)


def _deforming_object(index: int, size: float) -> SceneObject:
    carrier = RigidMotion(
        center=_DEFORMING_CENTERS[index],
        swing=(0.18, 0.05, 0.2),
        frequency=(0.27, 0.4, 0.22),
        phase=(2.6 + 1.3 * index, index, 0.3 + index),
        tilt=(0.0, 0.3, 0.08),
        rotation_rate=(0.0, -0.3, 0.0),
    )
    scale = size * (1.0 if index == 0 else 0.7)
    height = scale * _DEFORMING_HEIGHT_M
    motion = WobblyMotion(carrier, height, bend_m=0.14 * scale, wave_m=0.04 * scale, phase=0.5 + index)
    return SceneObject(capsule(0.18 * scale, height), _DEFORMING_STYLE, 2 * index + 2, motion)


def make_scene(objects: ObjectChoice = "both", objects_per_kind: int = 1, object_scale: float = 1.0) -> Scene:
    """Build the room and what moves in it.

    Args:
        objects: Which movers there are. ``"all_dynamic"`` has both kinds and moves the room itself, as a
            rigid instance of its own, so that nothing in sight is static.
        objects_per_kind: Number of rigid and of deforming movers, at most ``MAX_OBJECTS_PER_KIND``.
        object_scale: Size of the movers, of the usual one.

    Raises:
        ValueError: If ``objects_per_kind`` is out of range.
    """
    if not 1 <= objects_per_kind <= MAX_OBJECTS_PER_KIND:
        raise ValueError(f"objects_per_kind must be in [1, {MAX_OBJECTS_PER_KIND}], got {objects_per_kind}")
    room_instance, room_motion = 0, Still()  # type: tuple[int, Motion]
    if objects == "all_dynamic":
        room_instance = 2 * objects_per_kind + 1
        room_motion = RigidMotion(
            center=(0.0, 0.0, 0.0),
            swing=(0.15, 0.03, 0.1),
            frequency=(0.3, 0.4, 0.25),
            phase=(0.0, 0.0, 0.0),
            rotation_rate=(0.0, 0.06, 0.01),
        )
    parts = [SceneObject(mesh, style, room_instance, room_motion) for mesh, style in furnished_room()]
    if objects in ("rigid", "both", "all_dynamic"):
        parts += [_rigid_object(i, object_scale) for i in range(objects_per_kind)]
    if objects in ("deforming", "both", "all_dynamic"):
        parts += [_deforming_object(i, object_scale) for i in range(objects_per_kind)]
    return Scene(tuple(parts))
