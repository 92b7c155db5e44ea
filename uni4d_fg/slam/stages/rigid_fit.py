r"""The MAP estimate of one rigid body: a pose per frame and a point per trajectory, cameras frozen.

    E = sum rho(|r_reprojection| / sigma) + sum rho(|r_depth| / sigma_D) + sum rho(|r_smooth / sigma_s|)

The pose of the reference frame is held, which fixes the object's frame, and points are eliminated. The errors of a
depth cue vary smoothly over the image, and an object is small in it: all its depths in one frame count as one, so that
a tilt of the cue is not taken for one of the object. How smooth the motion is, sigma_s, is measured on the motion
itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.rigid_objects import RigidObjectsConfig
from uni4d_fg.factors.rigid_object import rigid_depth_prior, rigid_reprojection, rigid_smoothness
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import OBJECT_POINT, OBJECT_POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.marginals import camera_marginals, reduced_hessian
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.energy import kernel_of
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.rigid_start import RigidBody
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise


@dataclass(frozen=True)
class BodyObservations:
    """What is known of one body."""

    instance: int
    track: IntArray
    """(M,) labelled track of each of the body's points."""
    first: int
    """Frame of the video that is the body's frame 0."""
    seen: Observations
    """N observations; frames are the body's."""
    row: IntArray
    """(N,) row of the body's points of each observation."""
    cameras: Cameras
    """Of the body's frames."""
    noise: StaticNoise
    smoothness: FloatArray
    """(6,) sigmas of the change of the twist from frame to frame, rad and m."""

    def depth_sigma(self) -> FloatArray:
        """Return (N,) sigmas with which all depths of a frame count as one."""
        frame = self.seen.frame
        alike = np.maximum(np.bincount(frame, np.isfinite(self.seen.depth))[frame], 1.0)
        result: FloatArray = self.noise.depth_sigma * np.sqrt(alike)
        return result

    def select(self, rows: IntArray) -> BodyObservations:
        """Return the observations of some of the points, renumbered in the given order."""
        number = np.full(len(self.track), -1)
        number[rows] = np.arange(len(rows))
        keep = number[self.row] >= 0
        return replace(self, track=self.track[rows], seen=self.seen.select(keep), row=number[self.row[keep]])

    def joined(self, more: BodyObservations, keep: BoolArray) -> BodyObservations:
        """Return these observations and some of the others (``keep``), in no order."""
        extra, row = more.seen.select(keep), more.row[keep]
        seen = Observations(
            *(
                np.concatenate([getattr(part, name) for part in (self.seen, extra)])
                for name in ("track", "frame", "uv", "depth", "weight")
            )
        )
        return replace(self, seen=seen, row=np.concatenate([self.row, row]))


def body_state(body: RigidBody, data: BodyObservations) -> State:
    """Return the variables of a body under the keys of its instance, frames and tracks."""
    frames = data.first + np.arange(len(body.world_T_object))
    pose_index = np.stack([np.full(len(frames), data.instance), frames], axis=1)
    return State(
        {OBJECT_POSE: body.world_T_object, OBJECT_POINT: body.points},
        {OBJECT_POSE: pose_index, OBJECT_POINT: data.track},
    )


def rigid_body_problem(
    state: State, data: BodyObservations, reference: int, config: RigidObjectsConfig, *, smooth: bool = True
) -> Problem:
    """Put the fit of one body together.

    Args:
        state: Its poses and points.
        data: Observations of its points, each in a frame of the body.
        reference: Frame of the body whose pose is held.
        config: Kernel.
        smooth: Whether to add the smoothness of the motion.
    """
    problem = Problem.over(state).fix(OBJECT_POSE, rows=[reference]).eliminate(OBJECT_POINT)
    kernel, seen, cameras = kernel_of(config.kernel), data.seen, data.cameras
    pose = cameras.world_T_cam[seen.frame]
    problem.add(
        rigid_reprojection(
            seen.frame,
            data.row,
            uv=seen.uv,
            world_T_cam=pose,
            intrinsics=np.broadcast_to(cameras.intrinsics, (len(seen), 4)),
            sigma=data.noise.reprojection_sigma_px,
            weight=seen.weight,
            kernel=kernel,
        )
    )
    known = np.isfinite(seen.depth)
    if known.any():
        frame = seen.frame[known]
        problem.add(
            rigid_depth_prior(
                frame,
                data.row[known],
                depth=seen.depth[known],
                world_T_cam=pose[known],
                log_scale=cameras.log_scale[frame],
                sigma=data.depth_sigma()[known],
                weight=seen.weight[known],
                kernel=kernel,
            )
        )
    count = len(state[OBJECT_POSE]) - 2
    if smooth and count > 0:
        step = np.arange(count)
        sigma = np.broadcast_to(data.smoothness, (count, 6))
        problem.add(rigid_smoothness(step, step + 1, step + 2, sigma=sigma, kernel=kernel))
    return problem


def data_residuals(body: RigidBody, data: BodyObservations) -> tuple[FloatArray, FloatArray]:
    """Return the raw residuals of every observation: reprojection (N, 2), px, and log depth (N,), NaN without cue."""
    frame, cameras = data.seen.frame, data.cameras
    pose, point, camera = body.world_T_object[frame], body.points[data.row], cameras.world_T_cam[frame]
    intrinsics = np.broadcast_to(cameras.intrinsics, (len(frame), 4))
    pixel = rigid_reprojection.residual(pose, point, uv=data.seen.uv, world_T_cam=camera, intrinsics=intrinsics)
    depth = rigid_depth_prior.residual(
        pose, point, depth=data.seen.depth, world_T_cam=camera, log_scale=cameras.log_scale[frame]
    )
    return np.asarray(pixel), np.asarray(depth)[:, 0]


def assumed_smoothness(body: RigidBody, point_sigma_m: float) -> FloatArray:
    """Return (6,) sigmas of the change of the body's twist such that its points have the given acceleration."""
    centered = body.points - np.median(body.points, axis=0)
    radius = max(float(np.sqrt(np.median(np.sum(centered**2, axis=1)))), point_sigma_m)
    return np.repeat([point_sigma_m / radius, point_sigma_m], 3)


def fit_rigid_body(
    body: RigidBody,
    data: BodyObservations,
    config: RigidObjectsConfig,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> tuple[RigidBody, SolveSummary]:
    """Minimize the energy.

    Args:
        body: Start.
        data: Observations of its points, each in a frame of the body.
        config: Kernel and solver.
        hooks: Progress and cancellation.
        run: What solves the declared stage.

    Raises:
        SolverError: If the system is singular or a cue is not finite.
    """
    state = body_state(body, data)
    problem = rigid_body_problem(state, data, body.reference, config)
    stage = Stage("rigid_object", problem, config.solver, part=f"instance {data.instance}")
    state, summary = run(stage, state, hooks)
    poses = se3.orthonormalize(state[OBJECT_POSE])
    return replace(body, world_T_object=poses, points=state[OBJECT_POINT]), summary


def pose_covariance(body: RigidBody, data: BodyObservations, config: RigidObjectsConfig) -> FloatArray:
    """Return (T, 6, 6) marginal covariances of the poses' body-frame twists (rad, m), relative to the reference frame.

    Those of :mod:`uni4d_fg.optim.marginals`, times the variance that the residuals have where it is more than assumed.
    NaN where the observations do not determine the poses.
    """
    state, num_frames = body_state(body, data), len(body.world_T_object)
    problem = rigid_body_problem(state, data, body.reference, config)
    marginals = camera_marginals(problem, state, config.solver, OBJECT_POINT)
    if marginals is None:
        out = np.full((num_frames, 6, 6), np.nan)
        out[body.reference] = 0.0
        return out
    pixel, _ = data_residuals(body, data)
    excess = max(robust_sigma(pixel) / data.noise.reprojection_sigma_px, 1.0) ** 2
    return excess * marginals.blocks(OBJECT_POSE, num_frames)


def measured_smoothness(
    body: RigidBody, data: BodyObservations, assumed: FloatArray, config: RigidObjectsConfig
) -> FloatArray:
    """Return (6,) sigmas of the change of the twist as the body's own motion shows them.

    The two sigmas, of rotation and of translation, that make the observations most likely: type II maximum likelihood
    (MacKay 1992) in the problem linearized at the fit. With H the reduced Hessian of the data, r the n changes, J their
    Jacobian and W the inverse variances, the negative logarithm of the likelihood is, up to a constant,

        min over d of  (d^T H d / 2 + g^T d + |r + J d|^2_W / 2)  +  log det (H + J^T W J) / 2  -  log det W / 2

    The assumed sigmas count as much as ``smoothness_prior_frames`` frames would.

    Args:
        body: Converged fit.
        data: Its observations.
        assumed: (6,) sigmas that count in, and the result where there is nothing to measure.
        config: Kernel, and the weight of the assumed sigmas.
    """
    poses = body.world_T_object
    if len(poses) < 3:
        return assumed
    state = body_state(body, data)
    problem = rigid_body_problem(state, data, body.reference, config, smooth=False)
    reduced = reduced_hessian(problem, state, config.solver, OBJECT_POINT)
    if reduced is None:
        return assumed
    layout, hessian, gradient = reduced
    free = np.setdiff1d(np.arange(len(poses)), [body.reference])
    columns = layout.columns(OBJECT_POSE, free).reshape(-1)
    hessian, gradient = hessian[np.ix_(columns, columns)], gradient[columns]
    r, jacobians = rigid_smoothness.linearize(poses[:-2], poses[1:-1], poses[2:])
    every = np.zeros((len(r), 6, len(poses), 6))
    for i, jacobian in enumerate(jacobians):
        every[np.arange(len(r)), :, np.arange(len(r)) + i] = jacobian
    by_pose, changes = every[:, :, free].reshape(6 * len(r), -1), r.reshape(-1)
    weight = kernel_of(config.kernel).weight(np.sum((r / data.smoothness) ** 2, axis=1))
    count, prior = 3.0 * weight.sum(), 3.0 * config.smoothness_prior_frames

    def cost(log_sigma: FloatArray) -> float:
        variance = np.exp(2.0 * log_sigma)
        inverse = (weight[:, None] / np.repeat(variance, 3)).reshape(-1)
        try:
            lower = np.linalg.cholesky(hessian + (by_pose.T * inverse) @ by_pose)
        except np.linalg.LinAlgError:
            return float("inf")
        pull = scipy.linalg.solve_triangular(lower, gradient + by_pose.T @ (inverse * changes), lower=True)
        quadratic = 0.5 * float(np.sum(inverse * changes**2) - pull @ pull)
        spread = float(np.sum(np.log(np.diag(lower)))) + count * float(log_sigma.sum())
        assumption = prior * float(np.sum(log_sigma + 0.5 * assumed[[0, 3]] ** 2 / variance))
        return float(quadratic + spread + assumption)

    from scipy.optimize import minimize  # takes a tenth of a second to load, which most runs need not wait for

    found = minimize(cost, np.log(data.smoothness[[0, 3]]), method="Nelder-Mead", tol=1e-2)
    return np.repeat(np.exp(found.x), 3)
