"""Bundle adjustment with a lens, or a focal length per frame, in place of the pinhole's intrinsics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.camera import CameraConfig
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.camera_priors import fisheye_camera_prior, opencv_camera_prior
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.lens_reprojection import fisheye_reprojection, opencv_reprojection
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import FISHEYE_CAMERA, INTRINSICS, LANDMARK, OPENCV_CAMERA, POSE, ZOOM
from uni4d_fg.factors.zoom import zoom_smoothness, zoomed_reprojection
from uni4d_fg.geometry.lens import LensModel
from uni4d_fg.optim.problem import Problem


@dataclass(frozen=True)
class RealPixels:
    """N observations as the images show them."""

    frame: IntArray
    """(N,) row of the pose."""
    row: IntArray
    """(N,) row of the landmark."""
    uv: FloatArray
    """(N, 2) px."""
    noise: Mapping[str, Any]
    """Sigma, weights and kernel of the reprojection term."""


def lens_family(model: LensModel) -> tuple[VariableType, FactorType, FactorType]:
    """Return the variable of a model's family, its reprojection and its prior."""
    if model == "OPENCV_FISHEYE":
        return FISHEYE_CAMERA, fisheye_reprojection, fisheye_camera_prior
    return OPENCV_CAMERA, opencv_reprojection, opencv_camera_prior


def lens_problem(
    pinhole: State,
    others: Iterable[FactorBatch],
    seen: RealPixels,
    camera: FloatArray,
    model: LensModel,
    prior_intrinsics: FloatArray,
    ba: BundleAdjustmentConfig,
    config: CameraConfig,
) -> tuple[Problem, State]:
    """Return bundle adjustment with a camera of eight numbers; which of them are held is up to the caller.

    Args:
        pinhole: Poses, intrinsics and landmarks.
        others: Terms of the pinhole's bundle adjustment; those of its intrinsics are left out.
        seen: What takes the place of its reprojection.
        camera: (8,) intrinsics and distortion to start from.
        model: Whose family the camera is of.
        prior_intrinsics: (4,) the sequence's own, px.
        ba: Priors on the focal lengths.
        config: The prior on the distortion.
    """
    variable, reprojection, prior = lens_family(model)
    arrays = {v: array for v, array in pinhole.arrays.items() if v is not INTRINSICS}
    state = State({variable: camera[None], **arrays}, pinhole.index)
    problem = Problem.over(state).eliminate(LANDMARK).fix(POSE, rows=[0])
    problem.add(batch for batch in others if all(slot.variable is not INTRINSICS for slot in batch.slots))
    problem.add(reprojection(seen.frame, seen.row, 0, uv=seen.uv, **seen.noise))
    fx, fy = prior_intrinsics[:2]
    focal = ba.focal_prior_fraction * np.array([fx, fy, fx, fy])
    wide = np.concatenate([focal, np.full(4, config.parameter_prior_sigma), [ba.aspect_prior_sigma]])
    center = np.concatenate([prior_intrinsics, np.zeros(4)])
    return problem.add(prior(0, measured=center[None], log_aspect=[np.log(fx / fy)], sigma=wide[None])), state


def zoom_problem(
    plain: State,
    others: Iterable[FactorBatch],
    seen: RealPixels,
    frames: IntArray,
    ba: BundleAdjustmentConfig,
    config: CameraConfig,
) -> tuple[Problem, State]:
    """Return bundle adjustment with a focal length per frame; that of the first frame is the intrinsics' own.

    Args:
        plain: Poses, intrinsics and landmarks of a camera that does not zoom.
        others: Terms of its bundle adjustment; the reprojection is left out.
        seen: What takes its place.
        frames: (F,) frames of the video that the poses are of, ascending.
        ba: Whether the principal point is held.
        config: How smoothly the focal length changes.
    """
    state = State({**plain.arrays, ZOOM: np.zeros((len(frames), 1))}, plain.index)
    problem = Problem.over(state).eliminate(LANDMARK).fix(POSE, rows=[0]).fix(ZOOM, rows=[0])
    if not ba.free_principal_point:
        problem.fix(INTRINSICS, entries=[2, 3])
    problem.add(batch for batch in others if batch.factor_type is not static_reprojection)
    problem.add(zoomed_reprojection(seen.frame, seen.row, 0, seen.frame, uv=seen.uv, **seen.noise))
    first = np.arange(len(frames) - 1)
    step = config.zoom_per_frame * np.sqrt(np.diff(frames))
    return problem.add(zoom_smoothness(first, first + 1, sigma=step[:, None])), state
