"""Loops in a path whose landmarks are gone: a graph of poses, chained by what each step is known to, and closed.

A window that slides has marginalized what its earlier frames saw; what is left of them are poses and covariances. By
how much a covariance grows from one frame to the next is what the step between them is uncertain by. GTSAM solves the
chain with the closures, and what hangs on a frame moves along with it.
Source: Olson, Leonard and Teller 2006, "Fast iterative alignment of pose graphs with poor initial estimates", for the
graph; Sünderhauf and Protzel 2012, "Switchable constraints for robust pose graph SLAM", for letting closures go.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world
from uni4d_fg.slam.incremental.dynamic import in_world
from uni4d_fg.slam.incremental.model import FinishedFrame, Landmarks
from uni4d_fg.slam.incremental.results import Finished
from uni4d_fg.slam.loops.closing import LoopClosing

_FLOOR = 0.1
"""A step is uncertain by at least this part of the usual variance: covariances that shrink say nothing of it."""
_HELD = 1e-9
"""Sigma of the first pose (rad, m)."""


@dataclass(frozen=True)
class ClosedPath:
    """What is left of a stream, with its loops closed; a :class:`~uni4d_fg.slam.incremental.results.Finished`."""

    open: Finished
    old: FloatArray
    """(T, 4, 4) world_T_cam before."""
    new: FloatArray
    """(T, 4, 4) and after."""
    covariance: FloatArray
    """(T, 6, 6) after."""

    def frames(self) -> Iterator[FinishedFrame]:
        """Return all frames in order, with their moving points."""
        for frame, moved, new, covariance in zip(
            self.open.frames(), self._moved(), self.new, self.covariance, strict=True
        ):
            yield replace(frame, world_T_cam=new, covariance=covariance, dynamic=in_world(frame.dynamic, moved))

    def landmarks(self) -> Iterator[Landmarks]:
        """Return all landmarks; each moves with the keyframe that it left the window with."""
        moved = self._moved()
        for part in self.open.landmarks():
            yield replace(part, point=camera_to_world(moved[part.keyframe], part.point))

    def _moved(self) -> FloatArray:
        result: FloatArray = self.new @ se3.inverse(self.old)
        return result


def close_path(path: Finished, old: FloatArray, covariance: FloatArray, closing: LoopClosing) -> ClosedPath | None:
    """Close what a search has found; None where nothing holds, or the path does not know how uncertain it is.

    Args:
        path: What is to move.
        old: (T, 4, 4) its world_T_cam.
        covariance: (T, 6, 6) of their body-frame twists (rad, m), relative to the first.
        closing: After its search; it judges what the solution leaves far away.
    """
    frames, variance = np.arange(len(old)), _step_variance(old, covariance)
    if variance is None:
        return None
    chain, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    chain.addPriorPose3(POSE.key(0), gtsam.Pose3(old[0]), gtsam.noiseModel.Isotropic.Sigma(6, _HELD))
    for t, pose in enumerate(old):
        values.insert(POSE.key(t), gtsam.Pose3(pose))
    for t, step in enumerate(se3.inverse(old[:-1]) @ old[1:]):
        noise = gtsam.noiseModel.Diagonal.Variances(variance[t])
        chain.add(gtsam.BetweenFactorPose3(POSE.key(t), POSE.key(t + 1), gtsam.Pose3(step), noise))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(200)
    settings.setRelativeErrorTol(1e-9)
    while (source := closing.source()) is not None:
        graph = gtsam.NonlinearFactorGraph(chain)
        for factor in source.factors(frames):
            graph.add(factor)
        found = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
        new = np.stack([found.atPose3(POSE.key(t)).matrix() for t in frames.tolist()])
        if closing.judge(new):
            continue
        marginals = gtsam.Marginals(graph, found)
        closed = np.stack([marginals.marginalCovariance(POSE.key(t)) for t in frames.tolist()])
        closed[0] = covariance[0]
        return ClosedPath(path, old, se3.orthonormalize(new), closed)
    return None


def _step_variance(world_T_cam: FloatArray, covariance: FloatArray) -> FloatArray | None:
    """Return the variances (T - 1, 6) of each step's turn and way; None if the path does not tell any.

    Each is one number for the three axes, as the differences of two covariances need not be covariances.
    """
    back = np.stack([se3.adjoint(step) for step in se3.inverse(world_T_cam[1:]) @ world_T_cam[:-1]])
    grown = np.einsum("tii->ti", covariance[1:] - back @ covariance[:-1] @ np.swapaxes(back, 1, 2))
    parts = []
    for part in (grown[:, :3].mean(axis=1), grown[:, 3:].mean(axis=1)):
        grows = part[part > 0.0]
        if not len(grows):
            return None
        # Not the mean: a bridged frame counts as known to nothing, and would make all others as loose.
        usual = float(np.median(grows))
        parts.append(np.maximum(np.nan_to_num(part, nan=usual), _FLOOR * usual))
    return np.repeat(np.stack(parts, axis=1), 3, axis=1)
