"""Dense depth of every frame from the sparse result, written frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.progress import Reporter
from uni4d_fg.results.depth_store import write_depth
from uni4d_fg.results.fusion.averaging import average_over_frames
from uni4d_fg.results.fusion.densify import ControlPoints, densify_frame


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
    maps = _DenseMaps(sequence, labelled, scene, motion, config)
    with write_depth(path, sequence.num_frames, sequence.image_size) as writer:
        for frame in range(sequence.num_frames):
            if should_stop():
                raise Cancelled("stopped during fusion; finished stages are kept, --resume continues from them")
            writer.write(frame, maps.averaged(frame))
            reporter.advance(frame + 1)


@dataclass
class _DenseMaps:
    """Dense depth of single frames, kept as long as frames near them need it."""

    sequence: Sequence
    labelled: LabelledTracks
    scene: Arrays
    motion: Arrays
    config: FusionConfig
    made: dict[int, tuple[Float32Array, BoolArray]] = field(default_factory=dict)
    """Per frame: depth, and where it is static."""

    def averaged(self, frame: int) -> Float32Array:
        """Return the final depth of a frame; frames are asked for in order."""
        offsets = self.config.averaged_offsets
        near = [frame + sign * offset for offset in offsets for sign in (-1, 1)]
        near = [other for other in near if 0 <= other < self.sequence.num_frames]
        for old in [other for other in self.made if other < frame - max(offsets, default=0)]:
            del self.made[old]
        depth, static = self._dense(frame)
        if not near:
            return depth
        poses = self.scene["world_T_cam"]
        result = average_over_frames(
            self._static(frame),
            poses[frame],
            ((self._static(other), poses[other]) for other in near),
            self.scene["intrinsics"],
            self.config.averaged_sigmas * float(self.scene["noise"][1]),
        )
        return np.where(static, result, depth)

    def _static(self, frame: int) -> Float32Array:
        depth, static = self._dense(frame)
        return np.where(static, depth, np.float32(np.nan))

    def _dense(self, frame: int) -> tuple[Float32Array, BoolArray]:
        if frame not in self.made:
            control = control_points(self.labelled, self.scene, self.motion, frame)
            log_scale, sigma = float(self.scene["log_scale"][frame]), float(self.scene["noise"][1])
            depth, mask = self.sequence.depths[frame], self.sequence.masks[frame]
            dense = densify_frame(depth, mask, self.scene["intrinsics"], control, log_scale, sigma, self.config)
            self.made[frame] = dense, mask == 0
        return self.made[frame]


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
