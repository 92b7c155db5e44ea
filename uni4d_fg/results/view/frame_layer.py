"""What changes with time, held in the browser for every frame: a change of frame only shows and hides."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from uni4d_fg.arrays import IntArray
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.results.view.coloring import Coloring
from uni4d_fg.results.view.nodes import CloudNode, add_cloud, add_group, add_marks
from uni4d_fg.results.view.shown import Shown
from uni4d_fg.results.view.trails import step_segments

_HEAD_SIZE = 0.008
"""Diameter of a moving point, in parts of the scene's depth."""
_TYPES = ("cloud", "points", "steps")


class FrameClouds(Protocol):
    """Gives the clouds of a frame."""

    def moving(self, frame: int) -> ColoredPoints:
        """Return what moves."""

    def whole_frame(self, frame: int) -> ColoredPoints:
        """Return everything that the frame shows."""


@dataclass
class _Frame:
    """The nodes of one frame, by type; a type that this frame has nothing of is missing."""

    cloud: ColoredPoints
    node: CloudNode
    groups: dict[str, Any]
    points: Any
    steps: Any


@dataclass
class FrameLayer:
    """Moving clouds, moving points and their trails."""

    server: Any
    run: Run
    clouds: FrameClouds
    rows: IntArray
    """Trajectories that are shown."""
    depth: float
    """Depth of the scene, meters."""
    _types: dict[str, Any] = field(default_factory=dict)
    _frames: dict[int, _Frame] = field(default_factory=dict)
    _visible: set[tuple[str, int]] = field(default_factory=set)
    _full: CloudNode | None = None
    _full_frame: int | None = None

    def build(self, shown: Shown) -> None:
        """Make the groups that show or hide what is of one type."""
        for kind, visible in (("cloud", shown.moving), ("points", shown.trajectories), ("steps", shown.trajectories)):
            self._types[kind] = add_group(self.server, f"/moving/{kind}", visible=visible)
        self._types["full"] = add_group(self.server, "/moving/full", visible=False)

    @property
    def loaded(self) -> set[int]:
        """Frames whose nodes are in the scene."""
        return set(self._frames)

    def load(self, frame: int, coloring: Coloring, factor: float) -> None:
        """Send what one frame shows, hidden; once."""
        if frame in self._frames:
            return
        groups = {kind: add_group(self.server, f"/moving/{kind}/{frame:05d}", visible=False) for kind in _TYPES}
        cloud = self.clouds.moving(frame)
        name = f"/moving/cloud/{frame:05d}"
        node = add_cloud(self.server, name, cloud.points, coloring.cloud(cloud), factor)
        here, colors = self._heads(frame, coloring)
        heads = steps = None
        if len(here):
            heads = add_marks(
                self.server, f"/moving/points/{frame:05d}/all", here, colors, factor * _HEAD_SIZE * self.depth
            )
        ends, end_colors = self._steps(frame, coloring)
        if len(ends):
            steps = self.server.scene.add_line_segments(
                f"/moving/steps/{frame:05d}/all", ends, end_colors, thickness=2.0, thickness_units="screen"
            )
        self._frames[frame] = _Frame(cloud, node, groups, heads, steps)

    def show(self, shown: Shown) -> None:
        """Show one frame, the clouds of those before it and the trails up to it; what is loaded of them."""
        for kind, visible in (("cloud", shown.moving), ("points", shown.trajectories), ("steps", shown.trajectories)):
            self._types[kind].visible = visible
        wanted = {("points", shown.frame)}
        wanted |= {("cloud", shown.frame - back) for back in range(shown.history + 1)}
        wanted |= {("steps", shown.frame - back) for back in range(shown.trail)}
        wanted = {(kind, frame) for kind, frame in wanted if frame in self._frames}
        for kind, frame in wanted - self._visible:
            self._frames[frame].groups[kind].visible = True
        for kind, frame in self._visible - wanted:
            self._frames[frame].groups[kind].visible = False
        self._visible = wanted
        if self._full_frame != shown.frame or not shown.full:
            self._types["full"].visible = False

    def show_full(self, shown: Shown, coloring: Coloring) -> None:
        """Show every pixel of the current frame."""
        if self._full_frame != shown.frame:
            if self._full is not None:
                self._full.remove()
            cloud = self.clouds.whole_frame(shown.frame)
            name = f"/moving/full/{shown.frame:05d}"
            self._full = add_cloud(self.server, name, cloud.points, coloring.cloud(cloud), shown.point_size)
            self._full_frame = shown.frame
        self._types["full"].visible = shown.full

    def color(self, coloring: Coloring) -> None:
        """Give everything that was sent its colors."""
        for frame, nodes in self._frames.items():
            nodes.node.set_colors(coloring.cloud(nodes.cloud))
            if nodes.points is not None:
                nodes.points.colors = self._heads(frame, coloring)[1]
            if nodes.steps is not None:
                nodes.steps.colors = self._steps(frame, coloring)[1]
        self._full_frame = None

    def resize(self, factor: float) -> None:
        """Draw points larger or smaller."""
        for nodes in self._frames.values():
            nodes.node.set_size(factor)
            if nodes.points is not None:
                nodes.points.point_size = 0.5 * factor * _HEAD_SIZE * self.depth
        if self._full is not None:
            self._full.set_size(factor)

    def _heads(self, frame: int, coloring: Coloring) -> tuple[np.ndarray, np.ndarray]:
        here = self.run.reconstruction.dynamic_points[self.rows, frame]
        known = np.isfinite(here).all(axis=1)
        return here[known].astype(np.float32), coloring.trajectories(frame)[self.rows][known]

    def _steps(self, frame: int, coloring: Coloring) -> tuple[np.ndarray, np.ndarray]:
        points = self.run.reconstruction.dynamic_points[self.rows]
        return step_segments(points, coloring.trajectories(frame)[self.rows], frame)
