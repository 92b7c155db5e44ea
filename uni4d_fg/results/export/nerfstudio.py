"""nerfstudio: ``transforms.json`` with ``images/``, optionally ``masks/`` and ``depths/``, and ``sparse_pc.ply``.

Its camera axes are OpenGL's (x right, y up, z backward): the y and z columns of the rotation change sign. The ray
of a pixel starts at its center, (x + 0.5, y + 0.5): 0.5 is added to cx and cy
(https://docs.nerf.studio/quickstart/data_conventions.html). The world is not turned; nerfstudio orients and scales
it itself, the points of the ``.ply`` with it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.files import atomic_write_json
from uni4d_fg.results.clouds import write_ply
from uni4d_fg.results.export.clouds import static_cloud
from uni4d_fg.results.export.frames import MAX_PNG_DEPTH, depth_png, encode, write_confidence, write_images, write_masks
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.results.normals import normal_colors, normal_map

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
NORMALS = "normals_from_pretrain"
"""The folder in which DN-Splatter, an extension of nerfstudio, looks for normals."""


def opengl_poses(world_T_cam: FloatArray) -> FloatArray:
    """Return camera-to-world matrices (T, 4, 4) of cameras with OpenGL axes in the same world."""
    poses: FloatArray = world_T_cam @ OPENGL_FROM_OPENCV
    return poses


def write_nerfstudio(job: ExportJob) -> None:
    """Write a nerfstudio dataset; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    names = write_images(job, job.folder / "images")
    stems = [Path(name).stem for name in names]
    result = job.run.reconstruction
    elapsed = result.timestamps - result.timestamps[0]
    span = float(elapsed[-1]) or 1.0
    frames: list[dict[str, Any]] = [
        {"file_path": f"images/{name}", "transform_matrix": pose.tolist(), "time": float(t) / span, "timestamp": stamp}
        for name, pose, t, stamp in zip(
            names, opengl_poses(result.world_T_cam), elapsed, result.timestamps.tolist(), strict=True
        )
    ]
    if result.zoom is not None:
        for frame, (fl_x, fl_y, _, _) in zip(frames, result.frame_intrinsics.tolist(), strict=True):
            frame |= {"fl_x": fl_x, "fl_y": fl_y}
    if not job.run.has_times:
        # Seconds that are frame numbers would be a film of one frame a second.
        for frame in frames:
            del frame["timestamp"]
    cloud = static_cloud(job.run)
    write_ply(job.folder / "sparse_pc.ply", cloud.points, cloud.colors)
    job.facts.append(f"{len(names)} images, {len(cloud.points)} points to start from")
    if job.options.masks and write_masks(job, job.folder / "masks", [f"{stem}.png" for stem in stems]):
        for frame, stem in zip(frames, stems, strict=True):
            frame["mask_path"] = f"masks/{stem}.png"
        job.facts.append("masks/: 0 where something moves; --no-masks leaves them out")
    meta: dict[str, Any] = {}
    if job.options.depth:
        _write_depth(job, job.folder / "depths", stems, frames)
        write_confidence(job, job.folder / "confidence", stems)
        meta["depth_unit_scale_factor"] = 0.001
    fx, fy, cx, cy = result.intrinsics.tolist()
    height, width = result.image_size
    names_of_lens = ("k1", "k2", "k3", "k4") if result.lens.is_fisheye else ("k1", "k2", "p1", "p2")
    camera: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if result.lens.is_fisheye else "OPENCV",
        "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": width, "h": height,
        **dict(zip(names_of_lens, result.lens.padded.tolist(), strict=True)),
    }  # fmt: skip
    if result.zoom is not None:
        # Where the whole video has a focal length, nerfstudio does not look for those of its frames.
        del camera["fl_x"], camera["fl_y"]
    if job.options.normals:
        _write_normals(job, job.folder / NORMALS, stems)
    atomic_write_json(
        job.folder / "transforms.json", camera | meta | {"ply_file_path": "sparse_pc.ply", "frames": frames}
    )
    job.figures |= {"images": len(names), "points": len(cloud.points)}


def _write_normals(job: ExportJob, folder: Path, stems: list[str]) -> None:
    depths, result = job.run.need_depth("--normals"), job.run.reconstruction
    folder.mkdir()
    flip = np.diag(OPENGL_FROM_OPENCV)[:3].astype(np.float32)
    for frame, (stem, depth) in enumerate(zip(stems, depths, strict=True)):
        path = folder / f"{stem}.png"
        normals = normal_map(depth, result.frame_intrinsics[frame]) * flip
        path.write_bytes(encode(normal_colors(normals), ".png", path))
        job.check()
    job.facts.append(
        f"{NORMALS}/: normals in OpenGL's camera axes, (n + 1) / 2 as 8-bit RGB, as DN-Splatter reads them"
    )


def _write_depth(job: ExportJob, folder: Path, stems: list[str], frames: list[dict[str, Any]]) -> None:
    depths = job.run.need_depth("--depth")
    folder.mkdir()
    too_far = 0
    for stem, frame, depth in zip(stems, frames, depths, strict=True):
        path = folder / f"{stem}.png"
        path.write_bytes(depth_png(depth, path))
        frame["depth_file_path"] = f"depths/{stem}.png"
        with np.errstate(invalid="ignore"):
            too_far += int((depth > MAX_PNG_DEPTH).sum())
        job.check()
    job.facts.append("depths/: 16-bit PNG, millimeters, 0 missing")
    if too_far:
        job.warnings.append(f"{too_far} pixels beyond {MAX_PNG_DEPTH} m do not fit into 16-bit millimeters: missing")
