"""Reading and writing of ``reconstruction.npz``, and the checks a reconstruction has to pass."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import load_npz, save_npz
from uni4d_fg.geometry.lens import PARAMETERS, Lens
from uni4d_fg.slam.reconstruction import OBJECT_ARRAYS, Reconstruction

FORMAT_VERSION = 1

_ROTATION_TOLERANCE = 1e-6

# Array name: (dtype, shape), with T frames, N landmarks, M dynamic tracks and J rigid objects.
_LAYOUT: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "world_T_cam": ("float64", ("T", 4, 4)),
    "intrinsics": ("float64", (4,)),
    "timestamps": ("float64", ("T",)),
    "image_size": ("int64", (2,)),
    "depth_log_scale": ("float64", ("T",)),
    "landmarks": ("float64", ("N", 3)),
    "landmark_track": ("int32", ("N",)),
    "landmark_color": ("uint8", ("N", 3)),
    "landmark_error": ("float32", ("N",)),
    "dynamic_points": ("float64", ("M", "T", 3)),
    "dynamic_observed": ("bool", ("M", "T")),
    "dynamic_track": ("int32", ("M",)),
    "dynamic_instance": ("int32", ("M",)),
    "dynamic_color": ("uint8", ("M", 3)),
}
_OPTIONAL: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "pose_covariance": ("float64", ("T", 6, 6)),
    "intrinsics_covariance": ("float64", (4, 4)),
    "zoom": ("float64", ("T",)),
    "lens_model": ("int64", (1,)),
    "lens_parameters": ("float64", (4,)),
    "object_instance": ("int32", ("J",)),
    "object_reference": ("int32", ("J",)),
    "object_observed": ("bool", ("J", "T")),
    "object_world_T_object": ("float64", ("J", "T", 4, 4)),
    "object_covariance": ("float64", ("J", "T", 6, 6)),
    "object_velocity": ("float64", ("J", "T", 6)),
}
_MAY_BE_NAN = ("dynamic_points", "landmark_error", *_OPTIONAL)


def save_reconstruction(path: Path, reconstruction: Reconstruction) -> None:
    """Write a reconstruction to an ``.npz``, whole or not at all.

    Raises:
        OutputError: If it is not a valid reconstruction (it could not be read back) or cannot be written.
    """
    arrays = _arrays(reconstruction)
    problem = _problem(arrays)
    if problem:
        raise OutputError(f"{path}: not written, the reconstruction is not valid: {problem}")
    typed = {name: array.astype((_LAYOUT | _OPTIONAL)[name][0]) for name, array in arrays.items()}
    save_npz(path, format_version=np.int64(FORMAT_VERSION), **typed)


def reconstruction_problem(reconstruction: Reconstruction) -> str | None:
    """Return why a reconstruction is not one that a file may hold, or None."""
    return _problem(_arrays(reconstruction))


def _arrays(reconstruction: Reconstruction) -> dict[str, npt.NDArray[Any]]:
    """Return what a file holds of a reconstruction."""
    arrays = {name: np.asarray(getattr(reconstruction, name)) for name in _LAYOUT}
    known = {name: getattr(reconstruction, name) for name in _OPTIONAL if not name.startswith("lens_")}
    if not reconstruction.lens.is_pinhole:
        known["lens_model"] = [list(PARAMETERS).index(reconstruction.lens.model)]
        known["lens_parameters"] = reconstruction.lens.padded
    return arrays | {name: np.asarray(array) for name, array in known.items() if array is not None}


def load_reconstruction(path: str | Path) -> Reconstruction:
    """Read a reconstruction and check it.

    Raises:
        InputError: If the file is missing, damaged, of a newer format, or holds arrays whose shapes
            disagree, values that are not finite where they must be, or poses that are not rigid.
    """
    path = Path(path)
    version = load_npz(path, {"format_version": 0}, {})["format_version"]
    if version != FORMAT_VERSION:
        raise InputError(
            f"{path}: format version {version}, but this program reads version {FORMAT_VERSION}; "
            "use the version of uni4d_fg that wrote it"
        )
    required, optional = ({name: len(shape) for name, (_, shape) in part.items()} for part in (_LAYOUT, _OPTIONAL))
    arrays = load_npz(path, required, optional)
    problem = _problem(arrays)
    if problem:
        raise InputError(f"{path}: not a valid reconstruction: {problem}")
    values: dict[str, Any] = {name: array.astype((_LAYOUT | _OPTIONAL)[name][0]) for name, array in arrays.items()}
    height, width = values.pop("image_size").tolist()
    model, parameters = values.pop("lens_model", [0]), values.pop("lens_parameters", np.zeros(4))
    lens = Lens.of(list(PARAMETERS)[int(model[0])], parameters)
    return Reconstruction(image_size=(height, width), lens=lens, **values)


def _problem(arrays: dict[str, npt.NDArray[Any]]) -> str | None:
    """Return what is wrong with the arrays of a reconstruction, or None."""
    sizes: dict[str, int] = {}
    for name, (dtype, shape) in (_LAYOUT | _OPTIONAL).items():
        if name not in arrays:
            continue
        actual = arrays[name].shape
        expected = "(" + ", ".join(map(str, shape)) + ")"
        if len(actual) != len(shape):
            return f"{name} has shape {actual}, expected {expected}"
        for length, symbol in zip(actual, shape, strict=True):
            wanted = symbol if isinstance(symbol, int) else sizes.setdefault(symbol, length)
            if length != wanted:
                known = "".join(f", {key} = {value}" for key, value in sizes.items())
                return f"{name} has shape {actual}, expected {expected}{known}"
        if dtype.startswith(("int", "uint")) and arrays[name].dtype.kind not in "iu":
            return f"{name} has dtype {arrays[name].dtype}, expected {dtype}"
        if dtype.startswith(("int", "uint")) and not _fits(arrays[name], np.iinfo(dtype)):
            return f"{name} has a number that does not fit {dtype}"
        if dtype == "float64" and arrays[name].dtype.kind not in "fiu":
            return f"{name} has dtype {arrays[name].dtype}, expected numbers"
        if dtype == "bool" and arrays[name].dtype.kind != "b":
            return f"{name} has dtype {arrays[name].dtype}, expected bool"
        if name not in _MAY_BE_NAN and not np.isfinite(arrays[name]).all():
            return f"{name} has a value that is NaN or infinite"
    return _value_problem(arrays)


def _value_problem(arrays: dict[str, npt.NDArray[Any]]) -> str | None:
    poses = arrays["world_T_cam"]
    if not len(poses):
        return "it has no frame"
    rigid = _is_rigid(poses)
    if not rigid.all():
        return f"pose {int(np.argmin(rigid))} is not a rigid transform"
    if any((arrays[name] < 0).any() for name in ("landmark_track", "dynamic_track")):
        return "a track has a negative number"
    if (np.diff(arrays["timestamps"]) <= 0.0).any():
        return "timestamps do not increase"
    if (arrays["intrinsics"][:2] <= 0.0).any() or (arrays["image_size"] <= 0).any():
        return "focal lengths and image size must be positive"
    if np.isinf(arrays["dynamic_points"]).any():
        return "dynamic_points has an infinite value"
    if not np.isfinite(arrays["dynamic_points"][arrays["dynamic_observed"]]).all():
        return "an observed dynamic point has no position"
    if np.isinf(arrays["landmark_error"]).any():
        return "landmark_error has an infinite value"
    if ("lens_model" in arrays) != ("lens_parameters" in arrays):
        return "of lens_model and lens_parameters there is only one"
    if "lens_model" in arrays:
        known = 0 <= int(arrays["lens_model"][0]) < len(PARAMETERS)
        if not known or not np.isfinite(arrays["lens_parameters"]).all():
            return "its camera model is unknown, or a distortion parameter is not finite"
    if "zoom" in arrays and not (arrays["zoom"] > 0.0).all():
        return "zoom must be positive"
    for name in _OPTIONAL:
        if name in arrays and np.isinf(arrays[name]).any():
            return f"{name} has an infinite value"
    return _object_problem(arrays)


def _object_problem(arrays: dict[str, npt.NDArray[Any]]) -> str | None:
    known = [name for name in OBJECT_ARRAYS if name in arrays]
    if not known:
        return None
    if len(known) < len(OBJECT_ARRAYS):
        return f"it has {known[0]} but not {', '.join(sorted(set(OBJECT_ARRAYS) - set(known)))}"
    poses, reference = arrays["object_world_T_object"], arrays["object_reference"]
    has_pose = np.isfinite(poses).all(axis=(2, 3))
    if not _is_rigid(poses[has_pose]).all():
        return "object_world_T_object has a pose that is not a rigid transform"
    if (arrays["object_observed"] & ~has_pose).any():
        return "an observed rigid object has no pose"
    inside = (reference >= 0) & (reference < poses.shape[1])
    if not inside.all() or not has_pose[np.arange(len(poses)), reference].all():
        return "object_reference names a frame without a pose of the object"
    return None


def _fits(array: npt.NDArray[Any], limits: np.iinfo[Any]) -> bool:
    return not array.size or (int(array.min()) >= limits.min and int(array.max()) <= limits.max)


def _is_rigid(poses: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return which matrices (N, 4, 4) are rigid transforms."""
    rotation = poses[:, :3, :3]
    deviation = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
    rigid = (deviation <= _ROTATION_TOLERANCE) & (np.linalg.det(rotation) > 0.0)
    return np.asarray(rigid & (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1))
