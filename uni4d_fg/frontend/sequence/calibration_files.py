"""Calibrations in the files of other programs: COLMAP, OpenCV, ROS, Kalibr, nerfstudio.

| file | what it holds | pixel centers |
|---|---|---|
| ``.npy`` | a (3, 3) matrix, or one per frame | integers |
| ``.txt`` | a (3, 3) matrix, as ``numpy.savetxt`` writes it | integers |
| ``.txt`` | COLMAP's ``cameras.txt`` with one camera | 0.5 |
| ``.json`` | nerfstudio's ``transforms.json`` | 0.5 |
| ``.yaml``, ``.yml`` | OpenCV's ``FileStorage``, ROS's ``camera_info``, Kalibr's ``camchain`` | integers |

Formats: https://colmap.github.io/cameras.html, https://docs.nerf.studio/quickstart/data_conventions.html,
https://github.com/ethz-asl/kalibr/wiki/yaml-formats. Images of another size, with the same shape, are allowed for: the
calibration is scaled.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.yaml_text import parse_yaml
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.frontend.sequence.calibration import check_intrinsics, load_intrinsics, shared_intrinsics
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.resize import scale_intrinsics
from uni4d_fg.geometry.lens import PINHOLE, Lens, LensModel
from uni4d_fg.reading import read_json, read_text

MAX_SHAPE_CHANGE = 0.01
"""Part by which the shape (width over height) of the calibrated image may differ from the video's."""

_COLMAP: dict[str, tuple[int, LensModel]] = {
    "SIMPLE_PINHOLE": (1, "PINHOLE"),
    "PINHOLE": (2, "PINHOLE"),
    "SIMPLE_RADIAL": (1, "SIMPLE_RADIAL"),
    "RADIAL": (1, "RADIAL"),
    "OPENCV": (2, "OPENCV"),
    "OPENCV_FISHEYE": (2, "OPENCV_FISHEYE"),
}
"""Number of focal lengths, and our model, per model of COLMAP's."""
_SIZES = {"PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 4}


@dataclass(frozen=True)
class Calibration:
    """A camera model with its numbers."""

    intrinsics: FloatArray
    """(4,) fx, fy, cx, cy, px; pixel centers at integers."""
    lens: Lens = PINHOLE
    size: tuple[int, int] | None = None
    """(height, width) of the calibrated images, if the file says so."""


def load_calibration(path: Path, num_frames: int, size: tuple[int, int]) -> Calibration:
    """Read a calibration for a video.

    Args:
        path: The file; its ending says which format it is.
        num_frames: T.
        size: (height, width) of the video, px.

    Raises:
        InputError: If the file cannot be read, its model is not known here, it is of images of another shape, or it
            can be that of no camera with such images.
    """
    found = _read(path, num_frames, size)
    check_intrinsics(found.intrinsics, size, path)
    return found


def _read(path: Path, num_frames: int, size: tuple[int, int]) -> Calibration:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return Calibration(load_intrinsics(path, num_frames, size))
    if suffix not in (".txt", ".json", ".yaml", ".yml"):
        raise SequenceProblem(path, "is no calibration that is known", "give .npy, .txt, .json, .yaml or .yml")
    matrix = _matrix(path) if suffix == ".txt" else None
    if matrix is not None:
        return Calibration(shared_intrinsics(matrix, path, num_frames, size))
    read = {".txt": _colmap, ".json": _nerfstudio}.get(suffix, _yaml)
    try:
        found = read(path)
        numbers = np.concatenate([found.intrinsics, found.lens.padded])
        if not np.isfinite(numbers).all() or (found.intrinsics[:2] <= 0).any():
            raise SequenceProblem(
                path, "has a focal length that is not positive, or a number that is not finite", "check it"
            )
        return _fitted(path, found, size)
    except SequenceProblem:
        raise
    except (InputError, LookupError, TypeError, ValueError, ArithmeticError) as error:  # InputError: of the lens
        raise SequenceProblem(path, f"has no complete calibration ({str(error)[:200]})", "export it again") from error


def _fitted(path: Path, found: Calibration, size: tuple[int, int]) -> Calibration:
    """Scale a calibration to the size of the video."""
    if found.size is None or found.size == size:
        return Calibration(found.intrinsics, found.lens, size)
    (height, width), (h, w) = found.size, size
    if min(height, width) < 1 or abs(math.log((w / h) / (width / height))) > MAX_SHAPE_CHANGE:
        raise SequenceProblem(
            path, f"is of images of {width}x{height} px, but the video has {w}x{h} px", "calibrate the video's own mode"
        )
    return Calibration(scale_intrinsics(found.intrinsics, found.size, size), found.lens, size)


def _matrix(path: Path) -> FloatArray | None:
    """Return the matrix (3, 3) of a text file of three lines with three numbers each; None for another file."""
    lines = [line.replace(",", " ").split() for line in _lines(path)]
    if [len(line) for line in lines] != [3, 3, 3]:
        return None
    try:
        return np.array(lines, dtype=np.float64)
    except ValueError:
        return None


def _lines(path: Path) -> list[str]:
    """Return the lines of a text file that are neither empty nor comments."""
    return [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]


def _colmap(path: Path) -> Calibration:
    lines = [line.split() for line in _lines(path)]
    if len(lines) != 1:
        raise SequenceProblem(path, f"has {len(lines)} cameras", "give a cameras.txt with the one camera of the video")
    _, model, width, height, *numbers = lines[0]
    if model not in _COLMAP:
        raise SequenceProblem(
            path, f"has the camera model {model[:40]}", f"undistort, or use one of {', '.join(_COLMAP)}"
        )
    count, ours = _COLMAP[model]
    values = [float(v) for v in numbers]
    if len(values) != count + 2 + _SIZES[ours]:
        raise ValueError(f"{model} has {count + 2 + _SIZES[ours]} numbers, not {len(values)}")
    focal = [values[0], values[count - 1]]
    center = [v - 0.5 for v in values[count : count + 2]]
    return Calibration(np.array([*focal, *center]), Lens(ours, tuple(values[count + 2 :])), (int(height), int(width)))


def _nerfstudio(path: Path) -> Calibration:
    data = read_json(path)
    if not isinstance(data, Mapping) or "fl_x" not in data:
        raise SequenceProblem(
            path, "has no camera that all frames share", "write fl_x, fl_y, cx, cy into its top level"
        )
    fx = float(data["fl_x"])
    fisheye = data.get("camera_model") in ("OPENCV_FISHEYE", "FISHEYE")
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    if not fisheye and any(float(data.get(name, 0.0)) for name in ("k3", "k4", "k5", "k6")):
        raise SequenceProblem(path, "has radial terms beyond k2", "calibrate with k1, k2, p1, p2")
    intrinsics = np.array([fx, float(data.get("fl_y", fx)), float(data["cx"]) - 0.5, float(data["cy"]) - 0.5])
    size = (int(data["h"]), int(data["w"])) if "h" in data and "w" in data else None
    return Calibration(intrinsics, _lens([float(data.get(n, 0.0)) for n in names], fisheye, path), size)


def _yaml(path: Path) -> Calibration:
    # OpenCV writes "%YAML:1.0", which is no YAML, and tags its matrices.
    text = re.sub(r"^%YAML.*$", "", read_text(path), flags=re.MULTILINE).replace("!!opencv-matrix", "")
    try:
        data = parse_yaml(text)
    except ConfigError as error:
        raise SequenceProblem(path, f"cannot be read as YAML ({error})", "export it again") from error
    if not isinstance(data, Mapping):
        raise SequenceProblem(path, "holds no calibration", "give what OpenCV, ROS or Kalibr wrote")
    cameras = [
        value for name, value in data.items() if re.fullmatch(r"cam\d+", str(name)) and isinstance(value, Mapping)
    ]
    if len(cameras) > 1:
        raise SequenceProblem(path, f"has {len(cameras)} cameras", "keep the one that filmed the video")
    return _kalibr(cameras[0], path) if cameras else _opencv(data, path)


def _kalibr(data: Mapping[str, Any], path: Path) -> Calibration:
    kind = data.get("distortion_model", "none")
    if data.get("camera_model", "pinhole") != "pinhole" or kind not in ("radtan", "equidistant", "none"):
        raise SequenceProblem(
            path,
            f"has the model {str(data.get('camera_model'))[:40]}-{str(kind)[:40]}",
            "use pinhole with radtan or equidistant",
        )
    width, height = (int(v) for v in data["resolution"])
    numbers = [float(v) for v in data.get("distortion_coeffs", [])]
    intrinsics = np.array([float(v) for v in data["intrinsics"]])
    if intrinsics.shape != (4,):
        raise ValueError("intrinsics are fx, fy, cx, cy")
    lens = PINHOLE if kind == "none" else _lens(numbers, kind == "equidistant", path)
    return Calibration(intrinsics, lens, (height, width))


def _opencv(data: Mapping[str, Any], path: Path) -> Calibration:
    matrix = _first(data, ("camera_matrix", "cameraMatrix", "K", "intrinsics"))
    numbers = _first(data, ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D"), default=[])
    if matrix is None:
        raise SequenceProblem(path, "has no camera_matrix", "give what OpenCV, ROS or Kalibr wrote")
    k = _numbers(matrix)
    if len(k) != 9 or abs(k[1]) > 1e-3 * abs(k[0]):
        raise ValueError("the camera matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    kind = str(data.get("distortion_model", ""))
    fisheye = kind in ("equidistant", "fisheye") or bool(data.get("fisheye_model", 0))
    if kind not in ("", "plumb_bob", "rational_polynomial", "equidistant", "fisheye"):
        raise SequenceProblem(path, f"has the distortion model {kind[:40]}", "use plumb_bob or equidistant")
    width, height = data.get("image_width"), data.get("image_height")
    size = (int(height), int(width)) if height is not None and width is not None else None
    return Calibration(np.array([k[0], k[4], k[2], k[5]]), _lens(_numbers(numbers), fisheye, path), size)


def _lens(numbers: Sequence[float], fisheye: bool, path: Path) -> Lens:
    """Return a lens of OpenCV's list of coefficients; terms beyond the fourth must be zero."""
    padded = [*numbers, *([0.0] * 4)]
    if any(padded[4:]):
        raise SequenceProblem(
            path,
            f"has {len(numbers)} distortion coefficients",
            "calibrate with the first four (OpenCV: fix K3 and more)",
        )
    if not any(padded[:4]) and not fisheye:
        return PINHOLE
    return Lens("OPENCV_FISHEYE" if fisheye else "OPENCV", tuple(padded[:4]))


def _first(data: Mapping[str, Any], names: Sequence[str], default: Any = None) -> Any:
    return next((data[name] for name in names if name in data), default)


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a list, a nested list, or a mapping with ``data``."""
    if isinstance(value, Mapping):
        value = value["data"]
    return [float(v) for v in np.asarray(value, dtype=np.float64).ravel()]
