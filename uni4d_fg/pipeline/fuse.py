"""Dense depth of every frame from the sparse result, written frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.fusion.densify import ControlPoints, densify_frame
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.progress import Reporter
from uni4d_fg.reconstruction.depth_store import write_depth
from uni4d_fg.sequence.model import Sequence
from uni4d_fg.tracks.model import LabelledTracks


def fuse_depth(
    path: Path,
    sequence: Sequence,
    labelled: LabelledTracks,
    scene: Arrays,
    motion: Arrays,
    config: FusionConfig,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> None:
    """Write the fused depth of all frames.

    Args:
        path: The ``depth.npy`` of the run.
        sequence: Depth cue and masks.
        labelled: Observations, with the cue at each.
        scene: Record of stage 2.
        motion: Record of stage 3.
        config: Fusion.
        reporter: Progress, in frames.
        should_stop: Polled before every frame.

    Raises:
        Cancelled: If ``should_stop`` said so; nothing is left behind.
        OutputError: If the file cannot be written.
    """
    with write_depth(path, sequence.num_frames, sequence.image_size) as writer:
        for frame in range(sequence.num_frames):
            if should_stop():
                raise Cancelled("stopped during fusion; finished stages are kept, --resume continues from them")
            control = control_points(labelled, scene, motion, frame)
            log_scale, sigma = float(scene["log_scale"][frame]), float(scene["noise"][1])
            depth, mask = sequence.depths[frame], sequence.masks[frame]
            writer.write(frame, densify_frame(depth, mask, scene["intrinsics"], control, log_scale, sigma, config))
            reporter.advance(frame + 1)


def control_points(labelled: LabelledTracks, scene: Arrays, motion: Arrays, frame: int) -> ControlPoints:
    """Collect the landmarks and dynamic points that are seen, with a cue, in one frame."""
    pose = scene["world_T_cam"][frame]
    static_track: IntArray = scene["landmark_track"]
    seen = (labelled.weight[static_track, frame] > 0) & np.isfinite(labelled.depth[static_track, frame])
    moving_track: IntArray = motion["track"]
    here = motion["observed"][:, frame] & np.isfinite(labelled.depth[moving_track, frame])
    track = np.concatenate([static_track[seen], moving_track[here]]).astype(np.int64)
    points: FloatArray = np.concatenate([scene["landmarks"][seen], motion["points"][here, frame]])
    instance = np.concatenate([np.zeros(int(seen.sum())), motion["instance"][here]]).astype(np.int32)
    z = world_to_camera(np.broadcast_to(pose, (len(points), 4, 4)), points)[:, 2]
    cue = labelled.depth[track, frame].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        log_scale = np.where(z > 0, np.log(np.maximum(z, 1e-9)) - np.log(cue), np.nan)
    return ControlPoints(labelled.tracks.uv[track, frame].astype(np.float64), cue, log_scale, instance)
