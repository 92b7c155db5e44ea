"""Static or moving, decided online: what a track is taken for by the votes it has so far.

The batch labels see all votes of a track before the first solve; here each frame adds one. A track is what its
first sure observation says, and is rejected for good once more of its votes disagree than
``max_off_label_fraction`` allows. Only tracks that something still uses are remembered.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, IntArray
from uni4d_fg.config.cues import InputConfig, LabelConfig
from uni4d_fg.frontend.tracks.depth_sampling import sample_depth
from uni4d_fg.frontend.tracks.mask_certainty import UNCERTAIN, certain_labels
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.incremental.model import FrameTracks
from uni4d_fg.slam.lens.camera_model import CameraModel

UNKNOWN, REJECTED = -1, -2


def _empty() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class LabelledFrame:
    """The trusted observations of one frame."""

    track: IntArray
    uv: FloatArray
    depth: FloatArray
    """(n,) cue, m; NaN where missing."""
    weight: FloatArray
    """(n,)."""
    label: IntArray
    """(n,) 0 static, > 0 instance."""
    rejected: IntArray
    """Tracks that turned out to be unreliable in this frame."""

    def ideal(self, lens: Lens, intrinsics: FloatArray) -> LabelledFrame:
        """Return the observations on the ideal pixels of a lens; see :class:`CameraModel`."""
        if lens.is_pinhole:
            return self
        camera, frame = CameraModel(intrinsics, lens), np.zeros(len(self.uv), dtype=np.int64)
        uv = camera.ideal(self.uv, frame)
        seen = np.isfinite(uv).all(axis=1)
        weight = self.weight[seen] * camera.ideal_weight(uv[seen], frame[seen])
        return LabelledFrame(self.track[seen], uv[seen], self.depth[seen], weight, self.label[seen], self.rejected)

    def select(self, static: bool) -> LabelledFrame:
        """Return the static or the moving observations."""
        keep = (self.label == 0) == static
        arrays = (self.track[keep], self.uv[keep], self.depth[keep], self.weight[keep], self.label[keep])
        return LabelledFrame(*arrays, self.rejected)


@dataclass
class TrackBook:
    """What is remembered of each live track, in arrays sorted by track."""

    track: IntArray = field(default_factory=_empty)
    first_frame: IntArray = field(default_factory=_empty)
    last_frame: IntArray = field(default_factory=_empty)
    label: IntArray = field(default_factory=_empty)
    votes: IntArray = field(default_factory=_empty)
    disagreeing: IntArray = field(default_factory=_empty)
    color: ImageArray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.uint8))

    def observe(
        self, frame: int, tracks: FrameTracks, image: ImageArray, depth: Float32Array, mask: Int32Array,
        config: LabelConfig, input_config: InputConfig, drift_frames: float,
    ) -> LabelledFrame:  # fmt: skip
        """Label the observations of a frame and sample their depth; observations outside the image are left out."""
        height, width = mask.shape
        inside = (tracks.uv >= -0.5).all(axis=1) & (tracks.uv < (width - 0.5, height - 0.5)).all(axis=1)
        order = np.flatnonzero(inside)[np.argsort(tracks.track[inside], kind="stable")]
        track, uv = tracks.track[order].astype(np.int64), tracks.uv[order].astype(np.float64)
        pixel = np.clip(np.floor(uv + 0.5).astype(np.int64), 0, (width - 1, height - 1))
        found = certain_labels(mask, config.band_static_px, config.band_dynamic_px)[pixel[:, 1], pixel[:, 0]]
        color = image[pixel[:, 1], pixel[:, 0]]
        self._add(track, frame, color if color.ndim == 2 else np.repeat(color[:, None], 3, axis=1))
        at = np.searchsorted(self.track, track)
        self.last_frame[at] = frame
        sure = found != UNCERTAIN
        new = sure & (self.label[at] == UNKNOWN)
        self.label[at[new]] = found[new]
        self.votes[at] += sure
        self.disagreeing[at] += sure & (found != self.label[at])
        broken = (self.disagreeing[at] > config.max_off_label_fraction * self.votes[at]) & (self.label[at] != REJECTED)
        self.label[at[broken]] = REJECTED
        label = self.label[at]
        weight = np.where(sure, (found == label).astype(np.float64), config.band_weight)
        weight /= 1.0 + (frame - self.first_frame[at]) / drift_frames
        keep = (label >= 0) & (weight > 0)
        cue = sample_depth(
            depth, uv[keep].astype(np.float32), input_config.min_depth_m, input_config.max_depth_m,
            config.max_depth_spread,
        )  # fmt: skip
        return LabelledFrame(track[keep], uv[keep], cue.astype(np.float64), weight[keep], label[keep], track[broken])

    def colors(self, track: IntArray) -> ImageArray:
        """Return the colors (n, 3) of tracks; black for forgotten ones."""
        out = np.zeros((len(track), 3), dtype=np.uint8)
        if len(self.track):
            at = np.minimum(np.searchsorted(self.track, track), len(self.track) - 1)
            known = self.track[at] == track
            out[known] = self.color[at[known]]
        return out

    def forget(self, before: int, used: IntArray) -> None:
        """Drop tracks last seen before a frame that are not among the ``used`` ones."""
        keep: BoolArray = (self.last_frame >= before) | np.isin(self.track, used)
        for name in self.__dataclass_fields__:
            setattr(self, name, getattr(self, name)[keep])

    def _add(self, track: IntArray, frame: int, color: ImageArray) -> None:
        new = ~np.isin(track, self.track)
        count = int(new.sum())
        if count == 0:
            return
        merged = np.concatenate([self.track, track[new]])
        order = np.argsort(merged, kind="stable")
        zero = np.zeros(count, dtype=np.int64)
        for name, values in (
            ("track", track[new]), ("first_frame", zero + frame), ("last_frame", zero + frame),
            ("label", zero + UNKNOWN), ("votes", zero), ("disagreeing", zero), ("color", color[new]),
        ):  # fmt: skip
            setattr(self, name, np.concatenate([getattr(self, name), values])[order])
