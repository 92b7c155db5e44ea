"""GPS positions of an antenna on the camera, on a map whose place in the world is a variable."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.factors.gps_position import gps_position
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import GPS_MAP, POSE
from uni4d_fg.frontend.measurements.gps import GpsPositions
from uni4d_fg.geometry.alignment import align_points
from uni4d_fg.geometry.camera import camera_to_world
from uni4d_fg.optim.added_factors import Addition
from uni4d_fg.optim.stage import Stage

_LOOSE = np.repeat([3.0, 1e4], 3)
"""Sigmas (rad, m) about the map's start: they hold what positions leave open, as the turn about a straight path."""


@dataclass(frozen=True)
class GpsSource:
    """Ties the cameras to GPS positions.

    The map starts where it fits the present cameras best (least squares, with the scale held at 1: GPS is metric). It
    joins once the positions of the solve's frames are spread far enough to tell how it lies, and stays out of windows,
    each of which has a world of its own, until these are joined.
    """

    positions: GpsPositions
    lever_arm: FloatArray
    """(3,) m, the antenna in the camera's axes."""
    kernel: KernelConfig
    min_spread: float
    """Root mean square distance of the positions from their mean, in sigmas, at which it joins."""
    fingerprint: str = ""

    @classmethod
    def of(cls, positions: GpsPositions, config: MeasurementsConfig, fingerprint: str = "") -> GpsSource:
        """Make it as a configuration says."""
        arm = np.array(config.gps_lever_arm_m, dtype=np.float64)
        return cls(positions, arm, config.gps_kernel, config.gps_min_spread, fingerprint)

    @property
    def is_of_use(self) -> bool:
        """Whether all positions together are spread far enough."""
        return self._tells(np.arange(len(self.positions.frame)))

    def _tells(self, entry: IntArray) -> bool:
        """Return whether some of the positions are spread far enough."""
        if len(entry) < 2:
            return False
        xyz, sigma = self.positions.xyz[entry], self.positions.sigma[entry]
        spread = np.sqrt(((xyz - xyz.mean(axis=0)) ** 2).sum(axis=1).mean())
        return bool(spread >= self.min_spread * np.median(sigma))

    def __call__(self, stage: Stage, state: State) -> Addition | None:
        """Join bundle adjustment in the video's world; None elsewhere."""
        if not stage.finds_cameras or stage.own_world:
            return None
        known = self.positions
        if not self.is_of_use:
            return None
        _, row, entry = np.intersect1d(state.numbers(POSE)[:, 0], known.frame, return_indices=True)
        if not self._tells(entry):  # it will later in the stream: until then nothing else shall settle the scale
            return Addition([])
        xyz, sigma = known.xyz[entry], known.sigma[entry]
        arms = np.broadcast_to(self.lever_arm, (len(row), 3))
        found = align_points(camera_to_world(state[POSE][row], arms), xyz, with_scale=False)
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = found.rotation, found.translation
        kernel = Kernel(self.kernel.kind, self.kernel.threshold)
        loose = gtsam.noiseModel.Diagonal.Sigmas(_LOOSE)
        factors = [
            gps_position(0, row, xyz=xyz, lever_arm=arms, sigma=sigma, kernel=kernel),
            gtsam.PriorFactorPose3(GPS_MAP.key(0), gtsam.Pose3(start), loose),
        ]
        return Addition(factors, {GPS_MAP: start[None]})
