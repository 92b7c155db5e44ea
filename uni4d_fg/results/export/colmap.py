"""COLMAP: ``images/``, ``sparse/0`` (binary), ``sparse_text/0``, optionally ``masks/`` and ``depth_maps/``.

COLMAP's poses are world to camera with the scalar of the quaternion first, and its pixel centers are at 0.5:
0.5 is added to cx, cy and to every observation.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from pathlib import Path

import numpy as np

from uni4d_fg.frontend.trajectory_files import continuous_quaternions
from uni4d_fg.geometry.se3 import inverse
from uni4d_fg.results.export.colmap_files import ColmapModel, depth_map_bytes, write_binary, write_text
from uni4d_fg.results.export.frames import write_confidence, write_images, write_masks
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.results.export.observations import StaticObservations, static_observations
from uni4d_fg.slam.reconstruction import Reconstruction

HALF_PIXEL = np.array([0.5, 0.5])


def write_colmap(job: ExportJob) -> None:
    """Write a COLMAP project; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    names = write_images(job, job.folder / "images")
    observations = static_observations(job.run)
    model = colmap_model(job.run.reconstruction, observations, names)
    binary = job.folder / "sparse" / "0"
    binary.mkdir(parents=True)
    write_binary(model, binary)
    if job.options.text:
        text = job.folder / "sparse_text" / "0"
        text.mkdir(parents=True)
        write_text(model, text)
    _note(job, model, observations)
    if job.options.masks:
        masks = write_masks(job, job.folder / "masks", [f"{name}.png" for name in names])
        if masks:
            job.facts.append("masks/: 0 where something moves (give it to COLMAP as mask_path)")
    if job.options.depth:
        _write_depth(job, job.folder / "depth_maps", names)
        write_confidence(job, job.folder / "confidence", [Path(name).stem for name in names])


def colmap_model(
    reconstruction: Reconstruction, observations: StaticObservations | None, names: SequenceOf[str]
) -> ColmapModel:
    """Bring a reconstruction into COLMAP's conventions.

    Args:
        reconstruction: The result.
        observations: What saw the landmarks. Landmarks without any are left out; with None all are kept, with
            empty tracks.
        names: T image files.
    """
    cam_T_world = inverse(reconstruction.world_T_cam)
    count = len(reconstruction.landmarks)
    if observations is None:
        none = np.zeros(0, dtype=np.int64)
        observations = StaticObservations(none, none, np.zeros((0, 2)), np.zeros(0))
        kept = np.arange(count)
    else:
        kept = np.flatnonzero(np.bincount(observations.landmark, minlength=count))
    row = np.full(count, -1)
    row[kept] = np.arange(len(kept))
    return ColmapModel(
        image_size=reconstruction.image_size,
        intrinsics=reconstruction.intrinsics + np.concatenate((np.zeros(2), HALF_PIXEL)),
        lens=reconstruction.lens,
        zoom=reconstruction.zoom,
        names=list(names),
        quaternions=np.roll(continuous_quaternions(cam_T_world[:, :3, :3]), 1, axis=1),
        translations=cam_T_world[:, :3, 3],
        points=reconstruction.landmarks[kept],
        colors=reconstruction.landmark_color[kept],
        errors=np.nan_to_num(observations.landmark_error(count)[kept]),
        point=row[observations.landmark],
        image=observations.frame,
        uv=observations.uv + HALF_PIXEL,
    )


def _note(job: ExportJob, model: ColmapModel, observations: StaticObservations | None) -> None:
    job.figures |= {"images": len(model.names), "points": len(model.points)}
    if observations is None:
        job.facts.append(f"{len(model.names)} images, {len(model.points)} points without observations")
        job.warnings.append("the run kept no tracks: points have no observations, and no reprojection error is known")
        return
    error = observations.mean_error()
    job.figures |= {"observations": len(observations), "mean_reprojection_error_px": error}
    text = f"{len(model.names)} images, {len(model.points)} points, {len(observations)} observations"
    job.facts.append(text + (f", mean reprojection error {error:.4f} px" if len(observations) else ""))
    left_out = len(job.run.reconstruction.landmarks) - len(model.points)
    if left_out:
        job.facts.append(f"{left_out} landmarks left out: fewer than two observations agree with them")


def _write_depth(job: ExportJob, folder: Path, names: SequenceOf[str]) -> None:
    depths = job.run.need_depth("--depth")
    folder.mkdir()
    for name, depth in zip(names, depths, strict=True):
        (folder / f"{name}.geometric.bin").write_bytes(depth_map_bytes(depth))
        job.check()
    job.facts.append("depth_maps/: dense depth, meters, as in a dense workspace's stereo/depth_maps")
