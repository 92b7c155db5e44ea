"""Frames in, one at a time; poses, landmarks and moving points out. Memory and time per frame are bounded."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from uni4d_fg.allocation import return_free_memory
from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, IntArray
from uni4d_fg.config.load import opened_config
from uni4d_fg.config.models import Config
from uni4d_fg.errors import ConfigError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.optim.added_factors import FactorSource, checked_sources
from uni4d_fg.optim.backend import choose_backend
from uni4d_fg.optim.stage import LevenbergMarquardtRunner
from uni4d_fg.slam.incremental.boundary import Boundary, checked_intrinsics, checked_size, detached
from uni4d_fg.slam.incremental.dynamic import DynamicWindow, in_world, moving_scales
from uni4d_fg.slam.incremental.labels import LabelledFrame, TrackBook
from uni4d_fg.slam.incremental.model import (
    DynamicPoints,
    FinishedFrame,
    FrameStatus,
    FrameTracks,
    FrameUpdate,
    Landmarks,
)
from uni4d_fg.slam.incremental.pose import FramePose, locate, predict, refocused, shared_spread
from uni4d_fg.slam.incremental.results import Finished, Results, ResultsInMemory, assemble_results
from uni4d_fg.slam.incremental.smoother import make_smoother
from uni4d_fg.slam.incremental.tracking import OnlineTracker
from uni4d_fg.slam.incremental.window import CameraWindow, LeftKeyframe, LeftLandmarks, no_observations
from uni4d_fg.slam.reconstruction import Reconstruction
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise


@dataclass
class PendingFrame:
    """A frame whose keyframe is still in the window."""

    frame: int
    timestamp: float
    status: FrameStatus
    keyframe: int
    """Number of the keyframe that its pose is relative to; its own for a keyframe."""
    keyframe_T_cam: FloatArray
    """(4, 4)."""
    covariance: FloatArray
    """(6, 6) relative to the keyframe; zero for a keyframe."""
    log_scale: float
    dynamic: DynamicPoints
    """In the axes of its camera."""
    seen: Observations = field(default_factory=no_observations)
    """What it was posed by, kept before the focal lengths are known: it is then posed again before it leaves.
    ``frame`` is its number."""


def check_incremental(config: Config) -> None:
    """Check that a configuration can be solved in a window that moves.

    Raises:
        ConfigError: If it cannot.
    """
    if config.energy != "map" or config.solver != "lm":
        raise ConfigError("incremental solving is made for energy 'map' and solver 'lm'; the paper's norms have no "
                          "information to marginalize: choose the preset 'default' or 'fast'")  # fmt: skip
    incremental = config.incremental
    if not incremental.nonrigid_lag + 2 <= min(incremental.nonrigid_window, incremental.window + 1):
        raise ConfigError(
            f"incremental.nonrigid_lag {incremental.nonrigid_lag} must be at least 2 less than nonrigid_window "
            f"{incremental.nonrigid_window} and less than window {incremental.window}"
        )


class IncrementalReconstructor:
    """Solves a video frame by frame over a sliding window.

    Args:
        intrinsics: (4,) fx, fy, cx, cy, px: known, or a starting value when ``input.intrinsics`` is free.
        image_size: (height, width), px.
        config: A configuration, the name of a preset, or a YAML file; the default preset when None. ``incremental`` has
            the window, the rest is that of the batch stages.
        results: Takes what leaves the window; kept in memory when None.
        additions: Factors and variables of your own, asked for before every solve of the window; keys count frames from
            the first, see :mod:`uni4d_fg.optim.added_factors`. Frames that are no keyframes are in no solve.
        lens: Distortion of the images; it goes with the intrinsics, which are held where there is any.

    Raises:
        ConfigError: If there is no such configuration, or it asks for what cannot be done in a window.
        InputError: If the intrinsics are not usable: a focal length not positive, the principal point outside.
        SolverError: If the additions are no list of functions.
    """

    def __init__(
        self,
        intrinsics: FloatArray,
        image_size: tuple[int, int],
        config: Config | str | Path | None = None,
        results: Results | None = None,
        additions: Iterable[FactorSource] = (),
        lens: Lens = PINHOLE,
    ):
        config = opened_config(config)
        check_incremental(config)
        if not lens.is_pinhole:
            held = config.input.model_copy(update={"intrinsics": "fixed"})
            config = config.model_copy(update={"input": held})
        self.config, self.lens, self.image_size = config, lens, checked_size(image_size)
        intrinsics = checked_intrinsics(intrinsics, self.image_size)
        ba = config.bundle_adjustment
        noise = StaticNoise(ba.reprojection_sigma_px, ba.depth_sigma, ba.depth_correlation)
        self.window = CameraWindow(config, intrinsics, intrinsics.copy(), noise, sources=checked_sources(additions))
        self.dynamic = DynamicWindow(config, depth_sigma=ba.depth_sigma)
        self.book = TrackBook()
        self.tracker = OnlineTracker(config.tracking, config.incremental.max_live_tracks)
        self.pending: list[PendingFrame] = []
        self.results: Results = ResultsInMemory() if results is None else results
        self.num_frames = 0
        self.last_timestamp = -np.inf
        self.last_pose = np.eye(4)
        self._boundary = Boundary(self.image_size, config.input)
        self._run = LevenbergMarquardtRunner(choose_backend(config.backend))
        self.smoother = make_smoother(config.incremental, self._run)
        self._seconds: dict[str, float] = {}

    @property
    def intrinsics(self) -> FloatArray:
        """(4,) present estimate."""
        return self.window.intrinsics.copy()

    def add_frame(
        self,
        image: ImageArray,
        depth: Float32Array,
        mask: Int32Array | None = None,
        tracks: FrameTracks | None = None,
        timestamp: float | None = None,
    ) -> FrameUpdate:
        """Take the next frame.

        Args:
            image: (H, W, 3) uint8 RGB, or (H, W) gray.
            depth: (H, W) floats, meters, NaN, 0 or negative where missing. Frames may lack it.
            mask: (H, W) 0 static, > 0 instance that may move; all static when None.
            tracks: Points tracked to this frame; None tracks online.
            timestamp: Seconds, increasing; the number of the frame when None. A frame at the time of the last one,
                or before it, changes nothing and is reported as such.

        Raises:
            InputError: If an array has a wrong shape or type, the timestamp is not finite, tracks are given for some
                frames only, or there is depth for the first time, and all of it is negative or outside
                ``input.min_depth_m`` to ``input.max_depth_m``.
            SolverError: If the window cannot be solved, a frame before could not be, or the stream was finished.
        """
        frame = self._boundary.check(self.num_frames, image, depth, mask, tracks, timestamp)
        with self._boundary.guard():
            return detached(self._take(*frame))

    def _take(
        self, image: ImageArray, depth: Float32Array, mask: Int32Array, tracks: FrameTracks | None, time_now: float
    ) -> FrameUpdate:
        """Take a frame that is checked."""
        self._seconds = {}
        if time_now <= self.last_timestamp:
            status = FrameStatus.REPEATED if time_now == self.last_timestamp else FrameStatus.OUT_OF_ORDER
            return self._update(status, DynamicPoints.none(), 0, (), ())
        frame = self.num_frames
        with self._timed("track"):
            tracks = self.tracker.advance(image) if tracks is None else tracks
            found = self.book.observe(
                frame, tracks, image, depth, mask, self.config.labels, self.config.input,
                self.config.bundle_adjustment.drift_frames,
            ).ideal(self.lens, self.window.prior_intrinsics)  # fmt: skip
        self.window.remove_tracks(found.rejected)
        self.dynamic.remove_tracks(found.rejected)
        static, moving = found.select(static=True), found.select(static=False)
        with self._timed("pose"):
            pose, used = self._pose(frame, static)
        status = self._status(frame, static, pose)
        self._append(frame, time_now, status, static, pose)
        self.num_frames, self.last_timestamp = frame + 1, time_now
        landmarks: list[Landmarks] = []
        left: list[LeftKeyframe] = []
        if status is not FrameStatus.TRACKED:
            with self._timed("window"):
                self._solve_window()
            with self._timed("covariance"):
                self.window.update_covariance()
            while self.smoother.must_slide(self.window):
                with self._timed("pose"):
                    self._pose_again(0)
                with self._timed("marginalize"):
                    oldest, gone = self.window.slide()
                left.append(oldest)
                landmarks.append(self._colored(gone, oldest.frame))
        self.last_pose = self._pose_of(self.pending[-1])
        with self._timed("nonrigid"):
            dynamic = self._solve_dynamic(frame, static, moving)
        finished = tuple(f for keyframe in left for f in self._finish_keyframe(keyframe))
        self._forget(frame)
        self.results.add(finished, tuple(landmarks))
        return_free_memory()
        return self._update(status, dynamic, used, finished, tuple(landmarks))

    def finish(self) -> Reconstruction:
        """Hand over what is left in the window and collect the result; more frames may not be added.

        Raises:
            DegenerateProblemError: If no frame was added, or none had depth.
        """
        self._boundary.check_finish(self.num_frames)
        self.flush()
        return self.collect(self.results)

    def collect(self, results: Finished) -> Reconstruction:
        """Return what has left the window as a :class:`Reconstruction`.

        Raises:
            DegenerateProblemError: If no frame was added.
        """
        window = self.window
        return assemble_results(results, window.intrinsics, window.intrinsics_covariance, self.image_size, self.lens)

    def flush(self) -> None:
        """Hand over what is left in the window to ``results``; more frames may not be added."""
        if self.num_frames:
            self._boundary.close()
        window = self.window
        for row in range(len(window)):
            self._pose_again(row)
        frames = [finished for row in range(len(window)) for finished in self._finish_keyframe(window.keyframe(row))]
        landmarks: tuple[Landmarks, ...] = ()
        if len(window.landmark_track):
            landmarks = (self._colored(window.all_landmarks(), int(window.frame[-1])),)
        self.results.add(tuple(frames), landmarks)
        self.pending = []
        self.window = CameraWindow(
            self.config, window.prior_intrinsics, window.intrinsics, window.noise,
            intrinsics_covariance=window.intrinsics_covariance, sources=window.sources,
        )  # fmt: skip

    def _pose(self, frame: int, static: LabelledFrame) -> tuple[FramePose | None, int]:
        """Return the pose of a new frame against known points, None if too few agree, and how many agree."""
        window = self.window
        if len(window) == 0:
            return FramePose(np.eye(4), 0.0, np.ones(len(static.track), dtype=bool), np.zeros((6, 6))), len(
                static.track
            )
        known, points = window.landmarks_of(static.track)
        if known.sum() < 2 * self.config.incremental.min_tracks:
            points[~known] = window.lifted(static.track[~known])
        usable = np.isfinite(points).all(axis=1)
        if usable.sum() < self.config.incremental.min_tracks:
            return None, int(usable.sum())
        chosen = LabelledFrame(
            static.track[usable], static.uv[usable], static.depth[usable], static.weight[usable],
            static.label[usable], static.rejected,
        )  # fmt: skip
        guesses = [self._predicted(frame), self.last_pose]
        found = locate(
            guesses, chosen, points[usable], window.intrinsics, window.noise, self.config, self._run, window.cue_scale,
            window.point_errors(chosen.track, points[usable]),
        )  # fmt: skip
        count = int(found.inlier.sum())
        if count < self.config.incremental.min_tracks:
            return None, count
        inlier: BoolArray = np.ones(len(static.track), dtype=bool)
        inlier[np.flatnonzero(usable)[~found.inlier]] = False
        return replace(found, inlier=inlier), count

    def _predicted(self, frame: int) -> FloatArray:
        last = self.pending[-2:]
        poses = np.stack([self._pose_of(p) for p in last])
        return predict(poses, np.array([p.frame for p in last], dtype=np.float64), float(frame))

    def _pose_of(self, pending: PendingFrame) -> FloatArray:
        row = int(np.searchsorted(self.window.frame, pending.keyframe))
        if row >= len(self.window) or self.window.frame[row] != pending.keyframe:
            return self.last_pose
        result: FloatArray = self.window.pose[row] @ pending.keyframe_T_cam
        return result

    def _status(self, frame: int, static: LabelledFrame, pose: FramePose | None) -> FrameStatus:
        """Decide whether a frame joins the window."""
        config, window = self.config.incremental, self.window
        if pose is None:
            return FrameStatus.BRIDGED
        if len(window) == 0 or frame - window.frame[-1] >= config.keyframe_interval or window.bridged[-1] > 0:
            return FrameStatus.KEYFRAME
        newest = window.observations.select(window.observations.frame == len(window) - 1)
        _, here, there = np.intersect1d(static.track, newest.track, assume_unique=True, return_indices=True)
        if len(here) < config.keyframe_overlap * max(len(newest), config.min_tracks):
            return FrameStatus.KEYFRAME
        moved = np.linalg.norm(static.uv[here] - newest.uv[there], axis=1)
        return (
            FrameStatus.KEYFRAME
            if np.median(moved) >= config.keyframe_parallax * max(self.image_size)
            else FrameStatus.TRACKED
        )

    def _append(
        self, frame: int, timestamp: float, status: FrameStatus, static: LabelledFrame, pose: FramePose | None
    ) -> None:
        seen = no_observations()
        if status is FrameStatus.TRACKED:
            assert pose is not None
            keyframe = int(self.window.frame[-1])
            relative = se3.inverse(self.window.pose[-1]) @ pose.world_T_cam
            covariance, log_scale = pose.covariance, pose.log_scale
            if self.window.intrinsics_free and self.config.input.intrinsics == "free":
                agreeing = _picked(static, pose.inlier)
                number = np.full(len(agreeing.track), frame)
                seen = Observations(agreeing.track, number, agreeing.uv, agreeing.depth, agreeing.weight)
        else:
            keyframe, relative, covariance = frame, np.eye(4), np.zeros((6, 6))
            log_scale = 0.0 if pose is None else pose.log_scale
            world_T_cam = self._predicted(frame) if pose is None else pose.world_T_cam
            agreeing = static if pose is None else _picked(static, pose.inlier)
            bridged = 0 if pose is not None else self._bridged_frames() + 1
            self.window.append(frame, world_T_cam, log_scale, agreeing, bridged)
        none = DynamicPoints.none()
        self.pending.append(
            PendingFrame(frame, timestamp, status, keyframe, relative, covariance, log_scale, none, seen)
        )

    def _rescale(self, log_scale: float) -> None:
        """Let what was found at the old scale of the world follow where added factors have changed it.

        Frames that hang on a keyframe were posed by landmarks of that time, and depths of moving points were scaled.
        """
        if log_scale == 0.0:
            return
        self.dynamic.rescale(log_scale)
        for pending in self.pending:
            points = pending.dynamic
            pending.dynamic = replace(points, point=points.point * np.exp(log_scale))
            if pending.status is FrameStatus.TRACKED:
                pending.keyframe_T_cam = pending.keyframe_T_cam.copy()
                pending.keyframe_T_cam[:3, 3] *= np.exp(log_scale)
                pending.log_scale += log_scale

    def _solve_window(self) -> None:
        """Solve the window and let the frames that hang on its keyframes follow."""
        window = self.window
        hanging = [pending for pending in self.pending if pending.status is FrameStatus.TRACKED]
        rows = {int(np.searchsorted(window.frame, pending.keyframe)) for pending in hanging}
        depths = {row: window.log_depths(row) for row in rows}
        scale_before, focal_before = window.cue_scale, window.intrinsics[:2]
        self.smoother.solve(window)
        self._rescale(window.cue_scale - scale_before)
        ratio = focal_before / window.intrinsics[:2]
        for row, (track, before) in depths.items():
            seen, after = window.log_depths(row)
            _, here, there = np.intersect1d(track, seen, assume_unique=True, return_indices=True)
            deeper = float(np.median(after[there] - before[here])) if len(here) else 0.0
            for pending in hanging:
                if pending.keyframe == window.frame[row]:
                    pending.keyframe_T_cam = refocused(pending.keyframe_T_cam, ratio, np.exp(deeper))

    def _pose_again(self, row: int) -> None:
        """Pose the frames anew that hang on a keyframe and were posed before the focal lengths were known.

        Until then they follow to first order (:func:`refocused`), which leaves their turns as they are.
        """
        window = self.window
        for pending in self.pending:
            if pending.keyframe != window.frame[row] or not len(pending.seen):
                continue
            known, points = window.landmarks_of(pending.seen.track)
            seen = pending.seen.select(known)
            if len(seen) < self.config.incremental.min_tracks:
                continue
            label = np.zeros(len(seen), dtype=np.int64)
            tracks = LabelledFrame(seen.track, seen.uv, seen.depth, seen.weight, label, label[:0])
            found = locate(
                [window.pose[row] @ pending.keyframe_T_cam], tracks, points[known], window.intrinsics, window.noise,
                self.config, self._run, window.cue_scale, window.point_errors(seen.track, points[known], row),
            )  # fmt: skip
            if found.inlier.sum() >= self.config.incremental.min_tracks:
                pending.keyframe_T_cam = se3.inverse(window.pose[row]) @ found.world_T_cam
                pending.covariance, pending.log_scale = found.covariance, found.log_scale

    def _bridged_frames(self) -> int:
        """Return how many of the newest frames were bridged."""
        last = bool(self.pending) and self.pending[-1].status is FrameStatus.BRIDGED
        return int(self.window.bridged[-1]) if last else 0

    def _solve_dynamic(self, frame: int, static: LabelledFrame, moving: LabelledFrame) -> DynamicPoints:
        """Add the moving observations of the newest frame and solve their window; return its points in the world."""
        newest = self.pending[-1]
        log_scale = newest.log_scale if newest.status is FrameStatus.TRACKED else float(self.window.log_scale[-1])
        neighbors = self.config.nonrigid.local_scale_neighbors
        samples = self.config.nonrigid.local_scale_samples
        _, points = self.window.landmarks_of(static.track)
        scales, sigma = moving_scales(static, points, moving, self.last_pose, log_scale, neighbors, samples)
        if np.isfinite(sigma):
            floor, part = self.config.bundle_adjustment.min_depth_sigma, self.config.incremental.noise_smoothing
            self.dynamic.depth_sigma += part * (max(sigma, floor) - self.dynamic.depth_sigma)
        self.dynamic.append(frame, self.last_pose, moving, scales)
        by_frame = {pending.frame: pending for pending in self.pending}
        for i, number in enumerate(self.dynamic.frame.tolist()):
            if number in by_frame:
                self.dynamic.pose[i] = self._pose_of(by_frame[number])
        solved = self.dynamic.solve(self.window.intrinsics, self.window.noise, self.book, self._run)
        lag = self.config.incremental.nonrigid_lag
        for number, points_of_frame in solved.items():
            if number >= frame - lag and number in by_frame:
                by_frame[number].dynamic = points_of_frame
        return in_world(solved[frame], self.last_pose)

    def _finish_keyframe(self, keyframe: LeftKeyframe) -> Iterator[FinishedFrame]:
        """Yield the frames that hang on a keyframe and forget them."""
        mine = [pending for pending in self.pending if pending.keyframe == keyframe.frame]
        self.pending = [pending for pending in self.pending if pending.keyframe != keyframe.frame]
        for pending in mine:
            pose = se3.orthonormalize(keyframe.world_T_cam @ pending.keyframe_T_cam)
            own = pending.frame == keyframe.frame
            yield FinishedFrame(
                pending.frame,
                pending.timestamp,
                pending.status,
                pose,
                keyframe.covariance if own else self._hanging_covariance(keyframe, pending),
                keyframe.log_scale if own else pending.log_scale,
                in_world(pending.dynamic, pose),
            )

    def _hanging_covariance(self, keyframe: LeftKeyframe, pending: PendingFrame) -> FloatArray:
        """Return the covariance (6, 6) of a frame that hangs on a keyframe."""
        depth = np.nan_to_num(keyframe.log_scale_sigma)
        relative = pending.covariance + shared_spread(pending.keyframe_T_cam, self.window.focal_sigma, depth)
        return se3.composed_covariance(keyframe.covariance, pending.keyframe_T_cam, relative)

    def _colored(self, left: LeftLandmarks, keyframe: int) -> Landmarks:
        colors = self.book.colors(left.track)
        return Landmarks(left.track, left.point, left.error, left.count, colors, np.full(len(left.track), keyframe))

    def _forget(self, frame: int) -> None:
        used: list[IntArray] = [self.window.observations.track, self.dynamic.observations.track]
        self.book.forget(frame - self.config.incremental.window, np.unique(np.concatenate(used)))

    def _update(
        self, status: FrameStatus, dynamic: DynamicPoints, used: int, finished: tuple[FinishedFrame, ...],
        landmarks: tuple[Landmarks, ...],
    ) -> FrameUpdate:  # fmt: skip
        window, covariance = self.window, np.full((6, 6), np.nan)
        if self.pending:
            newest = self.pending[-1]
            covariance = window.covariance[-1]
            if newest.status is FrameStatus.TRACKED:
                covariance = self._hanging_covariance(window.keyframe(len(window) - 1), newest)
        return FrameUpdate(
            status, max(self.num_frames - 1, 0), self.last_pose, covariance, window.landmark_track, window.landmark,
            dynamic, finished, landmarks, window.error_px, used, len(window), dict(self._seconds),
        )  # fmt: skip

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self._seconds[part] = self._seconds.get(part, 0.0) + time.perf_counter() - began


def _picked(frame: LabelledFrame, keep: np.ndarray) -> LabelledFrame:
    return LabelledFrame(
        frame.track[keep], frame.uv[keep], frame.depth[keep], frame.weight[keep], frame.label[keep], frame.rejected
    )
