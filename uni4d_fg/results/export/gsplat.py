"""Gaussian splatting: a COLMAP folder as the trainers of 3D Gaussian splatting read it.

``images/`` are undistorted, with the principal point in the middle, which those trainers take for granted; what moves
is transparent and black (RGBA). ``sparse/0`` has one PINHOLE camera (one per frame with a zoom), the landmarks with
their observations, and after them the dense cloud in ``points3D.bin``, from which gsplat starts; ``points3D.ply`` is
that cloud with normals, from which the program of the method's authors starts. With depth, ``depths/`` holds 16-bit
inverse depth and ``sparse/0/depth_params.json`` its scale, as that program's ``-d depths`` asks for.

Rules of those loaders: https://github.com/graphdeco-inria/gaussian-splatting (``scene/dataset_readers.py``,
``scene/cameras.py``) and https://github.com/nerfstudio-project/gsplat (``examples/datasets/colmap.py``).
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.files import atomic_write_json
from uni4d_fg.results.centering import centered
from uni4d_fg.results.clouds import write_ply
from uni4d_fg.results.export.colmap import colmap_model
from uni4d_fg.results.export.colmap_files import ColmapModel, write_binary, write_text
from uni4d_fg.results.export.dense import (
    CloudWithNormals,
    hidden_pixels,
    static_cloud_with_normals,
    without_holes,
)
from uni4d_fg.results.export.frames import encode, frame_names, write_confidence, write_images
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.results.export.observations import static_observations
from uni4d_fg.results.run import Run

INVERSE_DEPTH_STEPS = 65536
"""The loader divides the 16-bit values by this."""


def write_gsplat(job: ExportJob) -> None:
    """Write a folder for Gaussian splatting; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    size = job.run.reconstruction.image_size
    job.run, crop = centered(job.run)
    kept = job.run.reconstruction.image_size
    if kept != size:
        job.facts.append(
            f"cropped from {size[1]}x{size[0]} to {kept[1]}x{kept[0]} px (from column {crop.left}, row {crop.top}): "
            "splatting programs take the middle of the image for the principal point"
        )
    names = _write_images(job, job.folder / "images")
    model = colmap_model(job.run.reconstruction, static_observations(job.run), names)
    cloud = static_cloud_with_normals(job)
    folder = job.folder / "sparse" / "0"
    folder.mkdir(parents=True)
    whole = _with_cloud(model, cloud)
    write_binary(whole, folder)
    if job.options.text:
        text = job.folder / "sparse_text" / "0"
        text.mkdir(parents=True)
        write_text(whole, text)
    write_ply(folder / "points3D.ply", cloud.points, cloud.colors, cloud.normals)
    if job.options.depth:
        _write_depth(job, job.folder / "depths", folder / "depth_params.json", names)
        write_confidence(job, job.folder / "confidence", [Path(name).stem for name in names])
    job.figures |= {"images": len(names), "landmarks": len(model.points), "points": len(cloud.points)}
    job.facts.append(
        f"{len(names)} images, {len(model.points)} landmarks, {len(cloud.points)} dense points with normals"
    )


def _write_images(job: ExportJob, folder: Path) -> list[str]:
    """Write the frames, with alpha where something moves in the video; returns their names."""
    run = job.run
    sequence = run.need_sequence()
    moving = job.options.masks and any(bool((mask > 0).any()) for mask in sequence.masks)
    if not moving:
        return write_images(job, folder)
    folder.mkdir(parents=True)
    names = [f"{stem}.png" for stem in _plain_names(run)]
    for frame, name in enumerate(names):
        hidden = hidden_pixels(run, frame)
        image = np.dstack((sequence.images[frame], np.where(hidden, 0, 255).astype(np.uint8)))
        # The rendered picture is multiplied by alpha, the given one is not: it has to be black there by itself.
        image[hidden] = 0
        (folder / name).write_bytes(encode(image, ".png", folder / name))
        job.advance(frame + 1)
    job.facts.append("images/: RGBA, transparent where something moves; --no-masks keeps the frames as they are")
    return names


def _plain_names(run: Run) -> tuple[str, ...]:
    names = frame_names(run)
    # A loader cuts names at the first dot.
    return names if not any("." in name for name in names) else tuple(f"{k:05d}" for k in range(run.num_frames))


def _with_cloud(model: ColmapModel, cloud: CloudWithNormals) -> ColmapModel:
    """Return the model with the points of a cloud, which have no observations, after its own."""
    return replace(
        model,
        points=np.concatenate((model.points, cloud.points)),
        colors=np.concatenate((model.colors, cloud.colors)),
        errors=np.concatenate((model.errors, np.zeros(len(cloud.points)))),
    )


def _write_depth(job: ExportJob, folder: Path, parameters: Path, names: SequenceOf[str]) -> None:
    depths = job.run.need_depth("--depth")
    folder.mkdir()
    scales: dict[str, Any] = {}
    unknown = 0.0
    for frame, (name, depth) in enumerate(zip(names, depths, strict=True)):
        with np.errstate(invalid="ignore", divide="ignore"):
            known = np.isfinite(depth) & (depth > 0.0)
            inverse = np.where(known, 1.0 / depth, 0.0).astype(np.float32)
        if job.options.masks:
            known &= ~hidden_pixels(job.run, frame)
        filled = without_holes(inverse, known)
        unknown += 1.0 - float(known.mean())
        # Each frame's largest value fills the 16 bits.
        scale = float(filled.max(initial=0.0)) * INVERSE_DEPTH_STEPS / (INVERSE_DEPTH_STEPS - 1) or 1.0
        stored = np.rint(filled.astype(np.float64) / scale * INVERSE_DEPTH_STEPS).astype(np.uint16)
        stem = Path(name).stem
        path = folder / f"{stem}.png"
        path.write_bytes(encode(stored, ".png", path))
        scales[stem] = {"scale": scale, "offset": 0.0}
        job.check()
    atomic_write_json(parameters, scales)
    job.facts.append("depths/: inverse depth, 16-bit, scale in sparse/0/depth_params.json (train with `-d depths`)")
    if unknown:
        share = 100.0 * unknown / len(names)
        job.facts.append(
            f"{share:.1f} % of the pixels have no static depth; they took that of the nearest pixel that has "
            "(the format has no missing depth)"
        )
