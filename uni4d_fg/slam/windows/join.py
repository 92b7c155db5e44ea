r"""Joining windows: every window's information on its cameras, summed, and solved for all frames together.

With its landmarks eliminated a window says, about its own linearization point,

    E_w(d) = 1/2 d^T H d + g^T d,     d_i = Log(P_i^{-1} (T_0^{-1} T_i)),   d_s = s - s_0,   d_K = K - K_0,

where T_0 is the pose of its first frame: only poses relative to it, log-scales and intrinsics, so that a window
knows nothing of where the others put the world. The sum over windows is minimized by Gauss-Newton over all poses
(frame 0 held) and log-scales; the intrinsics are held, as short windows tell them worse than frames far apart do, and
count as uncertain as these say in the covariances. The matrix has one block per window and a border for the
intrinsics, and is factorized as a sparse one.
Source: Ni, Steedly and Dellaert 2007, "Tectonic SAM: exact, out-of-core, submap-based SLAM".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import inverse_right_jacobian, se3_log
from uni4d_fg.optim.cluster_robust import MIN_CLUSTERS, Spread
from uni4d_fg.optim.few_clusters import blend
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.added_terms import FRAME, AddedTerms, Entries
from uni4d_fg.slam.windows.plan import Window

_STEP_SIZE = 1e-9
"""A Gauss-Newton step below this ends the solve (rad, m, log)."""
_MAX_STEPS = 10
_MAX_STEPS_ADDED = 50
"""With added factors, whose kernels are reweighted from step to step."""


@dataclass(frozen=True)
class WindowInformation:
    """What one window knows: columns are 7 per frame (twist, log-scale) and 4 for the intrinsics."""

    window: Window
    point: Cameras
    """Linearization point, in the axes of the window's first camera."""
    hessian: FloatArray
    """(n, n); zero in the columns of the first pose."""
    gradient: FloatArray
    """(n,)."""
    curvature: FloatArray
    """(n, n) the Hessian with the mean slopes of the kernels, for covariances."""
    spread: Spread | None
    """Of the gradient; None where errors count as independent."""

    def columns(self, num_frames: int) -> IntArray:
        """Return the place (n,) of its columns among those of all frames."""
        frames = np.arange(FRAME * self.window.start, FRAME * self.window.stop)
        return np.concatenate([frames, FRAME * num_frames + np.arange(4)])

    def difference(self, cameras: Cameras) -> tuple[FloatArray, FloatArray]:
        """Return d (n,) and its Jacobian (n, n) with respect to the shared cameras' tangents."""
        here, count = cameras.part(self.window.start, self.window.stop), len(self.window)
        twist = se3_log(se3.inverse(self.point.world_T_cam) @ here.world_T_cam)
        inverse_jacobian = inverse_right_jacobian(twist)
        d, jacobian = np.zeros(FRAME * count + 4), np.eye(FRAME * count + 4)
        for i in range(count):
            own = slice(FRAME * i, FRAME * i + 6)
            d[own] = twist[i]
            jacobian[own, own] = inverse_jacobian[i] if i else 0.0
            if i:
                back = se3.adjoint(se3.inverse(here.world_T_cam[i]))
                jacobian[own, :6] = -inverse_jacobian[i] @ back
        d[6 : FRAME * count : FRAME] = here.log_scale - self.point.log_scale
        d[-4:] = here.intrinsics - self.point.intrinsics
        return d, jacobian


@dataclass(frozen=True)
class Joined:
    """The solution, and how sure it is."""

    cameras: Cameras
    pose_covariance: FloatArray
    """(T, 6, 6)."""
    intrinsics_covariance: FloatArray
    """(4, 4)."""


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
    *,
    covariance: bool,
    added: AddedTerms | None = None,
) -> Joined:
    """Minimize the windows' energies, and those of added factors, together.

    Args:
        information: Of every window.
        start: Where to start; its intrinsics stay.
        intrinsics_covariance: (4, 4) of these; zero for those that are known.
        covariance: Whether to compute covariances; NaN otherwise.
        added: Factors on all frames that the windows do not know of; their own variables move along.

    Raises:
        SolverError: If the windows do not determine a camera.
    """
    cameras, num_frames = start, len(start.world_T_cam)
    base = FRAME * num_frames + 4
    size = base if added is None else added.size
    free = np.ones(size, dtype=bool)
    free[:6] = False
    if added is not None:
        free = added.free
    free[base - 4 : base] = False
    at = np.flatnonzero(free)
    for _ in range(_MAX_STEPS if added is None else _MAX_STEPS_ADDED):
        gradient, entries = np.zeros(size), []
        for part in information:
            d, jacobian = part.difference(cameras)
            entries.append(_entries(part, jacobian.T @ part.hessian @ jacobian, num_frames))
            gradient[part.columns(num_frames)] += jacobian.T @ (part.hessian @ d + part.gradient)
        if added is not None:
            slope, more = added.linearize(cameras)
            gradient += slope
            entries += more
        solver = _factorize(entries, size, at)
        step = np.zeros(size)
        step[at] = -solver.solve(gradient[at])
        if not np.isfinite(step).all():
            raise SolverError("joining windows: a step is not finite; use longer windows or a wider overlap")
        cameras = _moved(cameras, step[:base])
        if added is not None:
            added.move(step)
        if np.abs(step).max() < _STEP_SIZE:
            break
    if not covariance:
        return Joined(cameras, np.full((num_frames, 6, 6), np.nan), np.full((4, 4), np.nan))
    uncertain = base - 4 + np.flatnonzero(np.diag(intrinsics_covariance) > 0)
    known = np.zeros((4, 4))
    inside = np.ix_(uncertain - base + 4, uncertain - base + 4)
    known[inside] = np.linalg.inv(intrinsics_covariance[inside])
    return Joined(cameras, *_covariances(information, cameras, np.sort(np.concatenate([at, uncertain])), known, added))


def _moved(cameras: Cameras, step: FloatArray) -> Cameras:
    frames = step[:-4].reshape(-1, FRAME)
    poses = se3.orthonormalize(se3.retract(cameras.world_T_cam, frames[:, :6]))
    return Cameras(poses, cameras.intrinsics + step[-4:], cameras.log_scale + frames[:, 6])


def _entries(part: WindowInformation, block: FloatArray, num_frames: int) -> Entries:
    """Return the entries of a window's block among those of all frames."""
    place = part.columns(num_frames)
    return np.repeat(place, len(place)), np.tile(place, len(place)), block.reshape(-1)


def _factorize(entries: list[Entries], size: int, at: IntArray) -> scipy.sparse.linalg.SuperLU:
    rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    matrix = scipy.sparse.csc_matrix((values, (rows, columns)), shape=(size, size))[at][:, at].tocsc()
    try:
        return scipy.sparse.linalg.splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError as error:
        raise SolverError(
            "joining windows: the windows do not determine every camera; use longer windows or a wider overlap"
        ) from error


def _covariances(
    information: list[WindowInformation],
    cameras: Cameras,
    at: IntArray,
    known: FloatArray,
    added: AddedTerms | None,
) -> tuple[FloatArray, FloatArray]:
    """Return pose (T, 6, 6) and intrinsics (4, 4) covariances; see :mod:`uni4d_fg.optim.cluster_robust`.

    The sum over clusters, over factors without landmarks, and over all as if they were independent, is taken through
    one solve per cluster and one per direction in which a window's factors, or an added one, know anything.
    """
    num_frames = len(cameras.world_T_cam)
    base = FRAME * num_frames + 4
    size = base if added is None else added.size
    jacobians = [part.difference(cameras)[1] for part in information]
    curvatures = [j.T @ part.curvature @ j for part, j in zip(information, jacobians, strict=True)]
    curvatures[0][-4:, -4:] += known
    entries = [_entries(part, block, num_frames) for part, block in zip(information, curvatures, strict=True)]
    if added is not None:
        entries += added.linearize(cameras)[1]
    solver = _factorize(entries, size, at)

    def solutions(sides: FloatArray) -> FloatArray:
        """Return the solutions of (m, size) right-hand sides."""
        solved = np.zeros_like(sides)
        solved[:, at] = solver.solve(np.ascontiguousarray(sides[:, at].T)).T
        return solved[:, :base]

    spreads = [part.spread for part in information]
    scores = None
    if all(spread is not None for spread in spreads):
        count = max(len(spread.scores) for spread in spreads if spread is not None)
        scores = np.zeros((count, size))
        for part, j in zip(information, jacobians, strict=True):
            assert part.spread is not None
            scores[:, part.columns(num_frames)] += part.spread.scores @ j
        used = int(np.any(scores != 0.0, axis=1).sum())
        scores = np.sqrt(used / (used - 1.0)) * scores if used >= MIN_CLUSTERS else None
    rest, model = _Squares(num_frames), _Squares(num_frames)
    calibrated = np.zeros((4, size))
    calibrated[:, base - 4 : base] = _root(known)
    for sum_of in (rest, model):
        sum_of.add(solutions(calibrated))
    for part, j in zip(information, jacobians, strict=True):
        model.add(solutions(_sides(part, part.curvature, j, num_frames, size)))
        if scores is not None and part.spread is not None:
            rest.add(solutions(_sides(part, part.spread.rest, j, num_frames, size)))
    for sides in () if added is None else added.root_rows(cameras):
        rest.add(solutions(sides))
        model.add(solutions(sides))
    if scores is None:
        return model.poses, model.intrinsics
    influence, clusters = solutions(scores), _Squares(num_frames)
    clusters.add(influence)
    weights = blend(_twists(influence, num_frames), model.poses, rest.poses)
    return (
        weights.clusters * clusters.poses + weights.model * (model.poses - rest.poses) + rest.poses,
        weights.clusters * clusters.intrinsics + weights.model * (model.intrinsics - rest.intrinsics) + rest.intrinsics,
    )


class _Squares:
    """Sums of squares of solutions: marginal covariances of every pose and of the intrinsics."""

    def __init__(self, num_frames: int) -> None:
        self.poses, self.intrinsics = np.zeros((num_frames, 6, 6)), np.zeros((4, 4))

    def add(self, solved: FloatArray) -> None:
        """Add the outer products of solutions (m, 7 T + 4)."""
        twists = _twists(solved, len(self.poses))
        self.poses += np.einsum("mti,mtj->tij", twists, twists, optimize=True)
        self.intrinsics += solved[:, -4:].T @ solved[:, -4:]


def _twists(solved: FloatArray, num_frames: int) -> FloatArray:
    """Return the poses' part (m, T, 6) of solutions (m, 7 T + 4)."""
    return solved[:, :-4].reshape(len(solved), num_frames, FRAME)[:, :, :6]


def _sides(part: WindowInformation, matrix: FloatArray, jacobian: FloatArray, num_frames: int, size: int) -> FloatArray:
    """Return rows (m, size) whose squares are a window's matrix on the shared cameras."""
    sides = np.zeros((len(matrix), size))
    sides[:, part.columns(num_frames)] = _root(matrix) @ jacobian
    return sides[np.any(sides != 0.0, axis=1)]


def _root(matrix: FloatArray) -> FloatArray:
    """Return R with ``R^T R = matrix`` for a symmetric one without negative directions."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
    values = np.where(values > 1e-12 * max(float(values[-1]), 1e-300), values, 0.0)
    result: FloatArray = np.sqrt(values)[:, None] * vectors.T * scale
    return result
