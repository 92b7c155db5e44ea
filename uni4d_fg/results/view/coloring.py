"""What the colors of the viewer mean: by image, instance, residual or uncertainty."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from html import escape

import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.results.colors import (
    BRIDGED_AMBER,
    STATIC_GRAY,
    css_gradient,
    instance_colors,
    value_colors,
    value_range,
)
from uni4d_fg.results.measures import pose_sigmas
from uni4d_fg.results.residuals import Residuals, landmark_sigma, reprojection_residuals
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.slam.reconstruction import Reconstruction

_DIMMED = 0.45
_CAMERA = (88, 130, 190)


class ColorBy(str, Enum):
    """What colors show."""

    image = "image"
    instance = "instance"
    residual = "residual"
    uncertainty = "uncertainty"


@dataclass(frozen=True)
class Values:
    """The numbers behind the colors."""

    landmark_error: FloatArray
    """(N,) median reprojection error, px."""
    trajectory_error: FloatArray
    """(M, T) reprojection residual, px; NaN where not observed."""
    position_sigma: FloatArray
    """(T,) meters; NaN where not known."""
    camera_error: FloatArray
    """(T,) median reprojection residual of the static points, px; NaN where not known."""
    reconstruction: Reconstruction
    residuals: Residuals | None
    """Of all observations; None without tracks."""

    @cached_property
    def landmark_sigma(self) -> FloatArray:
        """(N,) meters, from the rays alone; infinite where not determined, NaN without tracks. Takes a while."""
        if self.residuals is None:
            return np.full(len(self.landmark_error), np.nan)
        return landmark_sigma(self.reconstruction, self.residuals)


def values_of(run: Run) -> Values:
    """Compute the numbers behind the colors of a run."""
    reconstruction = run.reconstruction
    num_frames = reconstruction.num_frames
    sigmas = pose_sigmas(reconstruction)
    position = np.full(num_frames, np.nan) if sigmas is None else sigmas[0]
    error = reconstruction.landmark_error.astype(np.float64)
    trajectory_error = np.full(reconstruction.dynamic_observed.shape, np.nan)
    if run.labelled is None:
        return Values(error, trajectory_error, position, np.full(num_frames, np.nan), reconstruction, None)
    residuals = reprojection_residuals(reconstruction, run.labelled)
    moving = residuals.is_dynamic
    trajectory_error[residuals.row[moving], residuals.frame[moving]] = residuals.norm[moving]
    per_camera = residuals.per_frame(num_frames, 0.5, dynamic=False)
    return Values(error, trajectory_error, position, per_camera, reconstruction, residuals)


@dataclass(frozen=True)
class Coloring:
    """Colors of everything that is drawn, for one choice of what they show."""

    by: ColorBy
    run: Run
    values: Values

    def cloud(self, cloud: ColoredPoints) -> ImageArray:
        """Colors of a dense cloud; it has no residual of its own, and steps back where points are judged."""
        if self.by is ColorBy.image:
            return cloud.colors
        if self.by is ColorBy.instance:
            # Shaded by the image, so that shapes stay readable.
            shade = 0.45 + 0.55 * cloud.colors.astype(np.float64).mean(axis=1, keepdims=True) / 255.0
            return np.asarray(np.rint(instance_colors(cloud.instance) * shade), dtype=np.uint8)
        gray = _DIMMED * cloud.colors.astype(np.float64).mean(axis=1, keepdims=True)
        return np.asarray(np.rint(np.repeat(gray, 3, axis=1)), dtype=np.uint8)

    def landmarks(self) -> ImageArray:
        """(N, 3) colors of the landmarks."""
        reconstruction = self.run.reconstruction
        if self.by is ColorBy.image:
            return reconstruction.landmark_color
        if self.by is ColorBy.instance:
            return np.full(reconstruction.landmark_color.shape, STATIC_GRAY, np.uint8)
        values = self.values.landmark_error if self.by is ColorBy.residual else self.values.landmark_sigma
        return value_colors(values, value_range(values))

    def trajectories(self, frame: int) -> ImageArray:
        """(M, 3) colors of the trajectories in one frame."""
        reconstruction = self.run.reconstruction
        if self.by is ColorBy.image:
            return reconstruction.dynamic_color
        if self.by is ColorBy.instance:
            return instance_colors(reconstruction.dynamic_instance)
        if self.by is ColorBy.residual:
            return value_colors(self.values.trajectory_error[:, frame], value_range(self.values.trajectory_error))
        colors = np.full(reconstruction.dynamic_color.shape, STATIC_GRAY, np.uint8)
        colors[~reconstruction.dynamic_observed[:, frame]] = BRIDGED_AMBER
        return colors

    def cameras(self) -> ImageArray:
        """(T, 3) colors of the cameras."""
        if self.by is ColorBy.residual:
            return value_colors(self.values.camera_error, value_range(self.values.camera_error))
        if self.by is ColorBy.uncertainty:
            return value_colors(self.values.position_sigma, value_range(self.values.position_sigma))
        return np.full((self.run.num_frames, 3), _CAMERA, np.uint8)

    def legend(self) -> str:
        """HTML that says what the colors mean."""
        if self.by is ColorBy.image:
            return _note("Colors of the video.")
        if self.by is ColorBy.instance:
            ids = np.unique(self.run.reconstruction.dynamic_instance).tolist()
            entries = [("static", STATIC_GRAY)]
            entries += [(f"instance {i}", tuple(instance_colors(np.array([i], np.int32))[0].tolist())) for i in ids]
            return "".join(_swatch(name, color) for name, color in entries)
        values = self.values
        if self.by is ColorBy.residual:
            return (
                _scale("landmarks: median reprojection error", values.landmark_error, 1.0, "px")
                + _scale("moving points: residual in this frame", values.trajectory_error, 1.0, "px")
                + _scale("cameras: median residual", values.camera_error, 1.0, "px")
            )
        factor, unit = self.run.small_unit
        return (
            _scale("cameras: standard deviation of position", values.position_sigma, factor, unit)
            + _scale("landmarks: standard deviation from their rays", values.landmark_sigma, factor, unit)
            + _swatch("moving points bridged, not seen", BRIDGED_AMBER)
        )


def as_html(lines: Iterable[str]) -> str:
    """Return lines of plain text as HTML in which nothing of them is markup.

    All text goes to the page this way: a run folder may come from anyone, and Markdown would let it run scripts.
    """
    return "".join(_note(line) for line in lines)


def _note(text: str) -> str:
    return f'<p style="margin:0.3em 1em;font-size:0.85em">{escape(text)}</p>'


def _swatch(name: str, color: tuple[int, ...]) -> str:
    square = "background:rgb({},{},{})".format(*color)
    return (
        '<p style="margin:0.3em 1em;font-size:0.85em"><span style="display:inline-block;width:0.9em;height:0.9em;'
        f'margin-right:0.5em;vertical-align:-0.1em;{square}"></span>{escape(name)}</p>'
    )


def _scale(name: str, values: FloatArray, factor: float, unit: str) -> str:
    if not np.isfinite(values).any():
        return _note(f"{name}: not known in this run")
    low, high = (factor * bound for bound in value_range(values))
    return (
        f'<div style="margin:0.5em 1em;font-size:0.85em">{escape(name)}'
        f'<div style="height:0.6em;border-radius:2px;background:{css_gradient()}"></div>'
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{low:.3g} {unit}</span><span>{high:.3g} {unit} and more</span></div></div>"
    )
