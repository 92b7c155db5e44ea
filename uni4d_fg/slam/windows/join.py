r"""Joining windows: every window's information on its cameras, summed, and solved for all frames together.

With its landmarks eliminated a window says, about its own linearization point,

    E_w(d) = 1/2 d^T H d + g^T d,     d_i = Log(P_i^{-1} (T_0^{-1} T_i)),   d_s = s - s_0,   d_K = K - K_0,

where T_0 is the pose of its first frame: only poses relative to it, log-scales and intrinsics, so that a window
knows nothing of where the others put the world. The sum over windows is minimized by Gauss-Newton over all poses
(frame 0 held) and log-scales; the intrinsics are held, as short windows tell them worse than frames far apart do, and
count as uncertain as these say in the covariances. The matrix has one block per window and a border for the
intrinsics; see :mod:`uni4d_fg.slam.windows.fronts`.
Source: Ni, Steedly and Dellaert 2007, "Tectonic SAM: exact, out-of-core, submap-based SLAM".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import se3_log
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.added_terms import AddedTerms
from uni4d_fg.slam.windows.fronts import Entries, FrontChain
from uni4d_fg.slam.windows.information import FRAME, SHARED, WindowInformation
from uni4d_fg.slam.windows.join_covariance import joined_covariances
from uni4d_fg.slam.windows.plan import Window

_STEP_SIZE = 1e-9
"""A Gauss-Newton step below this ends the solve (rad, m, log), or one that lets expect that the next is."""
_MAX_STEPS = 10
_MAX_STEPS_ADDED = 50
"""With added factors, whose kernels are reweighted from step to step."""


Covariances: TypeAlias = tuple[FloatArray, FloatArray]
"""Of all poses (T, 6, 6), and of the intrinsics (4, 4)."""


@dataclass(frozen=True)
class Joined:
    """The solution, and what says how sure it is."""

    cameras: Cameras
    information: list[WindowInformation]
    """Of every window."""
    intrinsics_covariance: FloatArray
    """(4, 4) of the intrinsics that were given; zero for those that are known."""
    added: AddedTerms | None = None

    def covariances(self) -> Covariances:
        """Return those of all poses (T, 6, 6) and of the intrinsics (4, 4), at the solution as it was found.

        Raises:
            SolverError: If the windows do not determine a camera.
        """
        free = _free_columns(self.cameras, self.added)
        uncertain = np.diag(self.intrinsics_covariance) > 0
        free[FRAME * len(self.cameras.world_T_cam) :][:SHARED] = uncertain
        known, which = np.zeros((4, 4)), np.ix_(uncertain, uncertain)
        known[which] = np.linalg.inv(self.intrinsics_covariance[which])
        return joined_covariances(self.information, self.cameras, free, known, self.added)


def chain(windows: list[Window], parts: list[Cameras]) -> Cameras:
    """Put windows one behind the other by the poses they share, as a start.

    A window is placed by the mean, over the shared frames, of where the earlier one puts its first camera.
    """
    num_frames = windows[-1].stop
    poses, scales = np.tile(np.eye(4), (num_frames, 1, 1)), np.zeros(num_frames)
    done = 0
    for window, part in zip(windows, parts, strict=True):
        shared = np.arange(window.start, done)
        world = np.eye(4)
        if len(shared):
            found = poses[shared] @ se3.inverse(part.world_T_cam[shared - window.start])
            twist = se3_log(se3.inverse(found[:1]) @ found)
            world = found[0] @ se3.se3_exp(twist.mean(axis=0)[None])[0]
        new = np.arange(done, window.stop)
        poses[new] = se3.orthonormalize(world @ part.world_T_cam[new - window.start])
        scales[new] = part.log_scale[new - window.start]
        done = window.stop
    intrinsics = np.mean([part.intrinsics for part in parts], axis=0)
    return Cameras(poses, intrinsics, scales)


def join(
    information: list[WindowInformation],
    start: Cameras,
    intrinsics_covariance: FloatArray,
    added: AddedTerms | None = None,
) -> Joined:
    """Minimize the windows' energies, and those of added factors, together.

    Args:
        information: Of every window.
        start: Where to start; its intrinsics stay.
        intrinsics_covariance: (4, 4) of these; zero for those that are known.
        added: Factors on all frames that the windows do not know of; their own variables move along.

    Raises:
        SolverError: If the windows do not determine a camera.
    """
    cameras, num_frames = start, len(start.world_T_cam)
    base = FRAME * num_frames + SHARED
    free = _free_columns(start, added)
    free[base - SHARED : base] = False
    size, slowest = np.inf, 0.0
    for _ in range(_MAX_STEPS if added is None else _MAX_STEPS_ADDED):
        gradient, matrices = np.zeros(len(free)), []
        for part in information:
            d, jacobian = part.difference(cameras)
            matrices.append(jacobian.congruent(part.hessian))
            gradient[part.columns(num_frames)] += jacobian.left_product((part.hessian @ d + part.gradient)[None])[0]
        entries: list[Entries] = []
        if added is not None:
            slope, entries = added.linearize(cameras)
            gradient += slope
        solver = FrontChain([part.window for part in information], matrices, free, FRAME, SHARED, entries)
        step = -solver.solve(gradient[None])[0]
        if not np.isfinite(step).all():
            raise SolverError("joining windows: a step is not finite; use longer windows or a wider overlap")
        cameras = _moved(cameras, step[:base])
        if added is not None:
            added.move(step)
        # Steps shrink by a factor that changes up to ten times: where the largest is small, the last need not be made.
        before, size = size, float(np.abs(step).max())
        slowest = max(slowest, size / before)
        if size < _STEP_SIZE or (0.0 < slowest < 0.1 and size * slowest < _STEP_SIZE):
            break
    return Joined(cameras, information, intrinsics_covariance, added)


def _free_columns(cameras: Cameras, added: AddedTerms | None) -> BoolArray:
    """Return which columns are not held: without added factors, all but the pose of frame 0."""
    if added is not None:
        return added.free
    free = np.ones(FRAME * len(cameras.world_T_cam) + SHARED, dtype=bool)
    free[:6] = False
    return free


def _moved(cameras: Cameras, step: FloatArray) -> Cameras:
    frames = step[:-4].reshape(-1, FRAME)
    poses = se3.orthonormalize(se3.retract(cameras.world_T_cam, frames[:, :6]))
    return Cameras(poses, cameras.intrinsics + step[-4:], cameras.log_scale + frames[:, 6])
