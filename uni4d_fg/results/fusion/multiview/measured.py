"""Static depth of every frame from several views, frame by frame, with how far it can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray
from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.results.fusion.averaging import average_over_frames
from uni4d_fg.results.fusion.multiview.confidence import Evidence, confidence, relative_sigma
from uni4d_fg.results.fusion.multiview.edges import edges_again
from uni4d_fg.results.fusion.multiview.exposure import Shown, exposures
from uni4d_fg.results.fusion.multiview.planes import choose_planes
from uni4d_fg.results.fusion.multiview.sweep import sweep
from uni4d_fg.results.fusion.multiview.views import choose_views
from uni4d_fg.results.fusion.multiview.working_frame import WorkingFrame, WorkingSize
from uni4d_fg.results.fusion.pixel_transfer import PixelTransfer, pixel_transfer

_UNSURE = 0.5
"""Edges of depth that is surer stay where they are."""


@dataclass(frozen=True)
class Measured:
    """Static depth of one frame at working size, (h, w) each."""

    log_depth: Float32Array
    """Means nothing where something moves."""
    confidence: Float32Array
    """Probability that it is right to 3 %; 0 where there is none."""
    sigma: Float32Array
    """Standard deviation of its logarithm, if it is right."""


@dataclass
class _Raw:
    inverse_depth: Float32Array
    evidence: Evidence


@dataclass
class MultiviewDepth:
    """Depth of frames by matching, kept until it is told that they are not needed any more."""

    frames: Callable[[int], WorkingFrame]
    size: WorkingSize
    cameras: FloatArray
    """(T, 4) intrinsics at working size, px."""
    world_T_cam: FloatArray
    """(T, 4, 4)."""
    seen: Callable[[int], FloatArray]
    """The landmarks (N, 3) that a frame sees, world, m."""
    config: MultiviewConfig
    threads: int = 0
    raw: dict[int, _Raw | None] = field(default_factory=dict)
    shown: dict[int, WorkingFrame] = field(default_factory=dict)
    farthest: int = 0
    """How many frames away a view was, at most."""

    def at(self, frame: int) -> Measured | None:
        """Return the depth of a frame; None where the camera shows no parallax."""
        own = self._raw(frame)
        if own is None:
            return None
        near = [frame + sign * offset for offset in self.config.compared_offsets for sign in (-1, 1)]
        others = [
            (
                self.size.within(other.inverse_depth, np.nan),
                self.world_T_cam[number],
                self.cameras[number],
            )
            for number in near
            if 0 <= number < len(self.world_T_cam) and (other := self._raw(number)) is not None
        ]
        averaged = average_over_frames(
            own.inverse_depth, self.world_T_cam[frame], others, self.cameras[frame], self.config.max_disagreement,
            self.threads,
        )  # fmt: skip
        evidence = own.evidence.with_neighbors(averaged.agreeing, averaged.seeing)
        sure = self.size.within(confidence(evidence), 0)
        return Measured(averaged.log_depth, sure, relative_sigma(evidence))

    def alone(self, frame: int) -> Measured | None:
        """Return the depth of a frame without comparing it with that of others, taken to be sure everywhere."""
        own = self._raw(frame)
        if own is None:
            return None
        sure = self.size.within(np.ones_like(own.inverse_depth), 0)
        return Measured(-np.log(own.inverse_depth), sure, relative_sigma(own.evidence))

    def edges_again(self, frame: int, log_depth: Float32Array, sure: Float32Array, static: BoolArray) -> Float32Array:
        """Return log depth (h, w) of a frame with the edges of the static scene where other frames see them.

        Args:
            frame: The frame.
            log_depth: (h, w), NaN where missing.
            sure: (h, w) probability that it is right.
            static: (h, w) where nothing moves.
        """
        near = [frame + sign * offset for offset in self.config.edge_offsets for sign in (-1, 1)]
        views = [number for number in near if 0 <= number < len(self.world_T_cam)]
        if not views:
            return log_depth
        # What moves is nobody's match for long: where masks are too large, other frames are seen all the same.
        others = [
            self._shown(view).gray * np.float32(factor)
            for view, factor in zip(views, self._brightness(frame, views, self.seen(frame)), strict=True)
        ]
        known = np.isfinite(log_depth)
        inverse = np.exp(-np.where(known, log_depth, np.float32(0)))
        chosen = known & (sure < _UNSURE)
        own = np.where(static, self._shown(frame).gray, np.float32(np.nan))
        transfers = self._transfers(frame, views)
        again = edges_again(inverse, own, chosen, others, transfers, self.threads)
        return np.where(again == inverse, log_depth, -np.log(again))

    def gray(self, frame: int) -> Float32Array:
        """Return the gray values (h, w) of a frame, of 1."""
        return self._shown(frame).gray

    def forget_before(self, frame: int, finished: int) -> None:
        """Forget what is not needed any more; :meth:`edges_again` may run on other threads.

        Args:
            frame: The first one that is still to be matched.
            finished: All frames before this one are finished.
        """
        oldest = frame - max(self.config.compared_offsets, default=0)
        _forget(self.raw, oldest)
        _forget(self.shown, min(oldest - self.farthest, finished - max(self.config.edge_offsets, default=0)))

    def _raw(self, frame: int) -> _Raw | None:
        if frame not in self.raw:
            self.raw[frame] = self._match(frame)
        return self.raw[frame]

    def _shown(self, frame: int) -> WorkingFrame:
        if frame not in self.shown:
            self.shown[frame] = self.frames(frame)
        return self.shown[frame]

    def _match(self, frame: int) -> _Raw | None:
        points, pose = self.seen(frame), self.world_T_cam[frame]
        z = world_to_camera(np.broadcast_to(pose, (len(points), 4, 4)), points)[:, 2]
        points, z = points[z > 0], z[z > 0]
        cameras, sides = self.cameras, (self.size.height, self.size.width)
        views = choose_views(frame, self.world_T_cam, points, cameras, sides, self.config)
        if not views:
            return None
        self.farthest = max(self.farthest, *(abs(view - frame) for view in views))
        transfers = self._transfers(frame, views)
        planes = choose_planes(z, transfers, sides, self.config)
        own = self._shown(frame)
        factors = self._brightness(frame, views, points)
        matched = [self._shown(view).matched * np.float32(factor) for view, factor in zip(views, factors, strict=True)]
        swept = sweep(own.gray, matched, transfers, planes, self.config, self.threads)
        step = np.float32(planes[1] - planes[0])
        return _Raw(
            self.size.continued(swept.inverse_depth), Evidence.of(swept, step / swept.inverse_depth, len(views))
        )

    def _transfers(self, frame: int, views: list[int]) -> list[PixelTransfer]:
        """Return where other frames see the pixels of one."""
        pose = self.world_T_cam[frame]
        there = [np.asarray(np.linalg.solve(self.world_T_cam[view], pose)) for view in views]
        own = self.cameras[frame]
        return [pixel_transfer(own, self.cameras[view], at) for view, at in zip(views, there, strict=True)]

    def _brightness(self, frame: int, views: list[int], points: FloatArray) -> list[float]:
        """Return by how much gray values of other frames are to be multiplied to be as bright as a frame's."""
        own, *others = (
            Shown(self._shown(number).static, self.world_T_cam[number], self.cameras[number])
            for number in (frame, *views)
        )
        return exposures(own, others, points)


def _forget(kept: dict[int, Any], oldest: int) -> None:
    """Remove what is kept of frames before the oldest that is needed."""
    for number in list(kept):  # others may add to it
        if number < oldest:
            del kept[number]
