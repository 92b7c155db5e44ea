"""The window over cameras and landmarks: stage 2 on its keyframes, and what leaves it becomes a linear prior.

A landmark is seen by many frames, and a frame that leaves takes its observations along. Which ones is a choice:

- A landmark that the newest frame does not see any more stays until its oldest observation is in the leaving
  frame, and is then marginalized with all its observations: nothing is lost.
- A landmark that is still seen would, marginalized now, use up its observations in all frames at once. One that
  is kept can only do without its observation in the leaving frame. Each live track is therefore marginalized
  once per length of the window, in a phase of its own, and starts anew as another landmark; between, it drops
  what leaves. The phases differ, so that at any time nearly all tracks tie the newest frames to those before.

The prior is on cameras only (poses, log-scales, intrinsics) and on variables that were added, so that landmarks stay
independent of each other. What was added to a solve (:mod:`uni4d_fg.optim.added_factors`) leaves in the same way: added
factors on the leaving keyframe, and added variables of its frame or an earlier one, are marginalized with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.marginalization_prior import MARGINALIZATION_PRIOR, marginalization_prior_type
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import CUE_SCALE, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry.camera import NEAR_PLANE, world_to_camera
from uni4d_fg.optim.added_factors import AddedValues, FactorSource, JoinedStage, join_additions
from uni4d_fg.optim.cluster_robust import Clusters, Spread
from uni4d_fg.optim.considered import Considered
from uni4d_fg.optim.marginalization import marginalize_with_spread
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.slam.incremental.labels import LabelledFrame
from uni4d_fg.slam.incremental.point_errors import PointErrors, point_errors
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, bundle_adjustment_problem, held_to_the_cue
from uni4d_fg.slam.stages.energy import MAP
from uni4d_fg.slam.stages.lifting import frame_log_scales, lift, mean_per_row
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise
from uni4d_fg.slam.stages.static_covariance import considered_focal_lengths, static_marginals, track_cells
from uni4d_fg.slam.stages.static_outliers import drop_outliers, landmark_errors, measure_noise, reprojection_residual
from uni4d_fg.slam.stages.terms import camera_motion_terms

_BRIDGE = marginalization_prior_type((POSE,))


def no_observations() -> Observations:
    """Return none."""
    empty = np.zeros(0, dtype=np.int64)
    return Observations(empty, empty, np.zeros((0, 2)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class LeftLandmarks:
    """Landmarks that were marginalized."""

    track: IntArray
    point: FloatArray
    error: FloatArray
    count: IntArray


@dataclass(frozen=True)
class LeftKeyframe:
    """The keyframe that was marginalized."""

    frame: int
    world_T_cam: FloatArray
    covariance: FloatArray
    log_scale: float
    log_scale_sigma: float


@dataclass(frozen=True)
class KeyedPrior:
    """The linear prior that older keyframes left, on variables by the numbers of their keys."""

    batch: FactorBatch
    """Its rows mean nothing."""
    numbers: tuple[tuple[int, ...], ...]
    """Of each slot's variable."""

    @classmethod
    def of(cls, batch: FactorBatch, state: State) -> KeyedPrior:
        """Take over a prior on rows of a state."""
        numbers = (state.numbers(s.variable)[int(s.rows[0])].tolist() for s in batch.slots)
        return cls(batch, tuple(tuple(n) for n in numbers))

    def on(self, state: State) -> FactorBatch:
        """Return it on the rows of a state."""
        rows = {s.variable: {n: i for i, n in enumerate(map(tuple, state.numbers(s.variable).tolist()))}
                for s in self.batch.slots}  # fmt: skip
        slots = (Slot(s.variable, np.array([rows[s.variable][n]])) for s, n in self._places())
        return replace(self.batch, slots=tuple(slots))

    def reads(self, other_than: State) -> dict[VariableType, list[tuple[int, ...]]]:
        """Return the numbers of its variables of types that a state does not have."""
        out: dict[VariableType, list[tuple[int, ...]]] = {}
        for slot, numbers in self._places():
            if slot.variable not in other_than:
                out.setdefault(slot.variable, []).append(numbers)
        return out

    def _places(self) -> list[tuple[Slot, tuple[int, ...]]]:
        return list(zip(self.batch.slots, self.numbers, strict=True))


@dataclass
class CameraWindow:
    """Keyframes, their static observations, landmarks, and the prior that older ones left."""

    config: Config
    prior_intrinsics: FloatArray
    """(4,) center of the intrinsics' prior."""
    intrinsics: FloatArray
    noise: StaticNoise
    frame: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(W,) frame numbers, ascending."""
    bridged: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(W,) frames since the last one that was not bridged; 0 for frames that are not."""
    start: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(W, 4, 4) pose that each keyframe was added at."""
    pose: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    log_scale: FloatArray = field(default_factory=lambda: np.zeros(0))
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    """(W, 6, 6) of the last solve."""
    log_scale_sigma: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(W,) standard deviation of the log-scales, of the last solve; NaN where unknown."""
    intrinsics_covariance: FloatArray = field(default_factory=lambda: np.full((4, 4), np.nan))
    observations: Observations = field(default_factory=no_observations)
    """Of static tracks; ``frame`` is the row in the window."""
    landmark_track: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) ascending."""
    landmark: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    sources: tuple[FactorSource, ...] = ()
    """Asked for factors before every solve."""
    added: AddedValues = field(default_factory=AddedValues)
    """Present values of the variables that they added."""
    prior: KeyedPrior | None = None
    spread: Spread | None = None
    """Of the prior's gradient, on the columns of its slots."""
    slides: int = 0
    """Keyframes that have left."""
    intrinsics_free: bool = True
    error_px: float = float("nan")
    """Median reprojection error after the last solve."""

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def cue_scale(self) -> float:
        """Log-scale of the depth cue that all frames share, where added factors know lengths; 0 where none does."""
        return float(self.added.of(CUE_SCALE).get((0,), np.zeros(1))[0])

    def append(self, frame: int, pose: FloatArray, log_scale: float, observations: LabelledFrame, bridged: int) -> None:
        """Add a keyframe at its starting pose, and landmarks for the tracks that have become long enough."""
        row = len(self)
        self.frame = np.append(self.frame, frame)
        self.bridged = np.append(self.bridged, bridged)
        self.pose = np.concatenate([self.pose, pose[None]])
        self.start = np.concatenate([self.start, pose[None]])
        self.log_scale = np.append(self.log_scale, log_scale)
        self.covariance = np.concatenate([self.covariance, np.full((1, 6, 6), np.nan)])
        self.log_scale_sigma = np.append(self.log_scale_sigma, np.nan)
        new = observations
        old = self.observations
        self.observations = Observations(
            np.concatenate([old.track, new.track]),
            np.concatenate([old.frame, np.full(len(new.track), row)]),
            np.concatenate([old.uv, new.uv]),
            np.concatenate([old.depth, new.depth]),
            np.concatenate([old.weight, new.weight]),
        )
        self._start_landmarks()

    def remove_tracks(self, track: IntArray) -> None:
        """Forget everything of tracks that turned out to be unreliable."""
        if len(track):
            self.observations = self.observations.select(~np.isin(self.observations.track, track))
            self._keep_landmarks(~np.isin(self.landmark_track, track))

    def solve(self, run: StageRunner) -> None:
        """Solve the window, drop outliers, measure the noise; fix the intrinsics once they are known."""
        if len(self) < 2:
            return
        state, observations, joined = self._stage()
        solved, _ = run(joined.stage, joined.state, None)
        self.added.take(solved, joined.added)
        state = state.replace({variable: solved[variable] for variable in state.arrays})
        self._take(state)
        if len(observations):
            self._drop(state, observations)

    def update_covariance(self) -> None:
        """Compute the marginal covariances at the present state."""
        considered = self._considered()
        _, used, joined = self._stage(free_intrinsics=considered is not None or self._free_intrinsics())
        marginals = static_marginals(joined.stage, joined.state, self._clusters(used), self.spread, considered)
        if marginals is None:
            self.covariance = np.full((len(self), 6, 6), np.nan)
            self.log_scale_sigma = np.full(len(self), np.nan)
            return
        self.covariance = marginals.blocks(POSE, len(self))
        self.log_scale_sigma = np.sqrt(marginals.blocks(LOG_SCALE, len(self))[:, 0, 0])
        if not self._free_intrinsics():
            return
        self.intrinsics_covariance = marginals.blocks(INTRINSICS, 1)[0]
        sigma = np.sqrt(np.diag(self.intrinsics_covariance)[:2]) / self.intrinsics[:2]
        if self.slides and (sigma < self.config.incremental.focal_sigma).all():
            self.intrinsics_free = False

    def slide(self) -> tuple[LeftKeyframe, LeftLandmarks]:
        """Marginalize the oldest keyframe with the landmarks whose turn it is."""
        state, used, joined = self._stage()
        leaving_landmark = self._leaving_landmarks(used)
        left = self._hand_over(state, used, leaving_landmark)
        self.prior, self.spread = self._reduce(joined, used, leaving_landmark)
        oldest = self.keyframe(0)
        gone = np.isin(self.observations.track, self.landmark_track[leaving_landmark]) | (self.observations.frame == 0)
        kept = self.observations.select(~gone)
        self.observations = replace(kept, frame=kept.frame - 1)
        self._keep_landmarks(~leaving_landmark)
        self.frame, self.bridged, self.pose = self.frame[1:], self.bridged[1:], self.pose[1:]
        self.log_scale, self.covariance, self.start = self.log_scale[1:], self.covariance[1:], self.start[1:]
        self.log_scale_sigma = self.log_scale_sigma[1:]
        self.slides += 1
        self._drop_bare_landmarks()
        return oldest, left

    def keyframe(self, row: int) -> LeftKeyframe:
        """Return what is known of a keyframe at present."""
        return LeftKeyframe(
            int(self.frame[row]), self.pose[row], self.covariance[row],
            float(self.log_scale[row]), float(self.log_scale_sigma[row]),
        )  # fmt: skip

    def all_landmarks(self) -> LeftLandmarks:
        """Return every landmark of the window, for the end of the video."""
        state, used, _ = self._stage()
        return self._hand_over(state, used, np.ones(len(self.landmark_track), dtype=bool))

    def landmarks_of(self, track: IntArray) -> tuple[BoolArray, FloatArray]:
        """Return which of the tracks (n,) have a landmark, and the points (n, 3); NaN for the others."""
        out = np.full((len(track), 3), np.nan)
        known = np.zeros(len(track), dtype=bool)
        if len(self.landmark_track):
            at = np.minimum(np.searchsorted(self.landmark_track, track), len(self.landmark_track) - 1)
            known = self.landmark_track[at] == track
            out[known] = self.landmark[at[known]]
        return known, out

    def lifted(self, track: IntArray) -> FloatArray:
        """Return the mean lift of the depth cue of tracks (n,) over their observations, (n, 3); NaN where unknown."""
        order = np.argsort(track)
        at = np.minimum(np.searchsorted(track[order], self.observations.track), max(len(track) - 1, 0))
        mine = track[order][at] == self.observations.track if len(track) else np.zeros(len(at), dtype=bool)
        observations = self.observations.select(mine)
        points = lift(observations, self._cameras())
        return mean_per_row(points, observations.weight, order[at[mine]], len(track))

    def point_errors(self, track: IntArray, points: FloatArray, row: int = -1) -> PointErrors:
        """Return how uncertain the points (n, 3) of tracks (n,) are that a frame on a keyframe is posed by."""
        return point_errors(self.observations, self._cameras(), row, track, points, self.noise)

    def log_depths(self, row: int) -> tuple[IntArray, FloatArray]:
        """Return the tracks (n,) of the landmarks that a keyframe sees, ascending, and their log-depths (n,)."""
        seen = np.unique(self.observations.track[self.observations.frame == row])
        known, points = self.landmarks_of(seen)
        z = world_to_camera(np.broadcast_to(self.pose[row], (len(points), 4, 4)), points)[:, 2]
        known &= z > NEAR_PLANE
        return seen[known], np.log(z[known])

    def _start_landmarks(self) -> None:
        enough = min(self.config.incremental.min_observations, len(self))
        if len(self) < 2:
            return
        tracks, count = np.unique(self.observations.track, return_counts=True)
        candidate = tracks[(count >= enough) & ~np.isin(tracks, self.landmark_track)]
        points = self.lifted(candidate)
        known = np.isfinite(points).all(axis=1)
        merged = np.concatenate([self.landmark_track, candidate[known]])
        order = np.argsort(merged, kind="stable")
        self.landmark_track = merged[order]
        self.landmark = np.concatenate([self.landmark, points[known]])[order]

    def _free_intrinsics(self) -> bool:
        enough = self.slides > 0 or len(self) >= self.config.incremental.free_intrinsics_from
        return self.intrinsics_free and enough and self.config.input.intrinsics == "free"

    def _considered(self) -> Considered | None:
        """Return the intrinsics as a constant that is not known exactly; None where they are free, or given as exact.

        Before there are enough keyframes they are as uncertain as their prior, afterwards as when they were fixed.
        """
        if self._free_intrinsics() or self.config.input.intrinsics != "free":
            return None
        if not self.intrinsics_free:
            return Considered(INTRINSICS, self.intrinsics_covariance)
        ba = self.config.bundle_adjustment
        return considered_focal_lengths(self.intrinsics, ba.focal_prior_fraction, ba.aspect_prior_sigma)

    @property
    def focal_sigma(self) -> float:
        """Standard deviation of the logarithm of the focal lengths in use."""
        considered = self._considered()
        covariance = self.intrinsics_covariance if considered is None else considered.covariance
        found = float(np.sqrt(np.diag(covariance)[:2].max())) / float(self.intrinsics[0])
        return found if np.isfinite(found) else 0.0

    def _stage(self, free_intrinsics: bool | None = None) -> tuple[State, Observations, JoinedStage]:
        """Declare the solve, without what is added and with it.

        Args:
            free_intrinsics: Whether the intrinsics move; as they do in the solve when None.

        Returns:
            The window's own state, the observations of landmarks, tracks numbered by landmark row, and the whole solve.
        """
        at = np.searchsorted(self.landmark_track, self.observations.track)
        at = np.minimum(at, max(len(self.landmark_track) - 1, 0))
        mine = np.zeros(len(at), dtype=bool)
        if len(self.landmark_track):
            mine = self.landmark_track[at] == self.observations.track
        chosen = replace(self.observations.select(mine), track=at[mine])
        chosen = chosen.select(np.lexsort([chosen.frame, chosen.track]))
        state = self._cameras().state(self.landmark, self.landmark_track, self.frame)
        noise, ba = self.noise, self.config.bundle_adjustment
        if not self.slides:  # the noise of the cue is measured on the first window, as after the batch's first solve
            noise, ba = held_to_the_cue(noise, ba)
        free_intrinsics = self._free_intrinsics() if free_intrinsics is None else free_intrinsics
        problem = bundle_adjustment_problem(
            state, chosen, noise, ba, self.prior_intrinsics[None],
            Freedom(poses=True, intrinsics=free_intrinsics), camera_motion=self._motion_terms(),
        ).add(self._bridge_terms())  # fmt: skip
        if self.slides:  # the prior holds the gauge
            problem.free = {**problem.free, POSE: np.ones((len(self), 6), dtype=bool)}
        stage = Stage("bundle_adjustment", problem, self.config.incremental.solver)
        kept = {} if self.prior is None else self.prior.reads(state)
        joined = join_additions(self.sources, stage, state, self.added, kept)
        if self.prior is not None:
            joined.stage.problem.add(self.prior.on(joined.state))
        return state, chosen, joined

    def _cameras(self) -> Cameras:
        return Cameras(self.pose, self.intrinsics, self.log_scale)

    def _motion_terms(self) -> list[FactorBatch]:
        """Return E_cam over consecutive frames; others, and bridged ones, say nothing about a constant velocity."""
        first = np.arange(max(len(self) - 2, 0))
        consecutive = self.frame[first + 2] - self.frame[first] == 2
        chosen = consecutive & (self.bridged[first] + self.bridged[first + 1] + self.bridged[first + 2] == 0)
        if not chosen.any():
            return []
        terms = camera_motion_terms(np.arange(len(self)), self.config.incremental.camera_motion, MAP)
        return [batch.take(np.flatnonzero(chosen)) for batch in terms]

    def _bridge_terms(self) -> list[FactorBatch]:
        """Return priors on bridged poses about where constant velocity put them, wider with every frame bridged."""
        rows = np.flatnonzero(self.bridged)
        if len(rows) == 0:
            return []
        sigma = np.repeat([self.config.incremental.bridge_sigma_rad, self.config.incremental.bridge_sigma_m], 3)
        root = np.eye(6) / (sigma * self.bridged[rows][:, None])[:, None, :]
        return [_BRIDGE(rows, root=root, offset=np.zeros((len(rows), 6)), point_0=self.start[rows], term="bridge")]

    def _take(self, state: State) -> None:
        self.pose, self.landmark = state[POSE], state[LANDMARK]
        self.intrinsics, self.log_scale = state[INTRINSICS][0], state[LOG_SCALE][:, 0]

    def _drop(self, state: State, observations: Observations) -> None:
        config, incremental = self.config.bundle_adjustment, self.config.incremental
        rows, row = observations.rows()
        # What a frame's cue says on the whole is its scale, not noise: counted as noise, it would widen the depth
        # prior, which is what holds the scale.
        scale = frame_log_scales(observations, state[POSE], state[LANDMARK][rows][row], len(self))
        groups = {**state.arrays, LANDMARK: state[LANDMARK][rows], LOG_SCALE: scale[:, None]}
        local = State(groups, {LANDMARK: rows})
        # Few keyframes say too little of which tracks depart from the others.
        rule = config.model_copy(update={"min_observations": incremental.min_observations, "trim_sigmas": None})
        kept_state, kept = drop_outliers(local, observations, rule, {})
        code = self.observations.track * (len(self) + 1) + self.observations.frame
        used = self.landmark_track[observations.track] * (len(self) + 1) + observations.frame
        stays = self.landmark_track[kept.track] * (len(self) + 1) + kept.frame
        self.observations = self.observations.select(~np.isin(code, np.setdiff1d(used, stays)))
        if len(kept):
            measured = measure_noise(kept_state, kept, self.noise, config)
            self.noise = _mixed(self.noise, measured, incremental.noise_smoothing if self.slides else 1.0)
            _, row = kept.rows()
            residual = reprojection_residual(kept_state, kept, row)
            self.error_px = float(np.median(np.linalg.norm(residual, axis=1)))
        self._drop_bare_landmarks()

    def _drop_bare_landmarks(self) -> None:
        """Forget landmarks that fewer than two observations are left of: they say nothing and may be singular."""
        count = np.bincount(
            np.searchsorted(self.landmark_track, self._of_landmarks()), minlength=len(self.landmark_track)
        )
        self._keep_landmarks(count >= 2)

    def _of_landmarks(self) -> IntArray:
        track = self.observations.track
        return track[np.isin(track, self.landmark_track)]

    def _keep_landmarks(self, keep: BoolArray) -> None:
        self.landmark_track, self.landmark = self.landmark_track[keep], self.landmark[keep]

    def _leaving_landmarks(self, used: Observations) -> BoolArray:
        """Return the landmarks (N,) to marginalize with the oldest keyframe, see the module's docstring."""
        count = len(self.landmark_track)
        per_landmark = np.bincount(used.track, minlength=count)
        in_oldest, in_newest = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        in_oldest[used.track[used.frame == 0]] = True
        in_newest[used.track[used.frame == len(self) - 1]] = True
        window = self.config.incremental.window
        # Knuth's multiplicative hash: neighboring tracks of a grid get unrelated phases.
        phase = (self.landmark_track * 2654435761 >> 7) % window
        its_turn = (self.slides % window == phase) & (per_landmark >= window // 2)
        return in_oldest & (~in_newest | its_turn)

    def _hand_over(self, state: State, used: Observations, leaving: BoolArray) -> LeftLandmarks:
        chosen = used.select(leaving[used.track])
        rows, _ = chosen.rows()
        part = State({**state.arrays, LANDMARK: state[LANDMARK][rows]})
        error = landmark_errors(part, chosen) if len(rows) else np.zeros(0)
        count = np.bincount(chosen.track, minlength=len(leaving))[rows]
        return LeftLandmarks(self.landmark_track[rows], self.landmark[rows], np.asarray(error, np.float64), count)

    def _clusters(self, used: Observations) -> Clusters | None:
        """Put the landmarks into clusters; the cells are those of the given intrinsics, the same for all time."""
        found = track_cells(used, self.prior_intrinsics, self.config.bundle_adjustment)
        if found is None:
            return None
        cells = np.zeros(len(self.landmark_track), dtype=np.int64)
        cells[np.unique(used.track)] = found.of_landmark
        return replace(found, of_landmark=cells)

    def _reduce(
        self, joined: JoinedStage, used: Observations, leaving: BoolArray
    ) -> tuple[KeyedPrior | None, Spread | None]:
        """Return the prior that the oldest keyframe, its landmarks and what was added to it leave."""
        stage, state = joined.stage, joined.state
        gone = {POSE: np.arange(len(self)) == 0, LOG_SCALE: np.arange(len(self)) == 0}
        for variable in joined.added:
            if "frame" in variable.index:
                number = state.numbers(variable)[:, variable.index.index("frame")]
                gone[variable] = number <= self.frame[0]

        def touches(batch: FactorBatch) -> BoolArray:
            if batch.name == MARGINALIZATION_PRIOR:
                return np.ones(1, dtype=bool)
            out = np.zeros(len(batch), dtype=bool)
            for slot in batch.slots:
                if slot.variable == LANDMARK:
                    out |= leaving[slot.rows]
            if not any(slot.variable == LANDMARK for slot in batch.slots):
                for slot in batch.slots:
                    if slot.variable in gone:
                        out |= gone[slot.variable][slot.rows]
            return out

        batches = tuple(batch.take(np.flatnonzero(touches(batch))) for batch in stage.problem.batches if len(batch))
        # The landmarks that stay are constants here: no factor that reads them is used up.
        free = {v: mask for v, mask in stage.problem.free.items() if v is not LANDMARK}
        rows = np.flatnonzero(leaving)
        place = np.cumsum(leaving) - 1
        batches = tuple(_renumbered(batch, LANDMARK, lambda r: place[r]) for batch in batches)
        part = state.replace({LANDMARK: state[LANDMARK][rows]})
        clusters = self._clusters(used)
        if clusters is not None:
            clusters = replace(clusters, of_landmark=clusters.of_landmark[rows])
        found = marginalize_with_spread(
            batches, part, free, gone, stage.solver, clusters=clusters, carried=self.spread
        )  # fmt: skip
        for variable in joined.added:
            if variable in gone:
                self.added.forget(variable, map(tuple, state.numbers(variable)[gone[variable]].tolist()))
        return (None, None) if found is None else (KeyedPrior.of(found[0], state), found[1])


def _renumbered(batch: FactorBatch, variable: VariableType, rows: Callable[[IntArray], IntArray]) -> FactorBatch:
    slots = tuple(Slot(s.variable, rows(s.rows)) if s.variable is variable else s for s in batch.slots)
    return replace(batch, slots=slots)


def _mixed(old: StaticNoise, new: StaticNoise, part: float) -> StaticNoise:
    def mix(a: float, b: float) -> float:
        return (1.0 - part) * a + part * b

    return StaticNoise(
        mix(old.reprojection_sigma_px, new.reprojection_sigma_px),
        mix(old.depth_sigma, new.depth_sigma),
        mix(old.depth_correlation, new.depth_correlation),
    )
