"""rerun: one recording with cameras and images, static and moving clouds, and trajectories on one time line.

Entities, all below ``world`` (x right, y down, z forward, meters):

| entity | content | time |
|---|---|---|
| `world/camera` | pose | per frame |
| `world/camera/image` | pinhole (static, unless the camera zooms), JPEG | per frame |
| `world/camera_path` | path of the camera center | static |
| `world/static` | static cloud | static |
| `world/dynamic` | cloud of what moves | per frame |
| `world/trajectories` | the last steps of every moving point that is there | per frame |
| `world/object_ID` | pose and axes of a rigid object, where it has one | per frame |

Every frame has a place on the time lines ``frame`` (its number) and, where the video has times, ``time`` (seconds
since the first). rerun puts pixel centers at 0.5 (https://github.com/rerun-io/rerun/issues/3896): 0.5 is added to cx
and cy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray, Int32Array
from uni4d_fg.geometry.camera import intrinsics_matrix
from uni4d_fg.optional import import_rerun
from uni4d_fg.results.colors import instance_colors
from uni4d_fg.results.export.clouds import moving_cloud, static_cloud
from uni4d_fg.results.export.frames import encode
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.slam.reconstruction import Reconstruction

CAMERA, IMAGE = "world/camera", "world/camera/image"


def write_rrd(job: ExportJob) -> None:
    """Write ``scene.rrd``; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    rerun = import_rerun()
    path = job.folder / "scene.rrd"
    recording = rerun.RecordingStream("uni4d_fg")
    # Encoded in memory and written from here: when the disk is full, rerun's own writer may wait for ever.
    stream = recording.binary_stream()
    recording.send_blueprint(_blueprint())
    recording.send_recording_name(job.run.need_sequence().name)
    _log_static(rerun, recording, job)
    _log_frames(rerun, recording, job)
    data = stream.read()
    recording.disconnect()
    path.write_bytes(data)
    job.facts.append(f"scene.rrd, {len(data) / 1e6:.0f} MB: open it with `rerun {path.name}`")


def _blueprint() -> Any:
    from rerun import blueprint

    return blueprint.Horizontal(
        blueprint.Spatial3DView(origin="world", name="scene"),
        blueprint.Spatial2DView(origin=IMAGE, name="image"),
        column_shares=[2, 1],
    )


def _log_static(rerun: Any, recording: Any, job: ExportJob) -> None:
    """Log what does not change with time."""
    result = job.run.reconstruction
    cloud = static_cloud(job.run)
    recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    if result.zoom is None:
        recording.log(IMAGE, _pinhole(rerun, result, 0), static=True)
    recording.log("world/static", _points(rerun, cloud.points, cloud.colors), static=True)
    path = rerun.LineStrips3D([result.world_T_cam[:, :3, 3].astype(np.float32)], colors=[[230, 60, 40]])
    recording.log("world/camera_path", path, static=True)
    job.figures["static_points"] = len(cloud.points)


def _pinhole(rerun: Any, result: Reconstruction, frame: int) -> Any:
    height, width = result.image_size
    matrix = intrinsics_matrix(result.frame_intrinsics[frame])
    matrix[:2, 2] += 0.5
    return rerun.Pinhole(image_from_camera=matrix, resolution=[width, height], camera_xyz=rerun.ViewCoordinates.RDF)


def _log_frames(rerun: Any, recording: Any, job: ExportJob) -> None:
    """Log what changes with time."""
    run, result = job.run, job.run.reconstruction
    moving = 0
    palette = instance_colors(result.dynamic_instance)
    for frame in range(run.num_frames):
        recording.set_time("frame", sequence=frame)
        if job.run.has_times:
            recording.set_time("time", duration=float(result.timestamps[frame] - result.timestamps[0]))
        pose = result.world_T_cam[frame]
        recording.log(CAMERA, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        if result.zoom is not None:
            recording.log(IMAGE, _pinhole(rerun, result, frame))
        jpeg = encode(run.need_sequence().images[frame], ".jpg", Path(f"frame {frame}"))
        recording.log(IMAGE, rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        cloud = moving_cloud(run, frame)
        recording.log("world/dynamic", _points(rerun, cloud.points, cloud.colors))
        strips, row = trails(result, frame, job.options.trail)
        recording.log("world/trajectories", rerun.LineStrips3D(strips, colors=palette[row]))
        _log_objects(rerun, recording, result, frame)
        moving += len(cloud.points)
        job.advance(frame + 1)
    job.figures |= {"frames": run.num_frames, "dynamic_points": moving}
    job.facts.append(
        f"{run.num_frames} frames with images, {moving} moving points, {len(result.dynamic_track)} trajectories"
    )


def _log_objects(rerun: Any, recording: Any, result: Reconstruction, frame: int) -> None:
    """Log the rigid objects of a frame; one that has no pose in it is not drawn."""
    if result.object_instance is None or result.object_world_T_object is None:
        return
    for instance, poses in zip(result.object_instance.tolist(), result.object_world_T_object, strict=True):
        entity, pose = f"world/object_{instance}", poses[frame]
        if not np.isfinite(pose).all():
            recording.log(entity, rerun.Clear(recursive=False))
            continue
        points = result.dynamic_points[result.dynamic_instance == instance, frame]
        distance = np.linalg.norm(points - pose[:3, 3], axis=1)
        length = float(np.nanmedian(distance)) if np.isfinite(distance).any() else 0.1
        axes = rerun.Arrows3D(vectors=length * np.eye(3), colors=255 * np.eye(3, dtype=np.uint8))
        recording.log(entity, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), axes)


def trails(result: Reconstruction, frame: int, length: int) -> tuple[list[Float32Array], Int32Array]:
    """Return the steps of moving points that lead to a frame.

    Args:
        result: The reconstruction.
        frame: The last frame of every strip.
        length: Steps at most.

    Returns:
        One strip (n, 3) of 2 to ``length`` + 1 positions for each trajectory that is there in this frame and the
        one before it, oldest first, meters; and the rows of these trajectories.
    """
    window = result.dynamic_points[:, max(frame - length, 0) : frame + 1].astype(np.float32)
    # The newest positions without a gap: count known ones backwards from this frame.
    known = np.flip(np.isfinite(window).all(axis=2), axis=1)
    count = np.cumprod(known, axis=1, dtype=np.int64).sum(axis=1)
    row = np.flatnonzero(count >= 2).astype(np.int32)
    return [window[k, window.shape[1] - count[k] :] for k in row.tolist()], row


def _points(rerun: Any, points: Any, colors: ImageArray) -> Any:
    # A negative radius is one in points of the screen: the same at every scale of the scene.
    return rerun.Points3D(points.astype(np.float32), colors=colors, radii=-1.5)
