"""A static scene that grows frame by frame: poses by resection, points by triangulation, bundle adjustment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.config.models import Config
from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.cues.structure.first_pair import CommonTracks, FramePair
from uni4d_fg.cues.structure.triangulation import RayBundle, ray_angles, reprojection_errors, sound, triangulate
from uni4d_fg.cues.structure.two_view import relative_pose
from uni4d_fg.errors import Cancelled
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import intrinsics_matrix
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.marginals import camera_marginals
from uni4d_fg.optim.stage import Stage, run_stage, until_converged
from uni4d_fg.optim.summary import Termination
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.bundle_adjustment import (
    Freedom,
    bundle_adjustment_problem,
    without_camera_motion,
    without_depth_prior,
)
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise

_FOCAL_STEP = 0.15
"""Step of log f that cameras and points can follow."""


@dataclass
class GrowingScene:
    """Cameras and points found so far. M tracks, N observations of them, T frames."""

    observations: Observations
    row: IntArray
    """(N,) track row of each observation."""
    num_tracks: int
    intrinsics: FloatArray
    world_T_cam: FloatArray
    """(T, 4, 4)."""
    registered: BoolArray
    """(T,) frames whose pose is known."""
    position: FloatArray
    """(M, 3) NaN where not triangulated."""
    good: BoolArray
    """(N,) observations that agree with their point, of those that have one."""
    config: Config
    free_focal: bool
    prior_intrinsics: FloatArray
    should_stop: Callable[[], bool]
    limit_px: FloatArray
    """(T,) Up to this reprojection error an observation of a frame agrees with its point."""
    left_out: BoolArray
    """(M,) tracks that take no part in bundle adjustment."""
    sigma_px: float | None = None
    """Noise of the tracks, where it was measured; the configured one before."""

    @classmethod
    def empty(
        cls,
        observations: Observations,
        num_frames: int,
        intrinsics: FloatArray,
        config: Config,
        *,
        free_focal: bool,
        prior_intrinsics: FloatArray,
        should_stop: Callable[[], bool],
    ) -> GrowingScene:
        """Return a scene without cameras and points."""
        tracks, row = observations.rows()
        return cls(
            observations, row, len(tracks), intrinsics.copy(), np.tile(np.eye(4), (num_frames, 1, 1)),
            np.zeros(num_frames, dtype=bool), np.full((len(tracks), 3), np.nan),
            np.zeros(len(observations), dtype=bool), config, free_focal, prior_intrinsics, should_stop,
            np.full(num_frames, config.geometric_depth.max_reprojection_px), np.zeros(len(tracks), dtype=bool),
        )  # fmt: skip

    def start(self, pair: FramePair) -> int:
        """Take two frames as the first cameras; return the number of points that they see with enough angle."""
        settings = self.config.geometric_depth
        a, b = CommonTracks(self.observations, len(self.world_T_cam)).between(pair.first, pair.second)
        uv = self.observations.uv
        found = relative_pose(
            uv[a], uv[b], self.intrinsics, 0.5 * settings.max_reprojection_px, settings.two_view_trials,
            settings.min_angle_deg,
        )  # fmt: skip
        if found is None:
            return 0
        self.world_T_cam[pair.second] = found.first_T_second
        self.registered[[pair.first, pair.second]] = True
        new = np.zeros(self.num_tracks, dtype=bool)
        new[self.row[a[found.inlier]]] = True
        self.triangulate(new)
        self._normalize()
        return int(np.isfinite(self.position[:, 0]).sum())

    def next_frame(self, excluded: set[int]) -> int | None:
        """Return the frame without a pose that sees most points; None if none sees enough."""
        seen = np.isfinite(self.position[self.row, 0])
        counts = np.bincount(self.observations.frame[seen], minlength=len(self.registered))
        counts[self.registered] = 0
        counts[list(excluded)] = 0
        best = int(np.argmax(counts))
        return best if counts[best] >= self.config.geometric_depth.min_pose_points else None

    def register(self, frame: int) -> bool:
        """Find a frame's pose from the points it sees (resection with RANSAC), then new points; False if it fails."""
        settings = self.config.geometric_depth
        mine = np.flatnonzero((self.observations.frame == frame) & np.isfinite(self.position[self.row, 0]))
        pose = _resect(self.position[self.row[mine]], self.observations.uv[mine], self.intrinsics, settings)
        if pose is None:
            return False
        self.world_T_cam[frame], self.registered[frame] = pose, True
        missing = ~np.isfinite(self.position[:, 0])
        visible = np.zeros(self.num_tracks, dtype=bool)
        visible[self.row[self.observations.frame == frame]] = True
        self.triangulate(missing & visible, posed=frame)
        return True

    def take_out(self, frames: IntArray) -> None:
        """Take the poses of some frames back, and the points that no others hold."""
        self.registered[frames] = False
        self._judge()

    def seeing(self, observations: Observations, config: Config | None = None) -> GrowingScene:
        """Return a scene of other tracks of the same frames, triangulated with the cameras of this one.

        Args:
            observations: Those of tracks that are seen once are left out.
            config: None takes that of this scene.
        """
        other = GrowingScene.empty(
            observations.with_min_observations(2), len(self.registered), self.intrinsics, config or self.config,
            free_focal=self.free_focal, prior_intrinsics=self.prior_intrinsics, should_stop=self.should_stop,
        )  # fmt: skip
        other.world_T_cam, other.registered = self.world_T_cam.copy(), self.registered.copy()
        other.triangulate_all()
        return other

    def triangulate(self, which: BoolArray, posed: int | None = None) -> None:
        """Triangulate tracks (M,) from the frames that have a pose; what does not fit stays without a point.

        Args:
            which: (M,) tracks.
            posed: The only frame whose pose has changed since all was judged last; None judges all anew.
        """
        settings = self.config.geometric_depth
        used = np.flatnonzero(which[self.row] & self.registered[self.observations.frame])
        rows, local = np.unique(self.row[used], return_inverse=True)
        points = triangulate(self._rays(used, local, len(rows)), settings.triangulation_huber_px)
        fits = sound(points, settings.max_reprojection_px, settings.min_angle_deg)
        self.position[rows] = np.where(fits[:, None], points.position, np.nan)
        self._judge(None if posed is None else np.flatnonzero(which[self.row] | (self.observations.frame == posed)))

    def triangulate_all(self) -> None:
        """Triangulate all tracks anew, those that are left out as well."""
        self.triangulate(np.ones(self.num_tracks, dtype=bool))

    def seen_without_point(self) -> BoolArray:
        """Return which tracks (M,) two cameras or more see that have no point all the same."""
        seen = np.bincount(self.row[self.registered[self.observations.frame]], minlength=self.num_tracks)
        return np.asarray((seen >= 2) & ~np.isfinite(self.position[:, 0]))

    def leave_out(self, tracks: BoolArray, limit_px: FloatArray) -> None:
        """Let tracks (M,) take no part in bundle adjustment, nor what is beyond limits (T,), px; points stay."""
        self.left_out, self.limit_px = tracks, limit_px
        self.good = self._agrees(None)

    def adjust(self, relative_decrease: float | None = None) -> None:
        """Refine all cameras, points and (from three frames on) the focal lengths; then judge all observations.

        Args:
            relative_decrease: Where to stop, see the solver's configuration; None takes that.

        Raises:
            Cancelled: If asked to stop.
            SolverError: If the system cannot be solved.
        """
        stage, state, frames, rows = self.bundle()
        if relative_decrease is not None:
            stage = replace(stage, solver=stage.solver.model_copy(update={"relative_decrease": relative_decrease}))
        self._take(self._solve(stage, state), frames, rows)

    def converge(self) -> None:
        """Refine as :meth:`adjust` does, until the focal lengths stay where they are. Raises as it does.

        Observations that err by more than the noise have less of a say, the less the more they do: near where surfaces
        end they err to one side, which a convex kernel lets bend the focal lengths.
        """
        stage, state, frames, rows = self.bundle(kernel=self.config.geometric_depth.focal_kernel)
        self._take(self._solve(until_converged(stage), state), frames, rows)

    def _solve(self, stage: Stage, state: State) -> State:
        state, summary = run_stage(stage, state, Hooks(should_stop=self.should_stop))
        if summary.termination is Termination.CANCELLED:
            raise Cancelled("structure from motion stopped")
        return state

    def _take(self, state: State, frames: IntArray, rows: IntArray) -> None:
        self.world_T_cam[frames] = se3.orthonormalize(state[POSE])
        self.intrinsics = state[INTRINSICS][0].copy()
        self.position[rows] = state[LANDMARK]
        self._forget_flat()
        self._judge()

    def focal_deviation(self) -> float:
        """Return the marginal standard deviation of the focal lengths, as a part of their value; 0 if held."""
        stage, state, _, _ = self.bundle()
        if not stage.problem.is_free(INTRINSICS):
            return 0.0
        marginals = camera_marginals(stage.problem, state, stage.solver, stage.problem.eliminated)
        if marginals is None:
            return float("nan")
        variance = np.diag(marginals.blocks(INTRINSICS, 1)[0])[:2]
        return float(np.sqrt(np.max(variance / self.intrinsics[:2] ** 2)))

    def hold_focal(self, focal: float) -> None:
        """Take a focal length, px, and refine cameras and points for it, by steps in which they can follow.

        What takes part is as before: on the way nothing agrees with its point.

        Raises:
            Cancelled: If asked to stop.
            SolverError: If the system cannot be solved.
        """
        self.free_focal = False
        ratio = focal / self.mean_focal
        steps = max(1, int(np.ceil(abs(np.log(ratio)) / _FOCAL_STEP)))
        stage, state, frames, rows = self.bundle()
        for _ in range(steps):
            intrinsics = state[INTRINSICS] * np.array([ratio ** (1 / steps)] * 2 + [1.0, 1.0])
            state = self._solve(stage, state.replace({INTRINSICS: intrinsics}))
        self._take(state, frames, rows)

    @property
    def mean_focal(self) -> float:
        """Mean of both focal lengths, px."""
        return float(np.mean(self.intrinsics[:2]))

    @property
    def noise_px(self) -> float:
        """Noise of the tracks that bundle adjustment counts on, px: the measured one, else the configured one."""
        return self.sigma_px or self.config.bundle_adjustment.reprojection_sigma_px

    def used(self) -> tuple[Observations, IntArray]:
        """Return the observations that take part in bundle adjustment, and the track row of each."""
        self._judge()
        keep = self.good & self.registered[self.observations.frame]
        keep &= np.bincount(self.row[keep], minlength=self.num_tracks)[self.row] >= 2
        return self.observations.select(keep), self.row[keep]

    def bundle(
        self, free_focal: bool | None = None, kernel: KernelConfig | None = None
    ) -> tuple[Stage, State, IntArray, IntArray]:
        """Return bundle adjustment as a stage, its start, and the frames (t,) and tracks (m,) that take part.

        Args:
            free_focal: Whether focal lengths are; None frees them as the scene says, where there are frames enough.
            kernel: Of reprojection; None takes the configured one.
        """
        used, row = self.used()
        frames = np.flatnonzero(self.registered)
        if free_focal is None:
            free_focal = self.free_focal and len(frames) >= self.config.geometric_depth.focal_min_frames
        position_of = np.full(len(self.registered), -1, dtype=np.int64)
        position_of[frames] = np.arange(len(frames))
        used = replace(used, frame=position_of[used.frame])
        rows = np.unique(row)
        groups = {
            POSE: self.world_T_cam[frames],
            INTRINSICS: self.intrinsics[None],
            LANDMARK: self.position[rows],
        }
        state = State(groups, {LANDMARK: used.rows()[0]})
        settings = geometric_bundle_adjustment(self.config.bundle_adjustment)
        if kernel is not None:
            settings = settings.model_copy(update={"reprojection_kernel": kernel})
        problem = bundle_adjustment_problem(
            state,
            used,
            StaticNoise(self.noise_px, settings.depth_sigma),
            settings,
            self.prior_intrinsics[None],
            Freedom(poses=True, intrinsics=free_focal),
        )
        return Stage("bundle_adjustment", problem, settings.solver), state, frames, rows

    def measure_noise(self) -> float:
        """Let bundle adjustment weigh the tracks by their noise, and return that, px.

        With a noise assumed too large, the prior on the focal lengths would have too much of a say.
        """
        settings = self.config.bundle_adjustment
        sigma = self.noise_of_good()
        self.sigma_px = float(np.clip(sigma, settings.min_reprojection_sigma_px, settings.reprojection_sigma_px))
        return sigma

    def noise_of_good(self) -> float:
        """Return the noise of the tracks that agree with their points, px (robust standard deviation)."""
        return robust_sigma(self.errors()[self.good] / np.sqrt(2.0))

    def errors(self, some: IntArray | None = None) -> FloatArray:
        """Return the reprojection error of every observation, (N,) px; infinite without a point or behind.

        Args:
            some: Those to look at (n,), None for all; the result has as many.
        """
        observations, row = self.observations, self.row
        frame, uv = observations.frame, observations.uv
        if some is not None:
            frame, uv, row = frame[some], uv[some], row[some]
        rays = RayBundle(row, self.world_T_cam, frame, uv, self.intrinsics, self.num_tracks)
        return reprojection_errors(rays, self.position)

    def _judge(self, changed: IntArray | None = None) -> None:
        """Tell which observations agree with their point, of all or of those (n,) for which it may have changed."""
        if changed is None:
            self.good = self._agrees(None)
        else:
            self.good[changed] = self._agrees(changed)
        # A point that fewer than two observations hold is none.
        held = np.bincount(self.row[self.good], minlength=self.num_tracks) >= 2
        self.position[~held & ~self.left_out] = np.nan

    def _agrees(self, some: IntArray | None) -> BoolArray:
        """Return which of some observations (n,), None for all, are within the limit, of tracks that take part."""
        frame, row = self.observations.frame, self.row
        if some is not None:
            frame, row = frame[some], row[some]
        return self.registered[frame] & (self.errors(some) <= self.limit_px[frame]) & ~self.left_out[row]

    def _forget_flat(self) -> None:
        """Forget points that bundle adjustment has moved to where their rays are parallel."""
        used = np.flatnonzero(self.good & np.isfinite(self.position[self.row, 0]))
        rows, local = np.unique(self.row[used], return_inverse=True)
        angle = ray_angles(self._rays(used, local, len(rows)), self.position[rows])
        self.position[rows[angle < np.radians(0.5 * self.config.geometric_depth.min_angle_deg)]] = np.nan

    def _rays(self, used: IntArray, local: IntArray, count: int) -> RayBundle:
        return RayBundle(
            local.astype(np.int64),
            self.world_T_cam,
            self.observations.frame[used],
            self.observations.uv[used],
            self.intrinsics,
            count,
        )

    def _normalize(self) -> None:
        """Bring the median depth in the first frame of the pair, which is the world, to ``median_depth``."""
        z = self.position[np.isfinite(self.position[:, 0]), 2]
        if len(z) == 0:
            return
        factor = self.config.geometric_depth.median_depth / max(float(np.median(z)), 1e-9)
        self.position *= factor
        self.world_T_cam[:, :3, 3] *= factor


def geometric_bundle_adjustment(config: BundleAdjustmentConfig) -> BundleAdjustmentConfig:
    """Return stage 2 without depth, and without E_cam: frames that have a pose need not follow each other."""
    return without_depth_prior(without_camera_motion(config))


def _resect(
    points: FloatArray, uv: FloatArray, intrinsics: FloatArray, config: GeometricDepthConfig
) -> FloatArray | None:
    """Return the pose (4, 4) of a camera that sees N world points (N, 3) at uv (N, 2), or None."""
    if len(points) < config.min_pose_points:
        return None
    matrix = intrinsics_matrix(intrinsics)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, uv, matrix, None,
        iterationsCount=config.resection_trials, reprojectionError=config.max_reprojection_px, confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < config.min_pose_points:
        return None
    index = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(points[index], uv[index], matrix, None, rotation, translation)
    cam_T_world = np.eye(4)
    cam_T_world[:3, :3], cam_T_world[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    pose: FloatArray = se3.inverse(se3.orthonormalize(cam_T_world))
    return pose if np.isfinite(pose).all() else None
