r"""Scores of a rigid object's poses against the true ones, whatever world and object frame either uses.

What both have in common is the motion of the object from the reference frame s to frame t, expressed in camera s,

    M_t = C_s^{-1} T_t T_s^{-1} C_s

with C the cameras and T the object: it depends neither on the world nor on the origin and axes of the object's frame
(cf. the motion error of DynoSAM, Morris et al. 2025). The translation error is that of the object's true origin.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, Int32Array
from uni4d_fg.geometry import se3


@dataclass(frozen=True)
class ObjectMotionErrors:
    """Errors per frame; NaN where the estimate has no pose."""

    rotation_deg: FloatArray
    """(T,) angle between the estimated and the true motion since the reference frame, degrees."""
    distance: FloatArray
    """(T,) displacement of the true origin, as a part of its distance to the camera."""


@dataclass(frozen=True)
class ObjectMetrics:
    """Scores of one object over the frames that observe it; None where none could be scored."""

    instance: int
    frames: int
    """Frames scored."""
    rotation_rms_deg: float | None
    rotation_max_deg: float | None
    distance_rms: float | None
    """Displacement as a part of the distance to the camera."""
    distance_max: float | None


@dataclass(frozen=True)
class ObjectReport:
    """Scores of all rigid objects of a run."""

    protocol: str
    objects: tuple[ObjectMetrics, ...]
    without_truth: tuple[int, ...]
    """Instances taken for rigid of which no true pose is known: wrongly, where the truth has all that are rigid."""
    not_found: tuple[int, ...]
    """Instances with a true pose that were not taken for rigid."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return {**asdict(self), **{name: list(getattr(self, name)) for name in ("without_truth", "not_found")}}


def evaluate_objects(
    instance: Int32Array,
    reference: Int32Array,
    observed: BoolArray,
    world_T_object: FloatArray,
    world_T_cam: FloatArray,
    true_instance: Int32Array,
    true_world_T_object: FloatArray,
    true_world_T_cam: FloatArray,
) -> ObjectReport:
    """Score the J objects of a run.

    Args:
        instance: (J,) mask ids.
        reference: (J,) frames from which motion is counted.
        observed: (J, T) frames that are scored.
        world_T_object: (J, T, 4, 4) estimate, m.
        world_T_cam: (T, 4, 4) the estimate's cameras.
        true_instance: (K,) mask ids.
        true_world_T_object: (K, T, 4, 4) truth, m.
        true_world_T_cam: (T, 4, 4) the true cameras.
    """
    rows = {int(name): row for row, name in enumerate(true_instance)}
    scored = []
    for j, name in enumerate(instance.tolist()):
        if name in rows:
            seen = np.where(observed[j, :, None, None], world_T_object[j], np.nan)
            seen[reference[j]] = world_T_object[j, reference[j]]
            errors = object_motion_errors(
                seen, true_world_T_object[rows[name]], world_T_cam, true_world_T_cam, int(reference[j])
            )
            scored.append(_metrics(name, errors))
    return ObjectReport(
        "motion since the reference frame, seen from its camera, no alignment",
        tuple(scored),
        tuple(name for name in instance.tolist() if name not in rows),
        tuple(name for name in rows if name not in instance),
    )


def _metrics(instance: int, errors: ObjectMotionErrors) -> ObjectMetrics:
    known = np.isfinite(errors.rotation_deg) & np.isfinite(errors.distance)
    scores: list[float | None] = []
    for values in (errors.rotation_deg[known], errors.distance[known]):
        scores += [float(np.sqrt(np.mean(values**2))), float(values.max())] if known.any() else [None, None]
    return ObjectMetrics(instance, int(known.sum()), *scores)


def object_motion_errors(
    world_T_object: FloatArray,
    true_world_T_object: FloatArray,
    world_T_cam: FloatArray,
    true_world_T_cam: FloatArray,
    reference: int,
) -> ObjectMotionErrors:
    """Score the poses of one object.

    Args:
        world_T_object: (T, 4, 4) estimate, m; NaN where unknown, but not in the reference frame.
        true_world_T_object: (T, 4, 4) truth, m.
        world_T_cam: (T, 4, 4) the estimate's cameras.
        true_world_T_cam: (T, 4, 4) the true cameras.
        reference: Frame from which motion is counted.
    """
    found = _motion(world_T_object, world_T_cam[reference], reference)
    true = _motion(true_world_T_object, true_world_T_cam[reference], reference)
    known = np.isfinite(found).all(axis=(1, 2)) & np.isfinite(true).all(axis=(1, 2))
    origin = (se3.inverse(true_world_T_cam[reference]) @ true_world_T_object[reference])[:, 3]
    away = np.linalg.norm((se3.inverse(true_world_T_cam) @ true_world_T_object)[:, :3, 3], axis=1)
    angle, distance = np.full((2, len(found)), np.nan)
    turn = np.swapaxes(found[known, :3, :3], 1, 2) @ true[known, :3, :3]
    angle[known] = np.degrees(np.linalg.norm(se3.so3_log(turn), axis=1))
    distance[known] = np.linalg.norm(((found - true)[known] @ origin)[:, :3], axis=1) / away[known]
    return ObjectMotionErrors(angle, distance)


def _motion(world_T_object: FloatArray, camera: FloatArray, reference: int) -> FloatArray:
    back = se3.inverse(world_T_object[reference])
    result: FloatArray = se3.inverse(camera) @ world_T_object @ back @ camera
    return result
