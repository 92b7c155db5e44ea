"""COLMAP's model files, as text and binary: ``cameras``, ``images`` and ``points3D``.

Layouts: https://colmap.github.io/format.html. Ids count from 1; a row of this module is its id less 1.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, IntArray, rows_by_group
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.slam.reconstruction import zoomed

CAMERA_MODELS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5}
"""COLMAP's numbers of the models with fx, fy, cx, cy, of which the last two have four parameters more."""


@dataclass(frozen=True)
class ColmapModel:
    """One camera (T with a zoom), T images and P points, as COLMAP has them: world to camera, pixel centers at 0.5."""

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
    zoom: FloatArray | None = None
    """(T,) focal length of each image over that of the intrinsics: each then has a camera of its own."""

    def camera_of(self, image: int) -> int:
        """Return the number of an image's camera, from 1."""
        return 1 if self.zoom is None else image + 1

    def index_in_image(self) -> IntArray:
        """Return the place of every observation in the list of its image, (N,)."""
        order = np.argsort(self.image, kind="stable")
        first = np.searchsorted(self.image[order], self.image[order])
        index = np.empty(len(order), dtype=np.int64)
        index[order] = np.arange(len(order)) - first
        return index

    def of_image(self) -> list[IntArray]:
        """Return the observations (rows) of each image in turn."""
        return rows_by_group(self.image, len(self.names))

    def of_point(self) -> IntArray:
        """Return where the observations of each point begin and end, (P + 1,)."""
        return np.asarray(np.searchsorted(self.point, np.arange(len(self.points) + 1)))


def camera_parameters(model: ColmapModel) -> tuple[str, list[FloatArray]]:
    """Return COLMAP's name of the camera model, and the numbers of each camera.

    SIMPLE_RADIAL and RADIAL have one focal length in COLMAP; with two, they are written as OPENCV.
    """
    cameras = zoomed(model.intrinsics, model.zoom, 1 if model.zoom is None else len(model.zoom))
    if model.lens.is_pinhole:
        return "PINHOLE", list(cameras)
    name = "OPENCV_FISHEYE" if model.lens.is_fisheye else "OPENCV"
    return name, [np.concatenate([camera, model.lens.padded]) for camera in cameras]


def write_binary(model: ColmapModel, folder: Path) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``; the folder must exist. Raises OSError."""
    height, width = model.image_size
    name, cameras = camera_parameters(model)
    with open(folder / "cameras.bin", "wb") as stream:
        stream.write(struct.pack("<Q", len(cameras)))
        for number, parameters in enumerate(cameras, start=1):
            stream.write(struct.pack("<iiQQ", number, CAMERA_MODELS[name], width, height))
            stream.write(struct.pack(f"<{len(parameters)}d", *parameters.tolist()))
    record = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
    with open(folder / "images.bin", "wb") as stream:
        stream.write(struct.pack("<Q", len(model.names)))
        for row, seen in enumerate(model.of_image()):
            pose = (*model.quaternions[row].tolist(), *model.translations[row].tolist())
            stream.write(struct.pack("<i7di", row + 1, *pose, model.camera_of(row)))
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
        name, cameras = camera_parameters(model)
        stream.write("# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy, then the distortion\n")
        for number, parameters in enumerate(cameras, start=1):
            stream.write(f"{number} {name} {width} {height} {_numbers(parameters)}\n")
    with open(folder / "images.txt", "w", encoding="utf-8") as stream:
        stream.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of X, Y, POINT3D_ID\n")
        for row, seen in enumerate(model.of_image()):
            pose = np.concatenate((model.quaternions[row], model.translations[row]))
            stream.write(f"{row + 1} {_numbers(pose)} {model.camera_of(row)} {model.names[row]}\n")
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
