"""Frames that repeat the one before are left out of the solve, and then get its pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import IntArray
from uni4d_fg.frontend.sequence.frames import SelectedFrames
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.repeats import repeated_frames
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.pipeline.steps import Arrays

_FRAME_FIRST = ("world_T_cam", "log_scale", "pose_covariance")
_FRAME_SECOND = (
    "points", "observed", "object_observed", "object_world_T_object", "object_covariance", "object_velocity",
)  # fmt: skip


@dataclass(frozen=True)
class Repeats:
    """Which frames are solved, and which of them each frame shows."""

    solved: IntArray
    """(S,) frames of the video, ascending."""
    shown: IntArray
    """(T,) row among them of what each frame shows."""

    @classmethod
    def of(cls, sequence: Sequence, labelled: LabelledTracks) -> Repeats | None:
        """Look for frames that repeat the one before; None without any. Raises InputError if one cannot be read."""
        repeated = repeated_frames(sequence.images, labelled.tracks)
        if not repeated.any():
            return None
        return cls(np.flatnonzero(~repeated).astype(np.int64), np.cumsum(~repeated).astype(np.int64) - 1)

    def fact(self) -> str:
        """Return what a summary says of it."""
        left_out = np.setdiff1d(np.arange(len(self.shown)), self.solved).tolist()
        listed = ", ".join(map(str, left_out[:10])) + (", ..." if len(left_out) > 10 else "")
        return f"{len(left_out)} frame(s) repeat the one before and get its pose: {listed}"

    def sequence(self, sequence: Sequence) -> Sequence:
        """Return the solved frames of a sequence; its truth and its own tracks are left out."""
        poses = sequence.initial_world_T_cam
        return replace(
            sequence,
            images=SelectedFrames(sequence.images, self.solved),
            depths=SelectedFrames(sequence.depths, self.solved),
            masks=SelectedFrames(sequence.masks, self.solved),
            timestamps=sequence.timestamps[self.solved],
            frame_names=tuple(sequence.frame_names[t] for t in self.solved) if sequence.frame_names else (),
            initial_world_T_cam=None if poses is None else poses[self.solved],
            zoom=None if sequence.zoom is None else sequence.zoom[self.solved],
            tracks=None,
            ground_truth=type(sequence.ground_truth)(),
        )

    def labelled(self, labelled: LabelledTracks) -> LabelledTracks:
        """Return labelled tracks of the solved frames."""
        return labelled.in_frames(self.solved, self.shown[labelled.tracks.query_frame].astype(np.int32))

    def expanded(self, arrays: Arrays) -> dict[str, npt.NDArray[np.generic]]:
        """Return the record of a stage over the solved frames as one over all frames."""
        out = dict(arrays)
        for name in out:
            if name in _FRAME_FIRST:
                out[name] = out[name][self.shown]
            elif name in _FRAME_SECOND:
                out[name] = out[name][:, self.shown]
        if "object_reference" in out:
            out["object_reference"] = self.solved[out["object_reference"]].astype(np.int32)
        return out
