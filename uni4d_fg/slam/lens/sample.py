"""The frames and static tracks on which cameras of a video are compared: enough to tell, and few enough to be quick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, IntArray, evenly_spread
from uni4d_fg.config.models import Config
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.slam.stages.bundle_adjustment import without_camera_motion
from uni4d_fg.slam.windows.plan import TrackSpans, calibration_frames, tracks_in

EXACT_PX = 0.01
"""Tracks that are explained better than this are of frames that are one picture, or were computed."""


@dataclass(frozen=True)
class CalibrationSample:
    """Some frames of a video, and as many of its static tracks as are asked for."""

    labelled: LabelledTracks
    """All tracks."""
    frames: IntArray
    """(N,) ascending."""

    @classmethod
    def of(cls, labelled: LabelledTracks, config: Config, usable: BoolArray | None = None) -> CalibrationSample:
        """Choose evenly spaced frames that tracks still tie together, and of these the usable (T,).

        Raises:
            DegenerateProblemError: If there is no static track.
        """
        if not (labelled.weight[is_static(labelled)] > 0).any():
            raise DegenerateProblemError("the lens: there is no static track")
        count = labelled.tracks.num_frames
        sightings = config.windows.calibration_sightings
        frames = calibration_frames(TrackSpans.of(labelled), count, config.camera.frames, sightings)
        return cls(labelled, frames if usable is None else frames[usable[frames]])

    def tracks(self, observations: int) -> LabelledTracks:
        """Return evenly spread static tracks, in all frames, with about so many observations in those of the sample."""
        labelled = self.labelled
        rows = np.flatnonzero(is_static(labelled))
        count = int((labelled.weight[rows] > 0).sum())
        wanted = observations * labelled.tracks.num_frames // len(self.frames)
        if count > wanted:
            rows = rows[evenly_spread(len(rows), max(1, len(rows) * wanted // count))]
        return labelled.select(rows)

    def cut(self, labelled: LabelledTracks) -> LabelledTracks:
        """Return the part of tracks that is seen in the frames of the sample."""
        return tracks_in(labelled, self.frames).labelled

    def settings(self, config: Config) -> Config:
        """Return the configuration of stages 1 and 2 for fits: cameras only, E_cam only between consecutive frames.

        All tracks take part, alike: those that one model explains badly are what another is to be asked for.
        """
        changes = {"structure": "keep", "covariance_cells": 0, "trim_sigmas": None, "track_noise_dof": None}
        stage = config.bundle_adjustment.model_copy(update=changes)
        consecutive = len(self.frames) == int(self.frames[-1]) - int(self.frames[0]) + 1
        return config.model_copy(update={"bundle_adjustment": stage if consecutive else without_camera_motion(stage)})


def is_static(labelled: LabelledTracks) -> BoolArray:
    """Return which tracks (K,) are static, long or short."""
    return np.isin(labelled.label, [int(TrackLabel.STATIC), int(TrackLabel.SHORT_STATIC)])
