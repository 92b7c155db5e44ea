"""What does not change with time: the static cloud and the landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uni4d_fg.arrays import IntArray
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.results.view.coloring import Coloring
from uni4d_fg.results.view.nodes import CloudNode, add_cloud, add_group, add_marks
from uni4d_fg.results.view.shown import Shown

FIRST_POINTS = 60_000
"""Of the part of the cloud that is there at once."""
_MARK_SIZE = 0.006
"""Diameter of a landmark, in parts of the scene's depth."""


@dataclass
class StaticLayer:
    """The static cloud, first a part of it and then all, and the landmarks."""

    server: Any
    run: Run
    depth: float
    """Depth of the scene, meters."""
    landmark_rows: IntArray
    _group: Any = None
    _landmark_group: Any = None
    _landmarks: Any = None
    _clouds: list[tuple[ColoredPoints, CloudNode]] = field(default_factory=list)
    _version: int = 0

    def build(self, coloring: Coloring, shown: Shown) -> None:
        """Make the groups and the landmarks."""
        self._group = add_group(self.server, "/static/cloud", visible=shown.static)
        self._landmark_group = add_group(self.server, "/static/landmarks", visible=shown.landmarks)
        if len(self.landmark_rows):
            points = self.run.reconstruction.landmarks[self.landmark_rows].astype(np.float32)
            colors = coloring.landmarks()[self.landmark_rows]
            self._landmarks = add_marks(
                self.server, "/static/landmarks/points", points, colors, _MARK_SIZE * self.depth
            )

    def send(self, cloud: ColoredPoints, coloring: Coloring, factor: float) -> CloudNode:
        """Add a cloud to the scene; it is not this layer's yet, so that other threads may go on with what is."""
        self._version += 1
        return add_cloud(self.server, f"/static/cloud/{self._version}", cloud.points, coloring.cloud(cloud), factor)

    def replace_by(self, cloud: ColoredPoints, node: CloudNode) -> None:
        """Take over a cloud that was sent, in place of the one so far."""
        before, self._clouds = self._clouds, [(cloud, node)]
        for _, old in before:
            old.remove()

    @property
    def num_points(self) -> int:
        """Points of the cloud that is shown."""
        return sum(len(cloud.points) for cloud, _ in self._clouds)

    def color(self, coloring: Coloring) -> None:
        """Give everything its colors."""
        for cloud, node in self._clouds:
            node.set_colors(coloring.cloud(cloud))
        if self._landmarks is not None:
            self._landmarks.colors = coloring.landmarks()[self.landmark_rows]

    def resize(self, factor: float) -> None:
        """Draw points larger or smaller."""
        for _, node in self._clouds:
            node.set_size(factor)
        if self._landmarks is not None:
            self._landmarks.point_size = 0.5 * factor * _MARK_SIZE * self.depth

    def show(self, shown: Shown) -> None:
        """Show or hide."""
        self._group.visible = shown.static
        self._landmark_group.visible = shown.landmarks
