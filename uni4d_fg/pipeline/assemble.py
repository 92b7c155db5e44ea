"""The reconstruction of a run, and the files a person opens."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.frontend.trajectory_files import write_tum
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.geometry.trajectory import Trajectory
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.pipeline.leftovers import remove_views
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.results import pictures as drawn
from uni4d_fg.results.clouds import write_clouds
from uni4d_fg.results.confidence_store import read_confidence
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.fusion.clouds import dynamic_cloud, dynamic_clouds, static_cloud
from uni4d_fg.results.io import save_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.results.track_colors import track_colors
from uni4d_fg.slam.reconstruction import OBJECT_ARRAYS, Reconstruction

ValueT = TypeVar("ValueT")


def assemble(
    sequence: Sequence,
    labelled: LabelledTracks,
    scene: Arrays,
    motion: Arrays,
    lens: Lens = PINHOLE,
    zoom: FloatArray | None = None,
) -> Reconstruction:
    """Bring the stages' results into one :class:`Reconstruction`, with colors from the images."""
    landmark_track = scene["landmark_track"].astype(np.int32)
    dynamic_track = motion["track"].astype(np.int32)
    colors = track_colors(sequence, labelled, np.concatenate([landmark_track, dynamic_track]))
    return Reconstruction(
        world_T_cam=scene["world_T_cam"],
        intrinsics=scene["intrinsics"],
        timestamps=sequence.timestamps,
        image_size=sequence.image_size,
        depth_log_scale=scene["log_scale"],
        landmarks=scene["landmarks"],
        landmark_track=landmark_track,
        landmark_color=colors[: len(landmark_track)],
        landmark_error=scene["landmark_error"],
        dynamic_points=motion["points"],
        dynamic_observed=motion["observed"],
        dynamic_track=dynamic_track,
        dynamic_instance=motion["instance"].astype(np.int32),
        dynamic_color=colors[len(landmark_track) :],
        pose_covariance=scene.get("pose_covariance"),
        intrinsics_covariance=scene.get("intrinsics_covariance"),
        lens=lens,
        zoom=zoom,
        **{name: motion[name] for name in OBJECT_ARRAYS if name in motion},
    )


def write_result(folder: RunFolder, reconstruction: Reconstruction) -> None:
    """Write ``reconstruction.npz`` and ``trajectory.tum``.

    Raises:
        OutputError: If a file cannot be written.
    """
    save_reconstruction(folder.reconstruction, reconstruction)
    write_tum(folder.trajectory, Trajectory(reconstruction.timestamps, reconstruction.world_T_cam))


def write_views(
    folder: RunFolder,
    sequence: Sequence,
    reconstruction: Reconstruction,
    config: Config,
    should_stop: Callable[[], bool],
    *,
    unit: str = "m",
) -> None:
    """Write clouds and pictures, as the config asks, instead of those of an earlier result; lengths are in ``unit``.

    Raises:
        Cancelled: If ``should_stop`` said so.
        OutputError: If a file cannot be written.
    """
    remove_views(folder)
    if not (config.output.clouds or config.output.pictures):
        return
    depth = read_depth(folder.depth)
    intrinsics, poses, lens = reconstruction.frame_intrinsics, reconstruction.world_T_cam, reconstruction.lens
    sure = None
    if config.fusion.static == "field":
        sure = read_confidence(folder.confidence, reconstruction.image_size)
    static = static_cloud(
        sequence.images, depth, sequence.masks, intrinsics, poses, config.fusion, confidence=sure, lens=lens
    )

    def clouds() -> None:
        moving = dynamic_clouds(sequence.images, depth, sequence.masks, intrinsics, poses, config.fusion, lens)
        write_clouds(folder, static, _until(should_stop, moving))

    def pictures() -> None:
        drawn.draw_trajectory(folder.trajectory_picture, poses, sequence.ground_truth.world_T_cam, unit=unit)
        _check(should_stop)
        drawn.draw_depth_strip(folder.depth_picture, sequence.images, sequence.depths, depth, unit=unit)
        _check(should_stop)
        drawn.draw_scene(folder.scene_picture, reconstruction, static, dynamic)

    def dynamic(frame: int) -> tuple[np.ndarray, ImageArray]:
        return dynamic_cloud(
            sequence.images[frame],
            depth[frame],
            sequence.masks[frame],
            intrinsics[frame],
            poses[frame],
            config.fusion,
            lens,
        )

    wanted = [*([clouds] if config.output.clouds else []), *([pictures] if config.output.pictures else [])]
    # Clouds mostly wait for the disk.
    map_in_order(lambda write: write(), wanted, min(thread_count(), len(wanted)))


def _until(should_stop: Callable[[], bool], items: Iterable[ValueT]) -> Iterator[ValueT]:
    """Pass items on until the user interrupts."""
    for item in items:
        _check(should_stop)
        yield item


def _check(should_stop: Callable[[], bool]) -> None:
    if should_stop():
        raise Cancelled("stopped among the clouds and pictures; --resume continues")
