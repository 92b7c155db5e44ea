r"""Covariances of the cameras when errors are alike along tracks and among neighbors.

The marginals of :mod:`uni4d_fg.optim.marginals` count every observation as new information. Trackers err alike from
frame to frame and from point to neighboring point, and so do depth cues: there is less. Let ``u_k`` be what the
observations of landmark k pull the cameras with, after the landmark has been eliminated. Landmarks are put into
clusters, errors may be anything within a cluster and are independent between clusters, and

    cov(d_c) = A^{-1} (sum_g u_g u_g^T  +  B_0) A^{-1},      u_g = sum of u_k over the cluster,

where A is the reduced Hessian with the mean slope of each kernel (not the weight of reweighted least squares, which is
larger), and B_0 the information of factors without landmarks. No correlation has to be modeled: it is in the sums.
With independent errors of the factors' sigmas this is A^{-1} again, known from about as many samples as there are
clusters; because these are few, the sum over clusters is steadied by what independent errors would give
(:mod:`uni4d_fg.optim.few_clusters`). Errors that all clusters share (lens distortion that is alike everywhere) are not
seen.
Source: Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions"; Liang and Zeger 1986,
"Longitudinal data analysis using generalized linear models".
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray, sum_rows
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.marginalization_prior import MARGINALIZATION_PRIOR
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import LANDMARK, POSE
from uni4d_fg.optim.extension import linearize_batch
from uni4d_fg.optim.few_clusters import blend
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.marginals import CameraMarginals, camera_marginals
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.threads import map_in_order, thread_count, workers_in_order

MIN_CLUSTERS = 8
"""With fewer, their spread says too little, and errors count as independent."""
_MIN_SLOPE = 0.05
"""Smallest ratio of a kernel's mean slope to its mean weight that is believed."""
_PART_ROWS = 1 << 16
"""Factors that are linearized at once."""


@dataclass(frozen=True)
class Clusters:
    """Which landmarks may err alike."""

    of_landmark: IntArray
    """(N,) in 0 .. count - 1."""
    count: int


@dataclass(frozen=True)
class Spread:
    """Covariance of the gradient on n columns: ``scores^T scores + rest``."""

    scores: FloatArray
    """(G, n) one row per cluster."""
    rest: FloatArray
    """(n, n)."""

    @property
    def num_used(self) -> int:
        """Clusters that have any observation."""
        return int(np.any(self.scores != 0.0, axis=1).sum())

    @property
    def unbiased_scores(self) -> FloatArray:
        """The scores with the factor G / (G - 1) of a sample covariance on their squares."""
        used = max(self.num_used, 2)
        result: FloatArray = np.sqrt(used / (used - 1.0)) * self.scores
        return result

    def covariance(self) -> FloatArray:
        """Return the covariance (n, n) of the gradient."""
        scores = self.unbiased_scores
        result: FloatArray = scores.T @ scores + self.rest
        return result

    def project(self, matrix: FloatArray) -> Spread:
        """Return the spread of ``matrix^T gradient``, for a matrix (n, m)."""
        return Spread(self.scores @ matrix, matrix.T @ self.rest @ matrix)


def image_cells(uv: FloatArray, intrinsics: FloatArray, cells: int) -> IntArray:
    """Return the cell of each pixel (N, 2), numbered 0 .. cells^2 - 1, of a square grid over the image.

    The image is taken to reach as far beyond the principal point of ``intrinsics`` (4,) as before it.
    """
    size = 2.0 * float(intrinsics[2:].max()) / cells
    at = np.clip((uv / max(size, 1e-9)).astype(np.int64), 0, cells - 1)
    result: IntArray = at[:, 0] * cells + at[:, 1]
    return result


def curvature_batch(batch: FactorBatch, state: State) -> FactorBatch:
    """Return a quadratic batch whose Hessian is the mean curvature of a robust one at ``state``."""
    if batch.kernel.kind == "quadratic" or len(batch) == 0:
        return batch
    return replace(batch, weight=batch.weight * _mean_curvature(batch, _squared_norms(batch, state)), kernel=Kernel())


def _parts(batch: FactorBatch) -> list[slice]:
    return [slice(start, start + _PART_ROWS) for start in range(0, len(batch), _PART_ROWS)]


def _squared_norms(batch: FactorBatch, state: State) -> FloatArray:
    """Return what :meth:`FactorBatch.squared_norm` does, in parts."""
    found = map_in_order(lambda part: batch.take(part).squared_norm(state), _parts(batch), thread_count())
    return np.concatenate(found) if found else np.zeros(0)


def _mean_curvature(batch: FactorBatch, squared: FloatArray) -> FloatArray:
    """Return the kernel's weights at squared norms (N,), scaled by the ratio of its mean slope to its mean weight."""
    if batch.kernel.kind == "quadratic":
        return np.ones_like(squared)
    weight = batch.kernel.weight(squared)
    slope = float(np.sum(batch.weight * batch.kernel.slope(squared, batch.factor_type.dim)))
    result: FloatArray = weight * max(slope / max(float(np.sum(batch.weight * weight)), 1e-300), _MIN_SLOPE)
    return result


def gradient_spread(
    batches: tuple[FactorBatch, ...],
    state: State,
    layout: DenseLayout,
    clusters: Clusters,
    eliminate: VariableType,
    carried: Spread | None = None,
    *,
    as_prior: bool = False,
    held: bool = False,
) -> Spread:
    """Return the spread of the reduced gradient on the columns of a layout.

    Args:
        batches: Factors; those on landmarks count by cluster, others by their information.
        state: The solution.
        layout: Columns.
        clusters: Of the landmarks.
        eliminate: Group of the landmarks.
        carried: Spread that belongs to a linear prior among the batches, on the columns of its slots; the prior counts
            by its information when None.
        as_prior: The spread that a linear prior made of these factors has. Its Hessian is that of reweighted least
            squares, and its minimum spreads by the curvature: the scores grow by the ratio of the two.
        held: The landmarks are constants: nothing of them is eliminated.
    """
    scores, rest = np.zeros((clusters.count, layout.size)), np.zeros((layout.size, layout.size))
    on_landmarks = [batch for batch in batches if len(batch) and any(s.variable == eliminate for s in batch.slots)]
    ratio = _add_scores(scores, on_landmarks, state, layout, clusters, eliminate, held)
    if as_prior:
        scores /= ratio
    for batch in batches:
        if len(batch) == 0 or any(s.variable == eliminate for s in batch.slots):
            continue
        if batch.name == MARGINALIZATION_PRIOR and carried is not None:
            at = np.concatenate(
                [layout.columns(s.variable, s.rows)[0] for s in batch.slots if s.variable in layout.offset]
            )
            own = np.concatenate(_own_columns(batch, layout))
            scores[:, at] += carried.scores[:, own]
            rest[np.ix_(at, at)] += carried.rest[np.ix_(own, own)]
            continue
        _, jacobians = batch.linearize(state)
        parts = [(layout.columns(s.variable, s.rows), j) for s, j in zip(batch.slots, jacobians, strict=True)
                 if s.variable in layout.offset]  # fmt: skip
        for rows, left in parts:
            for columns, right in parts:
                product = np.swapaxes(left, 1, 2) @ right
                np.add.at(rest, (rows[:, :, None], columns[:, None, :]), product)
    scores[:, ~layout.free] = 0.0
    rest[~layout.free] = 0.0
    rest[:, ~layout.free] = 0.0
    return Spread(scores, rest)


def clustered_marginals(
    problem: Problem,
    state: State,
    config: SolverConfig,
    clusters: Clusters,
    eliminate: VariableType = LANDMARK,
    carried: Spread | None = None,
) -> CameraMarginals | None:
    """Return the joint covariance of the cameras at a solution, see the module's docstring.

    Args:
        problem: Factors and free entries of the solve.
        state: Its solution.
        config: Options of the solve.
        clusters: Of the landmarks.
        eliminate: Group of the landmarks; constants where the problem does not free them.
        carried: See :func:`gradient_spread`.

    Returns:
        None if the factors do not determine every free entry.

    Raises:
        SolverError: If a factor is not finite.
    """
    batches = tuple(curvature_batch(batch, state) for batch in problem.batches)
    held = eliminate not in problem.free
    marginals = camera_marginals(Problem(batches, problem.free), state, config, None if held else eliminate)
    if marginals is None:
        return None
    spread = gradient_spread(problem.batches, state, marginals.layout, clusters, eliminate, carried, held=held)
    if spread.num_used < MIN_CLUSTERS:
        return marginals
    return steadied(marginals, spread)


def steadied(marginals: CameraMarginals, spread: Spread) -> CameraMarginals:
    """Return the covariance that a spread of the gradient gives, see :mod:`uni4d_fg.optim.few_clusters`."""
    inverse = marginals.covariance
    if POSE not in marginals.layout.offset:
        return replace(marginals, covariance=inverse @ spread.covariance() @ inverse)
    influence = spread.unbiased_scores @ inverse
    rest = replace(marginals, covariance=inverse @ spread.rest @ inverse)
    num_poses = marginals.layout.count[POSE]
    columns = marginals.layout.columns(POSE, np.arange(num_poses))
    weights = blend(influence[:, columns], marginals.blocks(POSE, num_poses), rest.blocks(POSE, num_poses))
    covariance = weights.clusters * influence.T @ influence + rest.covariance
    covariance += weights.model * (inverse - rest.covariance)
    return replace(marginals, covariance=covariance)


def _own_columns(batch: FactorBatch, layout: DenseLayout) -> list[IntArray]:
    """Return, per slot that the layout has, the columns of the batch's own stacked variables."""
    out, start = [], 0
    for slot in batch.slots:
        dim = slot.variable.dim
        if slot.variable in layout.offset:
            out.append(np.arange(start, start + dim))
        start += dim
    return out


def _add_scores(
    scores: FloatArray,
    batches: list[FactorBatch],
    state: State,
    layout: DenseLayout,
    clusters: Clusters,
    eliminate: VariableType,
    held: bool,
) -> float:
    """Add ``J_c^T (w r - p J_l V^{-1} g_l)`` of every row to the score of its landmark's cluster; of held ones ``w r``.

    Returns the ratio of the rows' curvature to their weights.
    """
    count = len(state[eliminate])
    hessian, gradient = np.zeros((count, 9)), np.zeros((count, 3))
    curvature, weights = 0.0, 0.0
    plans = []
    for batch in batches:
        squared = _squared_norms(batch, state)
        curved, weight = _mean_curvature(batch, squared), batch.kernel.weight(squared)
        curvature, weights = curvature + float(curved.sum()), weights + float(weight.sum())
        at = next(i for i, s in enumerate(batch.slots) if s.variable == eliminate)
        plans += [_ScoredPart(replace(batch, kernel=Kernel()), part, at, curved, weight) for part in _parts(batch)]
    step = np.zeros((count, 3))
    with workers_in_order(thread_count()) as mapped:
        if not held:
            for block, slope in mapped(lambda part: part.landmark_equations(state, count), plans):
                hessian += block
                gradient += slope
            step = (np.linalg.pinv(hessian.reshape(-1, 3, 3), hermitian=True) @ gradient[:, :, None])[:, :, 0]
        for added in mapped(lambda part: part.scores(state, layout, clusters, step), plans):
            scores += added
    return curvature / weights if weights > 0 else 1.0


@dataclass(frozen=True)
class _ScoredPart:
    """Some rows of a batch on landmarks, linearized when asked: all Jacobians at once would fill the memory."""

    batch: FactorBatch
    """Without its kernel."""
    part: slice
    at: int
    """The landmarks' slot."""
    curvature: FloatArray
    """Of the kernel at all rows of the batch, as :func:`_mean_curvature` says."""
    weight: FloatArray
    """The kernel's weight at all rows of the batch."""

    def _linearized(self, state: State) -> tuple[FactorBatch, FloatArray, list[FloatArray]]:
        taken = self.batch.take(self.part)
        r, jacobians = linearize_batch(taken, state)
        return taken, r * self.weight[self.part, None], jacobians

    def landmark_equations(self, state: State, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the rows' share in the landmarks' Hessians (N, 9) and gradients (N, 3)."""
        taken, r, jacobians = self._linearized(state)
        point, landmark = jacobians[self.at], taken.slots[self.at].rows
        block = (np.swapaxes(point, 1, 2) @ (self.curvature[self.part, None, None] * point)).reshape(-1, 9)
        slope = np.einsum("nda,nd->na", point, r)
        return sum_rows(block, landmark, count), sum_rows(slope, landmark, count)

    def scores(self, state: State, layout: DenseLayout, clusters: Clusters, step: FloatArray) -> FloatArray:
        """Return the rows' share in the scores (G, n), landmarks moved by ``step`` (N, 3)."""
        taken, r, jacobians = self._linearized(state)
        landmark = taken.slots[self.at].rows
        pull = r - self.curvature[self.part, None] * np.einsum("nda,na->nd", jacobians[self.at], step[landmark])
        start, size = clusters.of_landmark[landmark] * layout.size, clusters.count * layout.size
        out = np.zeros(size)
        for i, slot in enumerate(taken.slots):
            if i == self.at or slot.variable not in layout.offset:
                continue
            place = start[:, None] + layout.columns(slot.variable, slot.rows)
            value = np.einsum("nda,nd->na", jacobians[i], pull)
            out += np.bincount(place.reshape(-1), value.reshape(-1), size)
        return out.reshape(clusters.count, layout.size)
