r"""How far the tracks leave the focal length open: an interval from the energy of bundle adjustment.

With everything else free to follow, the energy over the focal length f is E(f). An interval of 95 % is where

    E(f) - E(f*)  <=  3.84 / 2 * sigma^2 * d,

with sigma^2 the variance of the residuals that are left, and d what the variance of f grows by because errors are not
independent. That is the larger of two: the design effect (Kish 1965) of residuals that are alike along a track and in
one part of one frame; and what the pull at f of all tracks that begin in the same part of the image says
(:mod:`uni4d_fg.optim.cluster_robust`). Neither sees what all parts share: d is taken to be `_SHARED` squared times as
large. Where the quadratic at f* says that the interval is narrow, it is taken from there;
elsewhere E(f) is minimized at several f. The prior on the focal length has no say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.cues.depth_settings import OPEN_FOCAL_SIGMA
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.selection import picture_cells
from uni4d_fg.errors import Cancelled, SolverError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optim.cluster_robust import Clusters, clustered_marginals, image_cells
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage, run_stage, until_converged
from uni4d_fg.optim.summary import Termination
from uni4d_fg.robust import WITHIN_95
from uni4d_fg.slam.stages.noise import intraclass_correlation

_CHI2 = 3.841
"""95 % of chi squared with one degree of freedom."""
_SHARED = 2.0
"""On 34 random synthetic clips half of the errors of f were above 1.8 standard deviations, and not above 0.7."""
_CELLS = 8
"""Parts of the image along its longer side whose tracks may err alike."""
_FIRST_STEP = 0.03
"""Step of log f with which the search for an end of the interval begins, at least ..."""
_WIDEN = 1.6
"""... and by what it grows."""
_MAX_STEPS = 8


@dataclass(frozen=True)
class FocalInterval:
    """Focal lengths that explain the tracks as well as the one that was found."""

    low: float
    """px."""
    high: float
    """px."""
    low_is_open: bool = False
    """Whether the energy does not rise down to the least focal length that was tried."""
    high_is_open: bool = False
    """The same for the largest."""
    deviation: float = 0.0
    """Standard deviation of log f that the tracks leave, by the quadratic; NaN where they say nothing of f."""

    @property
    def is_wide(self) -> bool:
        """Whether the tracks tell the focal length so poorly that what cameras usually have says something, too."""
        return not self.deviation <= OPEN_FOCAL_SIGMA

    def likely(self, focal: float, usual: float, sigma: float) -> float:
        """Return the most likely focal length, px, of a focal length that was found and one that cameras usually have.

        Args:
            focal: What the tracks say, px, with this interval's deviation.
            usual: Of such a camera, px.
            sigma: Standard deviation of the log of focal lengths about the usual one.
        """
        if not np.isfinite(self.deviation):
            return usual
        weight = sigma**2 / (sigma**2 + self.deviation**2)
        return float(np.exp(weight * np.log(focal) + (1.0 - weight) * np.log(usual)))

    def likely_sigma(self, sigma: float) -> float:
        """Return the standard deviation of the log of :meth:`likely`."""
        own = self.deviation
        return own * sigma / float(np.hypot(own, sigma)) if np.isfinite(own) else sigma

    def relative(self, focal: float) -> tuple[float, float]:
        """Return by which part the ends are below (negative) and above a focal length."""
        return self.low / focal - 1.0, self.high / focal - 1.0

    def reach(self, focal: float) -> float:
        """Return the part of a focal length by which the farther end is away from it."""
        below, above = self.relative(focal)
        return max(-below, above)

    def holding(self, focals: list[float]) -> FocalInterval:
        """Return the interval widened so that it holds other focal lengths, px."""
        low, high = min([self.low, *focals]), max([self.high, *focals])
        return replace(self, low=low, high=high)


def focal_interval(scene: GrowingScene, image_size: tuple[int, int], freedom: float = 1.0) -> FocalInterval:
    """Return the focal lengths that the tracks leave open; a point where they are held.

    Args:
        scene: Refined.
        image_size: (height, width), px.
        freedom: So many times less certain the focal length is, as something else is free, too.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    focal = scene.mean_focal
    deviation, noise = _deviation(scene, image_size)
    deviation, noise = freedom * deviation, freedom**2 * noise
    if deviation == 0.0:
        return FocalInterval(focal, focal)
    if deviation <= OPEN_FOCAL_SIGMA:  # as far as that E(f) is as good as quadratic
        ends = focal * np.exp(np.array([-WITHIN_95, WITHIN_95]) * deviation)
        return FocalInterval(float(ends[0]), float(ends[1]), deviation=deviation)
    profile = _Profile(scene, noise)
    limits = np.log(np.array(scene.config.geometric_depth.usual_focal) * max(image_size) / focal)
    step = max(_FIRST_STEP, float(np.nan_to_num(deviation, nan=0.1)))
    low, low_is_open = profile.end(-step, float(limits[0]))
    high, high_is_open = profile.end(step, float(limits[1]))
    return FocalInterval(focal * np.exp(low), focal * np.exp(high), low_is_open, high_is_open, deviation)


def focal_is_open(scene: GrowingScene, image_size: tuple[int, int]) -> bool:
    """Return whether :func:`focal_interval` would be wide, without looking for its ends. Raises as it does."""
    return not _deviation(scene, image_size)[0] <= OPEN_FOCAL_SIGMA


def _deviation(scene: GrowingScene, image_size: tuple[int, int]) -> tuple[float, float]:
    """Return the standard deviation of log f, 0 where it is held, and the noise in units of what is assumed."""
    stage, state, frames, rows = scene.bundle()
    if not stage.problem.is_free(INTRINSICS):
        return 0.0, 1.0
    independent = scene.focal_deviation()
    noise = _noise(scene, stage, state, frames, rows, image_size)
    if np.isfinite(independent):
        noise = max(noise, (clustered_deviation(scene, stage, state) / independent) ** 2)
    noise *= _SHARED**2
    return independent * float(np.sqrt(noise)), noise


class _Profile:
    """The energy over log f, from the focal length that was found."""

    def __init__(self, scene: GrowingScene, noise: float) -> None:
        stage, self.state, _, _ = scene.bundle(free_focal=False)
        self.stage = until_converged(stage)
        self.allowed = 0.5 * _CHI2 * noise
        self.hooks = Hooks(should_stop=scene.should_stop)
        self.least, self.state = self._solve(self.state, 0.0)

    def end(self, step: float, limit: float) -> tuple[float, bool]:
        """Return where the energy has risen by what is allowed, as log f, and whether that is the limit instead."""
        state, at, root, near = self.state, 0.0, 0.0, 0.0
        for _ in range(_MAX_STEPS):
            beyond = abs(at + step) >= abs(limit) or limit * step <= 0
            target = limit if beyond and limit * step > 0 else at + step
            energy, state = self._solve(state, target - at)
            root = float(np.sqrt(max(energy - self.least, 0.0) / self.allowed))
            if root >= 1.0:
                # The root of a parabola is a line.
                return at + (target - at) * (1.0 - near) / max(root - near, 1e-12), False
            at, near, step = target, root, _WIDEN * step
            if beyond:
                break
        return at, True

    def _solve(self, state: State, change: float) -> tuple[float, State]:
        intrinsics = state[INTRINSICS] * np.array([np.exp(change), np.exp(change), 1.0, 1.0])
        state, summary = run_stage(self.stage, state.replace({INTRINSICS: intrinsics}), self.hooks)
        if summary.termination is Termination.CANCELLED:
            raise Cancelled("structure from motion stopped")
        return self.stage.problem.energy(state), state


def _noise(
    scene: GrowingScene, stage: Stage, state: State, frames: IntArray, rows: IntArray, image_size: tuple[int, int]
) -> float:
    """Return sigma^2 d, in units of the variance that bundle adjustment assumes."""
    observations, row = scene.used()
    residual = observations.uv - project(
        scene.intrinsics, world_to_camera(scene.world_T_cam[observations.frame], scene.position[row])
    )
    free = 2 * len(residual) - 6 * len(frames) - 3 * len(rows)
    energy = stage.problem.energy(state)
    if free <= 0 or not np.isfinite(energy):
        raise SolverError("structure from motion: fewer observations than unknowns")
    _, track = np.unique(row, return_inverse=True)
    cells = picture_cells(observations.uv, image_size)
    _, place = np.unique(observations.frame * (cells.max() + 1) + cells, return_inverse=True)
    return 2.0 * energy / free * design_effect(residual, track) * design_effect(residual, place)


def clustered_deviation(scene: GrowingScene, stage: Stage, state: State) -> float:
    """Return the standard deviation of log f where the tracks of one part of the image err alike; 0 if unknown."""
    used, row = scene.used()
    _, first = np.unique(row, return_index=True)  # of each track, its first frame
    clusters = Clusters(image_cells(used.uv[first], scene.intrinsics, _CELLS), _CELLS**2)
    marginals = clustered_marginals(stage.problem, state, stage.solver, clusters, LANDMARK)
    if marginals is None:
        return 0.0
    return float(np.sqrt(np.max(np.diag(marginals.blocks(INTRINSICS, 1)[0])[:2] / scene.intrinsics[:2] ** 2)))


def design_effect(residual: FloatArray, group: IntArray) -> float:
    """Return by how much a variance grows as the residuals (N, 2) of one group (N,) are alike, at least 1."""
    count = np.bincount(group)
    size = float(np.sum(count.astype(np.float64) ** 2) / len(group))
    alike = float(np.mean([intraclass_correlation(residual[:, axis], group) for axis in (0, 1)]))
    return 1.0 + max(size - 1.0, 0.0) * alike
