"""COLMAP's model files, as text and binary: ``cameras``, ``images`` and ``points3D``.

Layouts: https://colmap.github.io/format.html. Ids count from 1; a row of this module is its id less 1.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.geometry.lens import PINHOLE, Lens

CAMERA_MODELS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5}
"""COLMAP's numbers of the models with fx, fy, cx, cy, of which the last two have four parameters more."""


@dataclass(frozen=True)
class ColmapModel:
    """One camera, T images and P points, in COLMAP's conventions: world to camera, pixel centers at 0.5."""

    image_size: tuple[int, int]
    """(height, width), px."""
    intrinsics: FloatArray
    """(4,) fx, fy, cx, cy, px."""
    names: list[str]
    """T file names."""
    quaternions: FloatArray
    """(T, 4) w, x, y, z of the rotation from world to camera."""
    translations: FloatArray
    """(T, 3) meters."""
    points: FloatArray
    """(P, 3) meters."""
    colors: ImageArray
    """(P, 3) RGB."""
    errors: FloatArray
    """(P,) mean reprojection error, px."""
    point: IntArray
    """(N,) row of the point that each observation saw; ascending."""
    image: IntArray
    """(N,) row of the image of each observation."""
    uv: FloatArray
    """(N, 2) px."""
    lens: Lens = PINHOLE

    def index_in_image(self) -> IntArray:
        """Return the place of every observation in the list of its image, (N,)."""
        order = np.argsort(self.image, kind="stable")
        first = np.searchsorted(self.image[order], self.image[order])
        index = np.empty(len(order), dtype=np.int64)
        index[order] = np.arange(len(order)) - first
        return index

    def of_image(self) -> list[IntArray]:
        """Return the observations (rows) of each image in turn."""
        order = np.argsort(self.image, kind="stable")
        return np.split(order, np.searchsorted(self.image[order], np.arange(1, len(self.names))))

    def of_point(self) -> IntArray:
        """Return where the observations of each point begin and end, (P + 1,)."""
        return np.asarray(np.searchsorted(self.point, np.arange(len(self.points) + 1)))


def camera_parameters(model: ColmapModel) -> tuple[str, FloatArray]:
    """Return COLMAP's name of the camera model, and its numbers.

    SIMPLE_RADIAL and RADIAL have one focal length in COLMAP; with two, they are written as OPENCV.
    """
    if model.lens.is_pinhole:
        return "PINHOLE", model.intrinsics
    name = "OPENCV_FISHEYE" if model.lens.is_fisheye else "OPENCV"
    return name, np.concatenate([model.intrinsics, model.lens.padded])


def write_binary(model: ColmapModel, folder: Path) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``; the folder must exist. Raises OSError."""
    height, width = model.image_size
    name, parameters = camera_parameters(model)
    camera = struct.pack("<QiiQQ", 1, 1, CAMERA_MODELS[name], width, height)
    (folder / "cameras.bin").write_bytes(camera + struct.pack(f"<{len(parameters)}d", *parameters.tolist()))
    record = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
    with open(folder / "images.bin", "wb") as stream:
        stream.write(struct.pack("<Q", len(model.names)))
        for row, seen in enumerate(model.of_image()):
            pose = (*model.quaternions[row].tolist(), *model.translations[row].tolist())
            stream.write(struct.pack("<i7di", row + 1, *pose, 1))
            stream.write(model.names[row].encode() + b"\0" + struct.pack("<Q", len(seen)))
            observed = np.empty(len(seen), dtype=record)
            observed["uv"], observed["point"] = model.uv[seen], model.point[seen] + 1
            stream.write(observed.tobytes())
    pairs = np.stack((model.image + 1, model.index_in_image()), axis=1).astype("<i4")
    bounds = model.of_point()
    with open(folder / "points3D.bin", "wb") as stream:
        stream.write(struct.pack("<Q", len(model.points)))
        for row, (xyz, rgb) in enumerate(zip(model.points.tolist(), model.colors.tolist(), strict=True)):
            track = pairs[bounds[row] : bounds[row + 1]]
            stream.write(struct.pack("<Q3d3BdQ", row + 1, *xyz, *rgb, float(model.errors[row]), len(track)))
            stream.write(track.tobytes())


def write_text(model: ColmapModel, folder: Path) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; the folder must exist. Raises OSError."""
    height, width = model.image_size
    with open(folder / "cameras.txt", "w", encoding="utf-8") as stream:
        name, parameters = camera_parameters(model)
        stream.write("# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy, then the distortion\n")
        stream.write(f"1 {name} {width} {height} {_numbers(parameters)}\n")
    with open(folder / "images.txt", "w", encoding="utf-8") as stream:
        stream.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of X, Y, POINT3D_ID\n")
        for row, seen in enumerate(model.of_image()):
            pose = np.concatenate((model.quaternions[row], model.translations[row]))
            stream.write(f"{row + 1} {_numbers(pose)} 1 {model.names[row]}\n")
            observed = zip(model.uv[seen].tolist(), (model.point[seen] + 1).tolist(), strict=True)
            stream.write(" ".join(f"{u!r} {v!r} {point}" for (u, v), point in observed) + "\n")
    pairs = np.stack((model.image + 1, model.index_in_image()), axis=1)
    bounds = model.of_point()
    with open(folder / "points3D.txt", "w", encoding="utf-8") as stream:
        stream.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, then pairs of IMAGE_ID, POINT2D_IDX\n")
        for row, (xyz, (red, green, blue)) in enumerate(zip(model.points, model.colors.tolist(), strict=True)):
            track = " ".join(map(str, pairs[bounds[row] : bounds[row + 1]].ravel().tolist()))
            head = f"{row + 1} {_numbers(xyz)} {red} {green} {blue} {float(model.errors[row])!r}"
            stream.write(f"{head} {track}\n")


def depth_map_bytes(depth: Float32Array) -> bytes:
    """Return a depth map (H, W), meters, in the format of COLMAP's dense workspace; 0 where missing."""
    height, width = depth.shape
    return f"{width}&{height}&1&".encode() + np.nan_to_num(depth, nan=0.0).astype("<f4").tobytes()


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, values.tolist()))
