"""Covariances of joined windows; see :mod:`uni4d_fg.optim.cluster_robust`.

Three sums of squares of what moves the cameras are needed: over clusters of landmarks, over factors without landmarks,
and over all as if they were independent. Of windows alone the last two are blocks of inverses along the chain; with
added factors, which tie frames anywhere, they take one solve per direction in which a window or an added factor knows
anything.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.optim.cluster_robust import MIN_CLUSTERS
from uni4d_fg.optim.few_clusters import blend
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.added_terms import AddedTerms
from uni4d_fg.slam.windows.fronts import FrontChain, sandwich_blocks
from uni4d_fg.slam.windows.information import FRAME, WindowInformation
from uni4d_fg.slam.windows.sparse_sum import SparseSum


def joined_covariances(
    information: list[WindowInformation],
    cameras: Cameras,
    free: BoolArray,
    known: FloatArray,
    added: AddedTerms | None,
) -> tuple[FloatArray, FloatArray]:
    """Return pose (T, 6, 6) and intrinsics (4, 4) covariances.

    Args:
        information: Of every window.
        cameras: The solution.
        free: (size,) columns that are uncertain.
        known: (4, 4) information on the intrinsics that is not the windows'.
        added: Factors on all frames.

    Raises:
        SolverError: If the windows do not determine a camera.
    """
    num_frames = len(cameras.world_T_cam)
    jacobians = [part.difference(cameras)[1] for part in information]
    curvatures = [j.T @ part.curvature @ j for part, j in zip(information, jacobians, strict=True)]
    curvatures[0][-4:, -4:] += known
    scores = _scores(information, jacobians, num_frames, len(free))
    rests = []
    for part, j in zip(information, jacobians, strict=True):
        rests.append(np.zeros_like(part.curvature) if part.spread is None else j.T @ part.spread.rest @ j)
    rests[0][-4:, -4:] += known

    solver: FrontChain | SparseSum
    if added is None:
        windows = [part.window for part in information]
        solver = FrontChain(windows, curvatures, free, FRAME)
        model, rest = (
            _Marginals(frames[:, :6, :6], border)
            for frames, border in sandwich_blocks(windows, curvatures, rests, free, FRAME)
        )
    else:
        solver = SparseSum(information, curvatures, added.linearize(cameras)[1], free)
        model, rest = _Marginals.none(num_frames), _Marginals.none(num_frames)
        for total, matrices in ((model, curvatures), (rest, rests)):
            for part, matrix in zip(information, matrices, strict=True):
                total.add(solver.solve(_sides(part, matrix, len(free), num_frames)))
            for sides in added.root_rows(cameras):
                total.add(solver.solve(sides))
    if scores is None:
        return model.poses, model.intrinsics
    influence, clusters = solver.solve(scores), _Marginals.none(num_frames)
    clusters.add(influence)
    weights = blend(_twists(influence, num_frames), model.poses, rest.poses)
    return (
        weights.clusters * clusters.poses + weights.model * (model.poses - rest.poses) + rest.poses,
        weights.clusters * clusters.intrinsics + weights.model * (model.intrinsics - rest.intrinsics) + rest.intrinsics,
    )


class _Marginals:
    """Covariances (T, 6, 6) of every pose and (4, 4) of the intrinsics."""

    def __init__(self, poses: FloatArray, intrinsics: FloatArray) -> None:
        self.poses, self.intrinsics = poses, intrinsics

    @classmethod
    def none(cls, num_frames: int) -> _Marginals:
        return cls(np.zeros((num_frames, 6, 6)), np.zeros((4, 4)))

    def add(self, solved: FloatArray) -> None:
        """Add the outer products of solutions (m, size)."""
        twists, border = _twists(solved, len(self.poses)), solved[:, FRAME * len(self.poses) :][:, :4]
        self.poses += np.einsum("mti,mtj->tij", twists, twists, optimize=True)
        self.intrinsics += border.T @ border


def _scores(
    information: list[WindowInformation], jacobians: list[FloatArray], num_frames: int, size: int
) -> FloatArray | None:
    """Return one row (G, size) per cluster of landmarks; None where errors count as independent."""
    spreads = [part.spread for part in information if part.spread is not None]
    if len(spreads) < len(information):
        return None
    scores = np.zeros((max(len(spread.scores) for spread in spreads), size))
    for part, spread, j in zip(information, spreads, jacobians, strict=True):
        scores[: len(spread.scores), part.columns(num_frames)] += spread.scores @ j
    used = int(np.any(scores != 0.0, axis=1).sum())
    return np.sqrt(used / (used - 1.0)) * scores if used >= MIN_CLUSTERS else None


def _twists(solved: FloatArray, num_frames: int) -> FloatArray:
    """Return the poses' part (m, T, 6) of solutions (m, size)."""
    return solved[:, : FRAME * num_frames].reshape(len(solved), num_frames, FRAME)[:, :, :6]


def _sides(part: WindowInformation, matrix: FloatArray, size: int, num_frames: int) -> FloatArray:
    """Return rows (m, size) whose squares are a window's matrix, without negative directions, on all columns."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
    values = np.where(values > 1e-12 * max(float(values[-1]), 1e-300), values, 0.0)
    sides = np.zeros((len(matrix), size))
    sides[:, part.columns(num_frames)] = np.sqrt(values)[:, None] * vectors.T * scale
    return sides[np.any(sides != 0.0, axis=1)]
