"""Stage 1: camera initialization by depth reprojection over a sliding window.

Frames enter one by one. Each window holds the newest ``window`` frames; its poses (and, if free, the focal
lengths) are solved against the depth reprojection of every ordered pair of its frames. Once the window has
slid, its oldest frame is held fixed, so that it stays attached to everything before it; frame 0 always is.
Where tracks break off within the window, the oldest frame of every part that hangs together is held.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray, evenly_spread
from uni4d_fg.config.stages import CameraInitConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_reprojection import depth_reprojection
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, POSE
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.stages.energy import MAP, Energy
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.stages.terms import camera_motion_terms, intrinsics_priors

_TRACKS_OF_A_POSE = 3
"""Depth reprojections that determine the pose of one frame relative to another."""


@dataclass(frozen=True)
class CameraInitResult:
    """The cameras at the end of stage 1."""

    cameras: Cameras
    """Log-scales are zero: the depth cue is taken as truth here."""
    windows: list[SolveSummary] = field(default_factory=list)
    bridged_frames: tuple[int, ...] = ()
    """Frames with too few tracks: posed by constant velocity."""


class PairSource:
    """The depth reprojection factors of frame pairs, made once and reused by every window that holds them."""

    def __init__(self, labelled: LabelledTracks, max_tracks: int):
        keep = labelled.label == int(TrackLabel.STATIC)
        # By frame: a pair reads two frames of many tracks.
        self.uv = np.ascontiguousarray(labelled.tracks.uv[keep].swapaxes(0, 1), dtype=np.float64)
        self.depth = np.ascontiguousarray(labelled.depth[keep].T, dtype=np.float64)
        self.weight = np.ascontiguousarray(labelled.weight[keep].T, dtype=np.float64)
        self.seen: BoolArray = self.weight > 0
        self.liftable: BoolArray = self.seen & np.isfinite(self.depth)
        self.max_tracks = max_tracks
        self._tracks: dict[tuple[int, int], IntArray] = {}
        self._rows: dict[tuple[int, int], tuple[FloatArray, ...]] = {}

    def shared(self, frames: list[int], newest: int) -> int:
        """Return the number of residuals that link ``newest`` to ``frames`` before thinning, both ways."""
        return sum(
            int(np.count_nonzero(self.liftable[i] & self.seen[newest]))
            + int(np.count_nonzero(self.liftable[newest] & self.seen[i]))
            for i in frames
        )

    def tracks(self, source: int, target: int) -> IntArray:
        """Return the tracks liftable in ``source`` and seen in ``target``, thinned evenly."""
        if (source, target) not in self._tracks:
            common = np.flatnonzero(self.liftable[source] & self.seen[target])
            if self.max_tracks and len(common) > self.max_tracks:
                common = common[evenly_spread(len(common), self.max_tracks)]
            self._tracks[source, target] = common
        return self._tracks[source, target]

    def held(self, frames: IntArray) -> IntArray:
        """Return the oldest frame of every part of a window (W,) that tracks hold together, ascending."""
        enough = min(_TRACKS_OF_A_POSE, 2 * self.max_tracks or _TRACKS_OF_A_POSE)
        linked = np.eye(len(frames), dtype=bool)
        for a, b in zip(*np.triu_indices(len(frames), 1), strict=True):
            i, j = int(frames[a]), int(frames[b])
            linked[a, b] = linked[b, a] = len(self.tracks(i, j)) + len(self.tracks(j, i)) >= enough
        while not np.array_equal(further := linked @ linked, linked):  # what two steps reach, four, ...
            linked = further
        result: IntArray = frames[np.unique(linked.argmax(axis=1))]
        return result

    def forget_before(self, frame: int) -> None:
        """Drop cached pairs whose frames have left the window."""
        self._tracks = {pair: tracks for pair, tracks in self._tracks.items() if min(pair) >= frame}
        self._rows = {pair: rows for pair, rows in self._rows.items() if min(pair) >= frame}

    def rows(self, source: int, target: int) -> tuple[FloatArray, ...]:
        """Return source pixels (n, 2), depths (n,), target pixels (n, 2) and weights (n,) of a pair's factors."""
        if (source, target) not in self._rows:
            k = self.tracks(source, target)
            self._rows[source, target] = (
                self.uv[source][k],
                self.depth[source][k],
                self.uv[target][k],
                np.sqrt(self.weight[source][k] * self.weight[target][k]),
            )
        return self._rows[source, target]

    def batch(self, pairs: list[tuple[int, int]], config: CameraInitConfig, energy: Energy) -> FactorBatch:
        """Return the factors of ordered frame pairs (source, target)."""
        rows = [self.rows(i, j) for i, j in pairs]
        none = tuple(np.zeros(shape) for shape in ((0, 2), 0, (0, 2), 0))
        uv_source, depth, uv_target, weight = (np.concatenate(parts) for parts in zip(none, *rows, strict=True))
        counts = np.array([len(parts[1]) for parts in rows], dtype=np.int64)
        source = np.repeat(np.array([i for i, _ in pairs], dtype=np.int64), counts)
        target = np.repeat(np.array([j for _, j in pairs], dtype=np.int64), counts)
        pair = np.repeat(np.arange(len(pairs)), counts)
        noise = energy.observed(config.reprojection_sigma_px, weight, config.kernel, pair, len(pairs))
        return depth_reprojection(source, target, 0, uv_source=uv_source, depth=depth, uv_target=uv_target, **noise)


def window_stage(
    frames: IntArray,
    state: State,
    pairs: PairSource,
    config: CameraInitConfig,
    *,
    free_intrinsics: bool,
    energy: Energy,
) -> Stage:
    """Declare the solve of one window.

    Args:
        frames: (W,) ascending frames of the window.
        state: Poses, intrinsics.
        pairs: Source of the factors.
        config: Stage 1.
        free_intrinsics: Whether the focal lengths move.
        energy: Weighs the terms.
    """
    ordered = [(i, j) for i in frames.tolist() for j in frames.tolist() if i != j]
    outside = np.setdiff1d(np.arange(len(state[POSE])), frames)
    problem = Problem.over(state).fix(POSE, rows=outside).fix(POSE, rows=pairs.held(frames))
    problem.add(pairs.batch(ordered, config, energy))
    problem.add(camera_motion_terms(frames, config.camera_motion, energy))
    if not free_intrinsics:
        problem.fix(INTRINSICS)
    else:
        problem.fix(INTRINSICS, entries=[2, 3])
        if energy.is_likelihood:
            intrinsics = state[INTRINSICS]
            problem.add(intrinsics_priors(intrinsics, config.focal_prior_fraction, config.aspect_prior_sigma))
    return Stage("camera_init", problem, config.solver, part=f"{frames[0]}-{frames[-1]}")


def initialize_cameras(
    labelled: LabelledTracks,
    intrinsics: FloatArray,
    config: CameraInitConfig,
    *,
    free_intrinsics: bool,
    energy: Energy = MAP,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> CameraInitResult:
    """Estimate all poses (frame 0 is the world) and, if free, the focal lengths.

    Raises:
        DegenerateProblemError: If no frame pair shares enough static tracks with depth.
        SolverError: If a window cannot be solved.
    """
    num_frames = labelled.tracks.num_frames
    state = State({POSE: np.tile(np.eye(4), (num_frames, 1, 1)), INTRINSICS: intrinsics[None].copy()})
    prior_intrinsics = state[INTRINSICS].copy()
    pairs = PairSource(labelled, config.max_tracks_per_pair)
    summaries: list[SolveSummary] = []
    bridged: list[int] = []
    for newest in range(1, num_frames):
        frames = np.arange(max(0, newest - config.window + 1), newest + 1)
        poses = state[POSE].copy()
        poses[newest] = _predict(poses, newest)
        state = state.replace({POSE: poses})
        if pairs.shared(frames[:-1].tolist(), newest) < 2 * config.min_tracks_per_frame:
            bridged.append(newest)
            continue
        stage = window_stage(
            frames,
            state.replace({INTRINSICS: prior_intrinsics}),
            pairs,
            config,
            free_intrinsics=free_intrinsics and newest >= config.window - 1,
            energy=energy,
        )
        state, summary = run(stage, state, hooks)
        summaries.append(summary)
        pairs.forget_before(int(frames[0]))
        if summary.termination is Termination.CANCELLED:
            break
    if num_frames > 1 and not summaries:
        counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in labelled.counts().items())
        raise DegenerateProblemError(
            f"camera initialization: no two frames share {config.min_tracks_per_frame} static tracks with depth "
            f"({counts}; {int(pairs.liftable.sum())} static observations have depth). Check masks (is everything "
            "marked as moving?), depth (is it zero or missing?) and tracks; 'uni4d-fg validate' lists what was found."
        )
    cameras = Cameras(state[POSE], state[INTRINSICS][0], np.zeros(num_frames))
    return CameraInitResult(cameras, summaries, tuple(bridged))


def _predict(poses: FloatArray, frame: int) -> FloatArray:
    """Continue the last relative motion (constant velocity)."""
    if frame < 2:
        return np.asarray(poses[frame - 1])
    step = se3.inverse(poses[frame - 2]) @ poses[frame - 1]
    return se3.orthonormalize(poses[frame - 1] @ step)
