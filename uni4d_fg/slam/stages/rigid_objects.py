r"""Which moving instances are rigid bodies, and their poses.

An instance is taken for rigid on two conditions, neither of which knows the scene:

1. Nearly all its trajectories are *members*: one pose per frame and one point per trajectory explain each of them to
   the noise that was measured on the static scene.
2. It predicts better. A part of the observations is hidden from both models, which are then fitted to the rest: the
   rigid body, and the non-rigid energy of stage 3. With e the reprojection error of a hidden observation in sigmas,
   the advantage of the rigid body is the mean over all hidden observations of members of

       rho(|e_nonrigid|) - rho(|e_rigid|)        [nats]

   and must exceed its standard error by a factor. The error allows for observations of one trajectory, and for those
   of one frame, that err alike: it is the larger of the two cluster-robust ones (Liang and Zeger 1986).

A body with 6 numbers per frame and 3 per point averages the noise that 3 numbers per point and frame must follow, and
so predicts better where it is true; where it is not, it fails by the whole deformation. Depth is left out of the
score: its errors are alike among neighbors, so that a model that follows them would be rewarded for that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.rigid_objects import RigidObjectsConfig
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.geometry.se3 import relative_twist
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.robust import MEDIAN_OF_NORM
from uni4d_fg.slam.stages.energy import kernel_of
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.rigid_fit import (
    BodyObservations,
    assumed_smoothness,
    data_residuals,
    fit_rigid_body,
    measured_smoothness,
    pose_covariance,
)
from uni4d_fg.slam.stages.rigid_start import RigidBody, moved_points, start_rigid_body
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise

NonRigidSolver = Callable[[Observations], DynamicScene]
"""Solves stage 3 for some observations of moving points."""

_ROUGH_DECREASE = 1e-4
"""Where a fit ends that only tells members from others."""


@dataclass(frozen=True)
class RigidEvidence:
    """Why an instance was, or was not, taken for rigid."""

    is_rigid: bool
    num_tracks: int
    num_members: int
    """Trajectories that the body explains to the noise."""
    sigma_px: float
    """Noise of the members' reprojection that is left, px (robust)."""
    num_held_out: int = 0
    advantage: float = float("nan")
    """Mean over the held-out observations of what the rigid model predicts better, nats; NaN if not tested."""
    standard_error: float = float("nan")
    rigid_error_px: float = float("nan")
    """Median length of the rigid model's prediction errors, px."""
    nonrigid_error_px: float = float("nan")
    """The same of the non-rigid model."""

    @property
    def member_fraction(self) -> float:
        """Part of the trajectories that are members."""
        return self.num_members / max(self.num_tracks, 1)


@dataclass(frozen=True)
class RigidObject:
    """One rigid body and its motion."""

    instance: int
    world_T_object: FloatArray
    """(T, 4, 4); NaN before the first and after the last frame that observes the object."""
    observed: BoolArray
    """(T,) frames that see enough of its tracks; the poses in between hang on smoothness alone."""
    reference: int
    """Frame whose pose is the gauge: its origin is the middle of the points seen there, its axes are the world's."""
    points: FloatArray
    """(N, 3) in the object's frame, m."""
    track: IntArray
    """(N,) labelled tracks."""
    covariance: FloatArray
    """(T, 6, 6) of the body-frame twist (rad, m), relative to the reference frame and for cameras taken as exact, whose
    own errors come on top; NaN where there is no pose."""
    velocity: FloatArray
    """(T, 6) body-frame twist (rad/s, m/s); NaN where there is no pose."""
    evidence: RigidEvidence
    solve: SolveSummary
    """Of the last fit."""


@dataclass(frozen=True)
class _Fit:
    """A body over a part of the video."""

    body: RigidBody
    data: BodyObservations
    assumed: FloatArray
    """(6,) smoothness as the non-rigid model has it."""
    solve: SolveSummary

    @property
    def first(self) -> int:
        """First frame of the part."""
        return self.data.first

    @property
    def last(self) -> int:
        """Last frame of the part."""
        return self.data.first + len(self.body.world_T_object) - 1


def find_rigid_objects(
    motion: DynamicScene,
    observations: Observations,
    visible: Observations,
    cameras: Cameras,
    noise: StaticNoise,
    timestamps: FloatArray,
    smoothness_sigma_m: float,
    config: RigidObjectsConfig,
    solve_nonrigid: NonRigidSolver,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> tuple[list[RigidObject], dict[int, RigidEvidence]]:
    """Find the rigid ones among the moving instances.

    Args:
        motion: The trajectories of stage 3.
        observations: What stage 3 saw; the depth cue with all corrections.
        visible: Every visible observation of moving tracks, also those that the masks contradict
            (:func:`visible_observations`): a body that is known to be rigid tells itself which are its own.
        cameras: Frozen cameras.
        noise: Sigmas measured on the static scene.
        timestamps: (T,) seconds.
        smoothness_sigma_m: Sigma of a point's acceleration, m per frame^2.
        config: Settings.
        solve_nonrigid: Stage 3, for the comparison; called once, and only if some instance may be rigid.
        hooks: Progress and cancellation of every fit.
        run: What solves the declared stages.

    Returns:
        The rigid objects, and the evidence for every instance with enough tracks, by id.

    Raises:
        SolverError: If a fit's system is singular or a cue is not finite.
    """
    search = _Search(motion, cameras, noise, timestamps, smoothness_sigma_m, config, hooks, run)
    observations = observations.select(np.isin(observations.track, motion.track))
    evidence: dict[int, RigidEvidence] = {}
    fits: dict[int, _Fit] = {}
    for instance in np.unique(motion.instance).tolist():
        chosen = np.flatnonzero(motion.instance == instance)
        if len(chosen) < config.min_tracks:
            continue
        fit = search.fit(instance, chosen, observations)
        members = 0 if fit is None else len(fit.data.track)
        sigma = float("nan") if fit is None else _noise(fit)
        evidence[instance] = RigidEvidence(False, len(chosen), members, sigma)
        if fit is not None and evidence[instance].member_fraction >= config.min_member_fraction:
            fits[instance] = fit
    if fits:
        held_out = choose_held_out(observations, config)
        free = solve_nonrigid(observations.select(~held_out))
        for instance, fit in fits.items():
            chosen = np.flatnonzero((motion.instance == instance) & np.isin(motion.track, fit.data.track))
            known = search.fit(instance, chosen, observations.select(~held_out))
            evidence[instance] = search.compare(evidence[instance], known, free, observations.select(held_out))
    found = []
    for instance, fit in fits.items():
        if evidence[instance].is_rigid:
            found.append(search.finish(search.with_own(fit, visible), evidence[instance]))
    return found, evidence


def visible_observations(labelled: LabelledTracks) -> Observations:
    """Return every visible observation of moving tracks, all with weight 1 and, as masks are not asked, no depth."""
    moving = labelled.label == int(TrackLabel.DYNAMIC)
    track, frame = np.nonzero(labelled.tracks.visible & moving[:, None])
    uv = labelled.tracks.uv[track, frame].astype(np.float64)
    return Observations(track, frame, uv, np.full(len(track), np.nan), np.ones(len(track)))


def choose_held_out(observations: Observations, config: RigidObjectsConfig) -> BoolArray:
    """Return which observations (N,) are hidden: some of each track, but neither its first nor its last."""
    change = np.diff(observations.track) != 0
    inner = np.ones(len(observations), dtype=bool)
    inner[1:] &= ~change
    inner[:-1] &= ~change
    inner[[0, -1]] = False
    chance = np.random.default_rng(config.seed).random(len(observations))
    return np.asarray(inner & (chance < config.held_out_fraction))


@dataclass(frozen=True)
class _Search:
    """What the fits of one search share; fields as the arguments of :func:`find_rigid_objects`."""

    motion: DynamicScene
    cameras: Cameras
    noise: StaticNoise
    timestamps: FloatArray
    smoothness_sigma_m: float
    config: RigidObjectsConfig
    hooks: Hooks | None
    run: StageRunner

    def fit(self, instance: int, chosen: IntArray, observations: Observations) -> _Fit | None:
        """Fit one body to some trajectories; those that it does not explain are left out, and it is fitted again."""
        motion, config = self.motion, self.config
        mine = observations.select(np.isin(observations.track, motion.track[chosen]))
        if len(mine) == 0:
            return None
        first, last = int(mine.frame.min()), int(mine.frame.max())
        part = slice(first, last + 1)
        observed = np.zeros(motion.observed[chosen].shape, dtype=bool)
        trajectory = _rows(motion.track[chosen], mine.track)
        observed[trajectory, mine.frame] = True
        body = start_rigid_body(motion.points[chosen][:, part], observed[:, part], config.min_tracks_per_frame)
        if body is None:
            return None
        cameras = replace(
            self.cameras, world_T_cam=self.cameras.world_T_cam[part], log_scale=self.cameras.log_scale[part]
        )
        assumed = assumed_smoothness(body, self.smoothness_sigma_m)
        seen = replace(mine, frame=mine.frame - first)
        data = BodyObservations(instance, motion.track[chosen], first, seen, trajectory, cameras, self.noise, assumed)
        solver = config.solver
        roughly = solver.model_copy(update={"relative_decrease": max(_ROUGH_DECREASE, solver.relative_decrease)})
        body, solve = self._solve(body, data, config.model_copy(update={"solver": roughly}))
        keep = np.flatnonzero(_is_member(body, data, config))
        if len(keep) < config.min_tracks:
            return None
        data, body = data.select(keep), replace(body, points=body.points[keep])
        if len(keep) < len(chosen):
            body, solve = self._solve(body, data, config)
        data = replace(data, smoothness=measured_smoothness(body, data, assumed, config))
        body, solve = self._solve(body, data, config)
        return _Fit(body, data, assumed, solve)

    def _solve(
        self, body: RigidBody, data: BodyObservations, config: RigidObjectsConfig
    ) -> tuple[RigidBody, SolveSummary]:
        return fit_rigid_body(body, data, config, self.hooks, self.run)

    def with_own(self, fit: _Fit, visible: Observations) -> _Fit:
        """Return the fit with the observations that were not trusted but lie where the body says.

        Masks are least sure at an object's outline, where an observation says most about how the object is turned.
        """
        config, track = self.config, fit.data.track
        here = np.isin(visible.track, track) & (visible.frame >= fit.first) & (visible.frame <= fit.last)
        others = visible.select(here)
        others = replace(others, frame=others.frame - fit.first)
        row = _rows(track, others.track)
        known = np.zeros((len(track), fit.last - fit.first + 1), dtype=bool)
        known[fit.data.row, fit.data.seen.frame] = True
        new = ~known[row, others.frame]
        more = replace(fit.data, seen=others.select(new), row=row[new])
        pixel, _ = data_residuals(fit.body, more)
        limit = config.member_sigmas * self.noise.reprojection_sigma_px
        data = fit.data.joined(more, np.asarray(np.linalg.norm(pixel, axis=1) <= limit))
        data = replace(data, smoothness=measured_smoothness(fit.body, data, fit.assumed, config))
        body, solve = self._solve(fit.body, data, config)
        return replace(fit, body=body, data=data, solve=solve)

    def compare(
        self, before: RigidEvidence, fit: _Fit | None, free: DynamicScene, hidden: Observations
    ) -> RigidEvidence:
        """Let both models predict what is hidden."""
        if fit is None:
            return before
        both = np.isin(hidden.track, fit.data.track) & np.isin(hidden.track, free.track)
        hidden = hidden.select(both & (hidden.frame >= fit.first) & (hidden.frame <= fit.last))
        rigid = moved_points(fit.body, hidden.frame - fit.first, _rows(fit.data.track, hidden.track))
        points = free.points[_rows(free.track, hidden.track), hidden.frame]
        finite = np.asarray(np.isfinite(rigid).all(axis=1) & np.isfinite(points).all(axis=1))
        hidden = hidden.select(finite)
        kernel, sigma = kernel_of(self.config.kernel), self.noise.reprojection_sigma_px
        errors = [_errors(p[finite], hidden, self.cameras) for p in (points, rigid)]
        cost = [kernel.rho((error / sigma) ** 2) for error in errors]
        mean, spread = clustered_mean(hidden.weight * (cost[0] - cost[1]), (hidden.track, hidden.frame))
        return replace(
            before,
            is_rigid=bool(mean > self.config.min_advantage_sigmas * spread),
            num_held_out=len(hidden),
            advantage=mean,
            standard_error=spread,
            rigid_error_px=float(np.median(errors[1])) if len(hidden) else float("nan"),
            nonrigid_error_px=float(np.median(errors[0])) if len(hidden) else float("nan"),
        )

    def finish(self, fit: _Fit, evidence: RigidEvidence) -> RigidObject:
        """Bring a fit to the whole video."""
        body, data, num_frames = fit.body, fit.data, len(self.timestamps)
        part = slice(fit.first, fit.last + 1)
        poses = np.full((num_frames, 4, 4), np.nan)
        covariance, velocity = np.full((num_frames, 6, 6), np.nan), np.full((num_frames, 6), np.nan)
        poses[part] = body.world_T_object
        covariance[part] = pose_covariance(body, data, self.config)
        velocity[part] = body_velocity(body.world_T_object, self.timestamps[part])
        seen = np.bincount(data.seen.frame + fit.first, minlength=num_frames)
        return RigidObject(
            data.instance, poses, np.asarray(seen >= self.config.min_tracks_per_frame), body.reference + fit.first,
            body.points, data.track, covariance, velocity, evidence, fit.solve,
        )  # fmt: skip


def _is_member(body: RigidBody, data: BodyObservations, config: RigidObjectsConfig) -> BoolArray:
    """Return (M,) whether the median reprojection error of each trajectory is within the noise."""
    pixel, _ = data_residuals(body, data)
    error = np.linalg.norm(pixel, axis=1) / data.noise.reprojection_sigma_px
    median = np.array([np.median(error[data.row == row]) for row in range(len(data.track))])
    return np.asarray(median <= config.member_sigmas)


def _noise(fit: _Fit) -> float:
    pixel, _ = data_residuals(fit.body, fit.data)
    return float(np.median(np.linalg.norm(pixel, axis=1))) / MEDIAN_OF_NORM


def _rows(names: IntArray, wanted: IntArray) -> IntArray:
    """Return where each of ``wanted`` stands in ``names``, which need not be sorted."""
    order = np.argsort(names)
    result: IntArray = order[np.searchsorted(names[order], wanted)]
    return result


def _errors(points: FloatArray, hidden: Observations, cameras: Cameras) -> FloatArray:
    x = world_to_camera(cameras.world_T_cam[hidden.frame], points)
    uv = project(np.broadcast_to(cameras.intrinsics, (len(x), 4)), x)
    result: FloatArray = np.linalg.norm(hidden.uv - uv, axis=1)
    return result


def clustered_mean(values: FloatArray, groupings: tuple[IntArray, ...]) -> tuple[float, float]:
    """Return the mean of values (N,) and its standard error, the largest over several groupings (N,).

    Values of one group may be alike in any way (Liang and Zeger 1986). NaN with fewer than two groups.
    """
    if len(values) == 0:
        return float("nan"), float("nan")
    mean, spread = float(values.mean()), 0.0
    for grouping in groupings:
        _, group = np.unique(grouping, return_inverse=True)
        count = int(group.max()) + 1
        if count < 2:
            return mean, float("nan")
        sums = np.bincount(group, values - mean)
        spread = max(spread, float(np.sqrt(count / (count - 1) * np.sum(sums**2))) / len(values))
    return mean, spread


def body_velocity(world_T_object: FloatArray, timestamps: FloatArray) -> FloatArray:
    """Return body-frame twists (T, 6), rad/s and m/s, by central differences of poses (T, 4, 4); one-sided at ends."""
    index = np.arange(len(timestamps))
    before, after = np.maximum(index - 1, 0), np.minimum(index + 1, len(index) - 1)
    seconds = timestamps[after] - timestamps[before]
    twist = relative_twist(world_T_object[before], world_T_object[after])
    result: FloatArray = twist / np.where(seconds > 0, seconds, 1.0)[:, None]
    return result
