"""Covariances of joined windows; see :mod:`uni4d_fg.optim.cluster_robust`.

Three sums of squares of what moves the cameras are needed: over clusters of landmarks, over factors without landmarks,
and over all as if they were independent; added factors count among both of the latter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.optim.cluster_robust import MIN_CLUSTERS, Spread
from uni4d_fg.optim.few_clusters import blend
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.added_terms import AddedTerms
from uni4d_fg.slam.windows.fronts import sandwich_blocks, stepped_chain
from uni4d_fg.slam.windows.information import FRAME, SHARED, WindowInformation, WindowJacobian


def joined_covariances(
    information: list[WindowInformation],
    cameras: Cameras,
    free: BoolArray,
    known: FloatArray,
    added: AddedTerms | None,
) -> tuple[FloatArray, FloatArray]:
    """Return pose (T, 6, 6) and intrinsics (4, 4) covariances.

    Args:
        information: Of every window, with what covariances are made of.
        cameras: The solution.
        free: (size,) columns that are uncertain.
        known: (4, 4) information on the intrinsics that is not the windows'.
        added: Factors on all frames.

    Raises:
        SolverError: If the windows do not determine a camera.
    """
    num_frames = len(cameras.world_T_cam)
    jacobians = [part.difference(cameras)[1] for part in information]
    uncertainties = [part.uncertainty for part in information if part.uncertainty is not None]
    curvatures = [j.congruent(one.curvature) for one, j in zip(uncertainties, jacobians, strict=True)]
    curvatures[0][-4:, -4:] += known
    scores = _scores(information, [one.spread for one in uncertainties], jacobians, num_frames, len(free))
    rests = []
    for one, j in zip(uncertainties, jacobians, strict=True):
        rests.append(np.zeros_like(one.curvature) if one.spread is None else j.congruent(one.spread.rest))
    rests[0][-4:, -4:] += known

    windows, entries = [part.window for part in information], [] if added is None else added.linearize(cameras)[1]
    chain = stepped_chain(windows, curvatures, rests, free, FRAME, SHARED, entries)
    model, rest = (_Marginals(frames[:, :6, :6], border[:SHARED, :SHARED]) for frames, border in sandwich_blocks(chain))
    if scores is None:
        return model.poses, model.intrinsics
    influence = chain.real().solve(scores)
    twists = influence[:, : FRAME * num_frames].reshape(len(scores), num_frames, FRAME)[:, :, :6]
    of_intrinsics = influence[:, FRAME * num_frames :][:, :SHARED]
    clusters = _Marginals(np.einsum("mti,mtj->tij", twists, twists, optimize=True), of_intrinsics.T @ of_intrinsics)
    weights = blend(twists, model.poses, rest.poses)
    return (
        weights.clusters * clusters.poses + weights.model * (model.poses - rest.poses) + rest.poses,
        weights.clusters * clusters.intrinsics + weights.model * (model.intrinsics - rest.intrinsics) + rest.intrinsics,
    )


class _Marginals(NamedTuple):
    """Covariances (T, 6, 6) of every pose and (4, 4) of the intrinsics."""

    poses: FloatArray
    intrinsics: FloatArray


def _scores(
    information: list[WindowInformation], found: list[Spread | None], jacobians: list[WindowJacobian],
    num_frames: int, size: int,
) -> FloatArray | None:  # fmt: skip
    """Return one row (G, size) per cluster of landmarks; None where errors count as independent."""
    spreads = [spread for spread in found if spread is not None]
    if len(spreads) < len(information):
        return None
    scores = np.zeros((max(len(spread.scores) for spread in spreads), size))
    for part, spread, j in zip(information, spreads, jacobians, strict=True):
        scores[: len(spread.scores), part.columns(num_frames)] += j.left_product(spread.scores)
    used = int(np.any(scores != 0.0, axis=1).sum())
    return np.sqrt(used / (used - 1.0)) * scores if used >= MIN_CLUSTERS else None
