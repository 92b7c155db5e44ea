"""Uni4D: what that program's viewer (``vis_final_4d.py``) and evaluation (``eval_pose.py``, ``eval_depth.py``) read.

``data/VIDEO/uni4d/uni4d_fg/%04d.npz`` per frame, ``fused_4d.npz`` beside them, and ``c2w.npy`` and ``depth_gt/`` in
``data/VIDEO`` where the truth is known, so that ``data`` serves as its ``--base_path`` and ``uni4d_fg`` as its
``--experiment_name``. Conventions are ours: camera to world, OpenCV axes, pixel centers at integers. Two things are
not as that program writes them: the bottom row of ``c2w`` is (0, 0, 0, 1) instead of zeros, and a pixel without depth
takes that of the nearest pixel with depth, because its files have no missing depth.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from uni4d_fg.arrays import Float32Array
from uni4d_fg.files import save_npy, save_npz
from uni4d_fg.frontend.sequence.decode import clean_depth
from uni4d_fg.geometry.camera import intrinsics_matrix
from uni4d_fg.results.export.clouds import moving_cloud, static_cloud
from uni4d_fg.results.export.model import ExportJob

EXPERIMENT = "uni4d_fg"


def write_uni4d_results(job: ExportJob) -> None:
    """Write results in Uni4D's layout; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    run, result = job.run, job.run.reconstruction
    depths = run.need_depth("Uni4D's layout")
    video = job.folder / "data" / _folder_name(run.need_sequence().name)
    experiment = video / "uni4d" / EXPERIMENT
    experiment.mkdir(parents=True)
    matrix = intrinsics_matrix(result.intrinsics).astype(np.float32)
    filled = 0
    for frame, (image, depth) in enumerate(zip(run.need_sequence().images, depths, strict=True)):
        pose = result.world_T_cam[frame].astype(np.float32)
        dense, missing = fill_depth(depth)
        filled += missing
        with np.errstate(divide="ignore"):
            disparity = np.where(dense > 0.0, np.float32(1.0) / dense, np.float32(0.0))
        here = intrinsics_matrix(result.frame_intrinsics[frame]).astype(np.float32)
        save_npz(experiment / f"{frame:04d}.npz", disp=disparity, img=image, R=pose[:3, :3], t=pose[:3, 3], K=here)
        job.advance(frame + 1)
    _write_fused(job, experiment / "fused_4d.npz", matrix)
    truth = run.need_sequence().ground_truth
    if truth.world_T_cam is not None:
        save_npy(video / "c2w.npy", truth.world_T_cam)
    if truth.depths is not None:
        for frame, depth in enumerate(truth.depths):
            # Its evaluation takes what is not above zero for unknown.
            save_npy(video / "depth_gt" / f"{frame:05d}.npy", np.nan_to_num(clean_depth(depth), nan=0.0))
            job.check()
    job.figures |= {"frames": result.num_frames, "filled_pixels": filled}
    job.facts.append(f"{result.num_frames} frames and fused_4d.npz in {experiment.relative_to(job.folder)}")
    if filled:
        share = filled / (result.num_frames * result.image_size[0] * result.image_size[1])
        job.facts.append(
            f"{100 * share:.1f} % of the pixels have no depth; they took that of the nearest pixel with depth"
        )


def fill_depth(depth: Float32Array) -> tuple[Float32Array, int]:
    """Give every pixel without depth that of the nearest pixel with depth.

    Args:
        depth: (H, W) meters, NaN where missing.

    Returns:
        (H, W) meters, 0 everywhere if nothing is known; and the number of pixels that were missing.
    """
    missing = ~np.isfinite(depth)
    count = int(missing.sum())
    if count == depth.size:
        return np.zeros_like(depth), count
    if count == 0:
        return depth, 0
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(depth[tuple(nearest)]), count


def _write_fused(job: ExportJob, path: Path, matrix: Float32Array) -> None:
    """Write ``fused_4d.npz``; images go frame by frame, as they would not fit into memory together."""
    run, result = job.run, job.run.reconstruction
    static = static_cloud(run)
    points, colors = (np.empty(result.num_frames, dtype=object) for _ in range(2))
    for frame in range(result.num_frames):
        cloud = moving_cloud(run, frame)
        points[frame], colors[frame] = cloud.points.astype(np.float32), cloud.colors
    shape = (result.num_frames, *result.image_size, 3)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        _add(archive, "static_points", static.points.astype(np.float64))
        _add(archive, "static_rgbs", static.colors)
        _add(archive, "dyn_points", points)
        _add(archive, "dyn_rgbs", colors)
        _add(archive, "c2w", result.world_T_cam)
        _add_frames(archive, "rgbs", shape, run.need_sequence().images)
        _add(archive, "Ks", np.repeat(matrix[None], result.num_frames, axis=0))


def _add(archive: zipfile.ZipFile, name: str, array: npt.NDArray[Any]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        # That program's viewer expects lists of clouds as pickled object arrays.
        np.lib.format.write_array(stream, array, allow_pickle=array.dtype.hasobject)


def _add_frames(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], frames: Iterable[npt.NDArray[np.uint8]]
) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|u1", "fortran_order": False, "shape": shape})
        for frame in frames:
            stream.write(np.ascontiguousarray(frame).tobytes())


def _folder_name(name: str) -> str:
    """Return the name of the sequence as that of a folder."""
    plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name).lstrip(".")
    return plain or "video"
