r"""The prior on the camera's acceleration, whose strength is a variance component of the sequence itself.

The accelerations a (3 components at each inner frame) of a camera path are taken for independent and normal with one
variance s^2, the same for the whole sequence. What a solve finds of them is y = a + e with e ~ N(0, C):
C = D S D^T, S the covariance of the poses and D the derivative of the accelerations. In the axes in which C is
diagonal, with eigenvalues c_i,

    -2 log p(y | s) = sum_i log(s^2 + c_i) + y_i^2 / (s^2 + c_i) + const

is minimized over s: what the noise of the poses explains is not taken for motion. S and y must not hold a prior on a
already. The solve that they come from has a weak one, of sigma w, which keeps frames without tracks in place; it is
taken out exactly, direction by direction: 1/c_i = 1/c'_i - 1/w^2 and y_i = y'_i c_i / c'_i for what was found with it.
Source: restricted maximum likelihood (Patterson and Thompson 1971); Koch 1986 for variance components in adjustment.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.config.stages import AccelerationConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.camera_acceleration import camera_angular_acceleration, camera_linear_acceleration
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.marginals import inverse_of_positive_definite, reduced_hessian
from uni4d_fg.optim.problem import Problem

_WEAK = 0.1
"""The weak prior: a departure from constant velocity by this part of the scene's distance, or rad, within a frame."""
_CHUNK = 64
"""Frames whose covariance is computed at once; the frames around them are held, which their noise hardly feels."""
_DETERMINED = 0.99
"""A direction in which the weak prior makes up more than this part of the information says nothing."""
_LEAST = 0.1
"""Sigma is at least this part of the median noise of the accelerations: below, it makes no difference."""


@dataclass(frozen=True)
class AccelerationPrior:
    """How strongly a path is expected to have no acceleration."""

    timestamps: FloatArray
    """(T,) seconds, ascending."""
    linear: float | None
    """Standard deviation of each component, m/s^2; None without a prior."""
    angular: float | None
    """The same, rad/s^2."""
    is_weak: tuple[str, ...] = ()
    """Which of the two are weak and yet to be estimated."""

    def arrays(self) -> dict[str, FloatArray]:
        """Return it as arrays for a file."""
        sigma = [np.nan if s is None else s for s in (self.linear, self.angular)]
        return {"acceleration_sigma": np.array(sigma), "acceleration_times": self.timestamps}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> AccelerationPrior | None:
        """Return what :meth:`arrays` was made of; None where nothing is known of it."""
        if "acceleration_sigma" not in arrays:
            return None
        linear, angular = (None if np.isnan(s) else float(s) for s in arrays["acceleration_sigma"])
        return cls(arrays["acceleration_times"], linear, angular)

    def facts(self, length_unit: str = "m") -> list[str]:
        """Return what a summary says of it."""
        sigmas = ((self.linear, f"{length_unit}/s^2", "linear"), (self.angular, "rad/s^2", "angular"))
        known = [f"{s:.2g} {unit}" for s, unit, name in sigmas if s is not None and name not in self.is_weak]
        return ["the camera's acceleration is taken for " + " and ".join(known)] if known else []

    def terms(self) -> list[FactorBatch]:
        """Return the factors over all frames."""
        steps = np.diff(self.timestamps)
        first = np.arange(max(len(steps) - 1, 0))
        if len(first) == 0:
            return []
        return [
            kind(first, first + 1, first + 2, seconds_before=steps[:-1], seconds_after=steps[1:], sigma=sigma)
            for kind, sigma in (
                (camera_angular_acceleration, self.angular),
                (camera_linear_acceleration, self.linear),
            )
            if sigma is not None
        ]


def frame_interval(timestamps: FloatArray) -> float:
    """Return the usual time between two frames with times (T,), T > 1, s."""
    return float(np.median(np.diff(timestamps)))


def starting_prior(
    config: AccelerationConfig, timestamps: FloatArray | None, world_T_cam: FloatArray, landmarks: FloatArray
) -> AccelerationPrior:
    """Return the prior of the first solve: the sigmas that are given, and weak ones in place of those to estimate.

    Args:
        config: What is given.
        timestamps: (T,) s; where they are not known, frames count as equally far apart, and no sigma as given.
        world_T_cam: (T, 4, 4) starting poses.
        landmarks: (N, 3) starting landmarks; their distance says what is a large motion.
    """
    sigmas: dict[str, float | None] = {}
    is_weak = []
    known = timestamps is not None
    if timestamps is None:
        timestamps = np.arange(len(world_T_cam), dtype=np.float64)
    per_frame = frame_interval(timestamps) if len(timestamps) > 1 else 1.0
    distance = float(np.median(np.linalg.norm(landmarks - world_T_cam[:, :3, 3].mean(axis=0), axis=1)))
    weak = _WEAK / per_frame**2
    for name, given, unit in (("linear", config.linear, max(distance, 1e-9)), ("angular", config.angular, 1.0)):
        if given == "auto" or (given is not None and not known):
            sigmas[name] = weak * unit
            is_weak.append(name)
        else:
            sigmas[name] = given
    return AccelerationPrior(timestamps, sigmas["linear"], sigmas["angular"], tuple(is_weak))


def estimate_prior(
    prior: AccelerationPrior, problem: Problem, state: State, solver: SolverConfig, overstated: float = 1.0
) -> AccelerationPrior:
    """Return the prior with some sigmas estimated at the end of a solve.

    Args:
        prior: Of :func:`starting_prior`, which is among the factors of ``problem``.
        problem: Bundle adjustment with the noise it is to be solved with.
        state: The end of the first solve.
        solver: Its options.
        overstated: The sigmas of the observations as a multiple of the true ones. The true ones say how noisy the
            accelerations are; against overstated ones the prior must be as much weaker.

    Raises:
        SolverError: If a factor is not finite.
    """
    reduced = reduced_hessian(problem, state, solver, LANDMARK)
    if reduced is None:
        return prior
    found: dict[FactorType, list[tuple[FloatArray, FloatArray]]] = {}
    for frames in _chunks(len(prior.timestamps)):
        for batch in prior.terms():
            seen = _seen_with_noise(batch, frames, reduced, state)
            if seen is not None:
                found.setdefault(batch.factor_type, []).append(seen)
    estimated: dict[str, float | None] = {"linear": prior.linear, "angular": prior.angular}
    for name, kind in (("linear", camera_linear_acceleration), ("angular", camera_angular_acceleration)):
        if name in prior.is_weak and kind in found:
            y, noise = (np.concatenate(part) for part in zip(*found[kind], strict=True))
            if len(y):
                estimated[name] = overstated * variance_component(y, noise / overstated**2)
    return AccelerationPrior(prior.timestamps, estimated["linear"], estimated["angular"])


def variance_component(y: FloatArray, noise: FloatArray) -> float:
    """Return the s that makes y_i ~ N(0, s^2 + noise_i) likeliest, at least a tenth of the median noise.

    Args:
        y: (n,).
        noise: (n,) positive variances.
    """
    squared = y**2
    least = _LEAST * np.sqrt(np.median(noise))
    low, high = np.log(least), np.log(max(10.0 * np.sqrt(squared.max()), 2.0 * least))
    for _ in range(4):  # a finer and finer grid: the likelihood may have two tops
        grid = np.linspace(low, high, 25)
        total = np.exp(2.0 * grid)[:, None] + noise
        best = int(np.argmin((np.log(total) + squared / total).sum(axis=1)))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    return float(np.exp(0.5 * (low + high)))


def _chunks(num_frames: int) -> list[IntArray]:
    count = max(1, round(num_frames / _CHUNK))
    return [np.asarray(part) for part in np.array_split(np.arange(num_frames), count)]


def _seen_with_noise(
    batch: FactorBatch, frames: IntArray, reduced: tuple[DenseLayout, FloatArray, FloatArray], state: State
) -> tuple[FloatArray, FloatArray] | None:
    """Return the accelerations of some frames along the axes of their noise, and the noise's variances.

    Returns:
        (n,) and (n,); None where the cameras are not determined.
    """
    layout, hessian, gradient = reduced
    sigma = float(batch.sigma[0])
    within = (batch.slots[0].rows >= frames[0]) & (batch.slots[2].rows <= frames[-1])
    batch = batch.take(np.flatnonzero(within))
    if len(batch) == 0:
        return None
    columns = [layout.columns(POSE, frames).ravel()]
    columns += [layout.columns(LOG_SCALE, frames).ravel()] if LOG_SCALE in layout.offset else []
    columns += [layout.columns(INTRINSICS, np.zeros(1, dtype=np.int64)).ravel()] if INTRINSICS in layout.offset else []
    at = np.concatenate(columns)
    free = layout.free[at].astype(bool)
    covariance = inverse_of_positive_definite(hessian[np.ix_(at[free], at[free])])
    if covariance is None:
        return None
    y, jacobians = batch.factor_type.linearize(*batch.gather(state), **batch.data)
    by_column = np.zeros((y.size, layout.size))
    for slot, jacobian in zip(batch.slots, jacobians, strict=True):
        own = layout.columns(POSE, slot.rows)
        by_column[np.arange(y.size).reshape(y.shape)[:, :, None], own[:, None, :]] += jacobian
    by_column = by_column[:, at[free]]
    # One Gauss-Newton step: y and its covariance are then those of one linear problem.
    found = y.ravel() - by_column @ (covariance @ gradient[at[free]])
    noise, axes = np.linalg.eigh(by_column @ covariance @ by_column.T)
    found, noise = axes.T @ found, np.maximum(noise, 1e-12 * noise.max())
    kept = noise < _DETERMINED * sigma**2
    found, noise = found[kept], noise[kept]
    without = 1.0 / (1.0 / noise - 1.0 / sigma**2)
    return found * without / noise, without
