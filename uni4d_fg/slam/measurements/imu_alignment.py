r"""Visual-inertial alignment: from cameras of unknown scale to metric ones with gravity, velocities and biases.

1. *Gyroscope bias*: b_g minimizes ``|Log(dR(b_g)^T R_i^T R_j)|^2`` over successive frames that see each other.
2. *Orientation*: parts of the video that no track joins (before and after a blackout) are turned to each other, and
   frames that see nothing are posed, by the gyroscope.
3. *Scale, gravity, velocities, accelerometer bias* together, with the visual camera centers c_t as measurements:

       p_t - s c_t - o_part                                          = 0      visual, sigma of a camera's position
       p_j - p_i - v_i dt - g dt^2 / 2 - R_i (alpha + J_alpha b_a)   = 0      preintegrated position
       v_j - v_i - g dt - R_i (beta + J_beta b_a)                    = 0      preintegrated velocity
       b_a = 0,   g^T g_0 / |g_0| = magnitude                                 priors

   Linear least squares in all unknowns (p, v, g, s, b_a, o), repeated with g_0 the last gravity, which gives it its
   magnitude; the sigma of camera positions is then measured on the residuals.

With the camera's positions as unknowns the noise of successive displacements is correlated as it is. Over Qin et al.
2018 ("VINS-Mono", section V-B), from which the steps are taken, this adds the accelerometer's bias and the weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.imu import ImuConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.geometry import se3
from uni4d_fg.slam.measurements.imu_preintegration import preintegrate

_GYROSCOPE_ROUNDS, _GRAVITY_ROUNDS = 3, 4
_DIFFERENCE = 1e-3
"""Step of the differences by a bias: the sums are linear in the accelerometer's and nearly so in the gyroscope's."""
_MIN_POSITION_SIGMA, _MIN_VELOCITY_SIGMA = 1e-4, 5e-4
"""Floors (m, m/s) of the preintegrated noise, which keep the normal equations well-conditioned."""


@dataclass(frozen=True)
class VisualInertialAlignment:
    """What aligns a visual reconstruction with inertial measurements."""

    scale: float
    """Meters per unit of the visual reconstruction."""
    scale_sigma: float
    """Its relative standard deviation."""
    gravity: FloatArray
    """(3,) m/s^2, world axes; the world is the first camera."""
    world_T_cam: FloatArray
    """(T, 4, 4) metric poses of all frames, those that see nothing included."""
    velocity: FloatArray
    """(T, 3) m/s, world axes."""
    bias: FloatArray
    """(6,) accelerometer [m/s^2] and gyroscope [rad/s], camera axes."""


def visible_parts(track: IntArray, frame: IntArray, num_frames: int, min_shared: int) -> IntArray:
    """Return which part of the video each frame belongs to, (T,): frames that shared tracks join.

    Args:
        track: (N,) of each observation.
        frame: (N,) of each observation.
        num_frames: T.
        min_shared: Two frames with fewer common tracks are not joined.

    Returns:
        Numbers from 0 on, in the order of the first frames; -1 for frames that share too few with any other.
    """
    seen = sp.csr_matrix((np.ones(len(track)), (track, frame)), shape=(int(track.max(initial=0)) + 1, num_frames))
    shared = (seen.T @ seen).toarray() >= min_shared
    np.fill_diagonal(shared, False)
    _, part = connected_components(shared, directed=False)
    alone = ~shared.any(axis=1)
    out = np.full(num_frames, -1, dtype=np.int64)
    _, first, number = np.unique(part[~alone], return_index=True, return_inverse=True)
    out[~alone] = np.argsort(np.argsort(first))[number]
    return out


def align_with_imu(
    world_T_cam: FloatArray, part: IntArray, frame_times: FloatArray, samples: ImuSamples, config: ImuConfig
) -> VisualInertialAlignment:
    """Find scale, gravity, velocities and biases, and join the parts of a visual reconstruction.

    Args:
        world_T_cam: (T, 4, 4) of the visual reconstruction, at any scale; parts may stand anywhere.
        part: (T,) from :func:`visible_parts`.
        frame_times: (T,) s.
        samples: Of the IMU, covering the frames.
        config: Priors.

    Raises:
        DegenerateProblemError: If the motion does not determine the scale.
    """
    if (part >= 0).sum() < 4:
        raise DegenerateProblemError("IMU: fewer than four frames share tracks; there is nothing to align it with")
    rotated = samples.at_camera()
    gyroscope_bias = _gyroscope_bias(world_T_cam, part, frame_times, rotated, config)
    moved = samples.at_camera(samples.body_T_cam[:3, :3] @ gyroscope_bias)
    sums = _Sums.of(moved, frame_times, np.concatenate([np.zeros(3), gyroscope_bias]), config)
    rotation, turn = _orientation(world_T_cam, part, sums.rotation)
    centers = np.einsum("nij,nj->ni", turn, world_T_cam[:, :3, 3] - world_T_cam[0, :3, 3])
    system = _System(rotation, centers, part, sums, config)
    found = system.solve(config.camera_position_sigma_m)
    found = system.solve(max(system.position_noise(found), _MIN_POSITION_SIGMA))
    scale, sigma = found.scale, found.scale_sigma
    if not (scale > 0.0 and sigma <= config.max_scale_sigma * scale):  # NaN too
        raise DegenerateProblemError(
            f"IMU: the scale comes out as {scale:.3g} +- {sigma:.2g}: accelerations of the camera and of the IMU do "
            "not agree, or there is too little of them. Check the units, axes and clock of the IMU (body_T_cam, "
            "time_offset), move the camera more, or raise imu.max_scale_sigma"
        )
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = world_T_cam[0, :3, 3] + found.position - found.position[0]
    bias = np.concatenate([found.accelerometer_bias, gyroscope_bias])
    return VisualInertialAlignment(scale, sigma / scale, found.gravity, poses, found.velocity, bias)


@dataclass(frozen=True)
class _Sums:
    """Preintegrated measurements of the T - 1 intervals, as arrays; positions and velocities in the first camera."""

    duration: FloatArray
    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    position_by_bias: FloatArray
    """(T - 1, 3, 3) derivative by the accelerometer's bias."""
    velocity_by_bias: FloatArray
    covariance: FloatArray
    """(T - 1, 6, 6) of position and velocity."""

    @classmethod
    def of(cls, samples: ImuSamples, frame_times: FloatArray, bias: FloatArray, config: ImuConfig) -> _Sums:
        sums = preintegrate(samples, frame_times, bias, config)
        position, velocity = np.array([s.deltaPij() for s in sums]), np.array([s.deltaVij() for s in sums])
        by_bias = np.zeros((2, len(sums), 3, 3))
        for axis in range(3):
            moved = preintegrate(samples, frame_times, bias + _DIFFERENCE * np.eye(6)[axis], config)
            by_bias[0, :, :, axis] = (np.array([s.deltaPij() for s in moved]) - position) / _DIFFERENCE
            by_bias[1, :, :, axis] = (np.array([s.deltaVij() for s in moved]) - velocity) / _DIFFERENCE
        floor = np.diag(np.repeat([_MIN_POSITION_SIGMA**2, _MIN_VELOCITY_SIGMA**2], 3))
        return cls(
            np.diff(frame_times),
            np.array([s.deltaRij().matrix() for s in sums]),
            position,
            velocity,
            by_bias[0],
            by_bias[1],
            np.array([s.preintMeasCov()[3:9, 3:9] for s in sums]) + floor,
        )


def _gyroscope_bias(
    world_T_cam: FloatArray, part: IntArray, frame_times: FloatArray, samples: ImuSamples, config: ImuConfig
) -> FloatArray:
    """Return the (3,) bias, camera axes, that makes the gyroscope turn as the cameras do."""
    both = np.flatnonzero((part[1:] == part[:-1]) & (part[1:] >= 0))
    rotation = world_T_cam[:, :3, :3]
    seen = np.swapaxes(rotation[both], 1, 2) @ rotation[both + 1]

    def errors(bias: FloatArray) -> FloatArray:
        sums = preintegrate(samples, frame_times, np.concatenate([np.zeros(3), bias]), config)
        turned = np.array([s.deltaRij().matrix() for s in sums]).reshape(-1, 3, 3)[both]
        return se3.so3_log(np.swapaxes(turned, 1, 2) @ seen).ravel()

    bias = np.zeros(3)
    for _ in range(_GYROSCOPE_ROUNDS if len(both) else 0):
        r = errors(bias)
        jacobian = np.stack([(errors(bias + _DIFFERENCE * e) - r) / _DIFFERENCE for e in np.eye(3)], axis=1)
        bias = bias - np.linalg.lstsq(jacobian, r, rcond=None)[0]
    return bias


def _orientation(world_T_cam: FloatArray, part: IntArray, turned: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotations of all frames in one world, and what turned the part of each into it, both (T, 3, 3)."""
    visual = world_T_cam[:, :3, :3]
    rotation, turn = visual.copy(), np.tile(np.eye(3), (len(visual), 1, 1))
    known: dict[int, FloatArray] = {int(part[0]): np.eye(3)} if part[0] >= 0 else {}
    for t in range(1, len(visual)):
        predicted = rotation[t - 1] @ turned[t - 1]
        number = int(part[t])
        if number < 0:
            rotation[t] = predicted
            continue
        turn[t] = known.setdefault(number, predicted @ visual[t].T)
        rotation[t] = turn[t] @ visual[t]
    return rotation, turn


@dataclass(frozen=True)
class _Solution:
    position: FloatArray
    velocity: FloatArray
    gravity: FloatArray
    scale: float
    scale_sigma: float
    """Absolute."""
    accelerometer_bias: FloatArray
    offset: FloatArray
    """(P, 3) of each part; zero for the first."""


class _System:
    """The linear least squares of step 3."""

    def __init__(self, rotation: FloatArray, centers: FloatArray, part: IntArray, sums: _Sums, config: ImuConfig):
        self.rotation, self.centers, self.part, self.sums, self.config = rotation, centers, part, sums, config
        count = len(rotation)
        self.num_parts = int(part.max()) + 1
        self.first = {"p": 0, "v": 3 * count, "g": 6 * count, "s": 6 * count + 3, "b": 6 * count + 4}
        self.first["o"] = 6 * count + 7
        self.size = self.first["o"] + 3 * (self.num_parts - 1)
        self.seen = np.flatnonzero(part >= 0)
        self.inertial = self._inertial_rows()
        self.visual = self._visual_rows()

    def solve(self, position_sigma: float) -> _Solution:
        """Solve with a sigma of the visual positions, m."""
        gravity: FloatArray | None = None
        for _ in range(_GRAVITY_ROUNDS):
            matrix, right = self._with_priors(position_sigma, gravity)
            normal = (matrix.T @ matrix).tocsc()
            try:
                factor = splu(normal)
            except RuntimeError:
                raise DegenerateProblemError(
                    "IMU: camera positions and inertial measurements determine no scale: the camera is at rest"
                ) from None
            solution = factor.solve(matrix.T @ right)
            gravity = self._part(solution, "g")
        unit = np.zeros(self.size)
        unit[self.first["s"]] = 1.0
        variance = float(factor.solve(unit)[self.first["s"]])
        count = len(self.rotation)
        return _Solution(
            solution[: 3 * count].reshape(-1, 3),
            solution[3 * count : 6 * count].reshape(-1, 3),
            self._part(solution, "g"),
            float(solution[self.first["s"]]),
            float(np.sqrt(max(variance, 0.0))),
            self._part(solution, "b"),
            np.concatenate([np.zeros((1, 3)), solution[self.first["o"] :].reshape(-1, 3)]),
        )

    def position_noise(self, found: _Solution) -> float:
        """Return the standard deviation of the visual positions about a solution, m."""
        residual = found.position - found.scale * self.centers - found.offset[self.part]
        return float(np.sqrt(np.mean(residual[self.seen] ** 2)))

    def _part(self, solution: FloatArray, name: str) -> FloatArray:
        return np.asarray(solution[self.first[name] : self.first[name] + 3])

    def _visual_rows(self) -> sp.csr_matrix:
        matrix = sp.lil_matrix((3 * len(self.seen), self.size))
        for row, t in enumerate(self.seen.tolist()):
            for axis in range(3):
                matrix[3 * row + axis, 3 * t + axis] = 1.0
                matrix[3 * row + axis, self.first["s"]] = -self.centers[t, axis]
                if self.part[t] > 0:
                    matrix[3 * row + axis, self.first["o"] + 3 * (self.part[t] - 1) + axis] = -1.0
        return matrix.tocsr()

    def _inertial_rows(self) -> tuple[sp.csr_matrix, FloatArray]:
        """Return the whitened rows of positions and velocities, and their right-hand side."""
        sums, first = self.sums, self.first
        matrix = sp.lil_matrix((6 * len(sums.duration), self.size))
        right = np.zeros(matrix.shape[0])
        eye = np.eye(3)
        for i, dt in enumerate(sums.duration.tolist()):
            rotation = self.rotation[i]
            turn = np.kron(np.eye(2), rotation)
            white = np.linalg.inv(np.linalg.cholesky(turn @ sums.covariance[i] @ turn.T))
            zero = np.zeros((3, 3))
            blocks = {
                3 * i: np.vstack([-eye, zero]),
                3 * (i + 1): np.vstack([eye, zero]),
                first["v"] + 3 * i: np.vstack([-dt * eye, -eye]),
                first["v"] + 3 * (i + 1): np.vstack([zero, eye]),
                first["g"]: np.vstack([-0.5 * dt * dt * eye, -dt * eye]),
                first["b"]: -np.vstack([rotation @ sums.position_by_bias[i], rotation @ sums.velocity_by_bias[i]]),
            }
            for column, block in blocks.items():
                matrix[6 * i : 6 * i + 6, column : column + 3] = white @ block
            right[6 * i : 6 * i + 6] = white @ np.concatenate(
                [rotation @ sums.position[i], rotation @ sums.velocity[i]]
            )
        return matrix.tocsr(), right

    def _with_priors(self, position_sigma: float, gravity: FloatArray | None) -> tuple[sp.csr_matrix, FloatArray]:
        priors = sp.lil_matrix((3 + (gravity is not None), self.size))
        for axis in range(3):
            priors[axis, self.first["b"] + axis] = 1.0 / self.config.accelerometer_bias_sigma
        right = np.zeros(priors.shape[0])
        if gravity is not None:
            direction = gravity / np.linalg.norm(gravity)
            priors[3, self.first["g"] : self.first["g"] + 3] = direction / self.config.gravity_sigma
            right[3] = self.config.gravity / self.config.gravity_sigma
        inertial, inertial_right = self.inertial
        matrix = sp.vstack([self.visual / position_sigma, inertial, priors.tocsr()]).tocsr()
        return matrix, np.concatenate([np.zeros(self.visual.shape[0]), inertial_right, right])
