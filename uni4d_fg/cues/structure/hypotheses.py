"""Several beginnings that compete: each is grown on some frames and tracks, and judged by what it explains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.structure.first_pair import FramePair, has_parallax, rank_pairs
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.growth import grow
from uni4d_fg.cues.structure.judging import HeldOut, held_out
from uni4d_fg.cues.structure.selection import mean_pixels, spread_tracks
from uni4d_fg.cues.structure.self_calibration import FocalGuess
from uni4d_fg.errors import Cancelled, SolverError
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.progress import SilentReporter
from uni4d_fg.slam.stages.observations import Observations

_TRIAL_GROWTH = 1.7
"""Bundle adjustment of a trial is repeated whenever its frames have grown by this factor."""
_TRIAL_ITERATIONS = 15
_UNUSUAL = 0.2
"""What an unusual focal length adds to the unexplained part."""
_MUCH = 0.25
"""From this part of the tracks on, those that disagree with the majority may be the world."""
_SIGMAS = 3.0
"""Errors up to so many standard deviations of the noise are explained by it."""
_ENOUGH = 0.2
"""Starts that explain less than this part of what is held out do not tell the noise of the tracks."""
_OVERLAP = 0.5
"""Pairs that overlap by more than this part of their union are one start."""
_MOST_FAIL = 0.5
"""Where fewer than this part of the best pairs give a scene, those with the most common tracks are tried as well."""
_SIDE = 0.25
"""Part of the picture's width that a side of it has."""

Part = Literal["majority", "minority", "all", "sides"]
"""Tracks that agree with the epipolar geometry of most of the picture, those that do not, or both; or those at the left
and right of the picture."""


@dataclass(frozen=True)
class Hypothesis:
    """A start that was tried."""

    pair: FramePair
    tracks: Part
    """Which tracks took part."""
    scene: GrowingScene
    """What it grew to, on few frames and tracks."""
    frames: IntArray
    """(t,) frames of the trial."""
    held_out: HeldOut
    """Its errors where it was judged."""
    noise_px: float
    """Noise of the tracks that it agrees with."""
    is_usual: bool
    """Whether its focal length is one that cameras have."""
    misfit: float
    """Part of the held-out observations that errs by more than the noise of the tracks, see :func:`ranked`."""

    @property
    def unexplained(self) -> float:
        """Part of them that errs by more than points may, see ``max_reprojection_px``."""
        return self.held_out.unexplained(self.scene.config.geometric_depth.max_reprojection_px)

    @property
    def cost(self) -> float:
        """What it is ranked by."""
        return self.misfit + (0.0 if self.is_usual else _UNUSUAL)


@dataclass
class Competition:
    """What all the trials share."""

    observations: Observations
    outlier: BoolArray
    """(N,) observations of tracks that disagree with the majority."""
    num_frames: int
    image_size: tuple[int, int]
    intrinsics: FloatArray
    config: Config
    free_focal: bool
    should_stop: Callable[[], bool]
    guess: FocalGuess | None = None
    """What pairs of frames tell of the focal length; None if nothing, or if it is not sought."""
    picked: dict[tuple[int, ...], tuple[IntArray, Observations, BoolArray]] = field(default_factory=dict)
    """What trials on the same frames share."""

    def run(self) -> list[Hypothesis]:
        """Try starts; return those that give a scene, the best first.

        Raises:
            Cancelled: If asked to stop.
        """
        settings = self.config.geometric_depth
        pairs = self.pairs("majority")
        chosen = distinct(pairs, settings.tried_pairs)
        starts: list[tuple[FramePair, Part]] = [(pair, "majority") for pair in chosen]
        if self.outlier.any():
            starts += [(pair, "all") for pair in chosen[:1]]
        if self.outlier.mean() >= _MUCH:
            starts += [(pair, "minority") for pair in self.pairs("minority")[:1]]
        first, *factors = self.factors()
        found = self.trials([(pair, first, part) for pair, part in starts])
        if sum(one.tracks == "majority" for one in found) < _MOST_FAIL * len(chosen):
            sturdy = [pair for pair in distinct(in_common(pairs), settings.tried_pairs) if pair not in chosen]
            found += self.trials([(pair, first, "majority") for pair in sturdy])
        found = ranked(found)
        if found and self.free_focal:
            best = found[0]
            found = ranked(found + self.trials([(best.pair, factor, best.tracks) for factor in factors]))
        return found

    def at_sides(self) -> Hypothesis | None:
        """Return the start from what is seen at the sides of the picture; None where that gives no scene.

        A person who hardly moves but fills the middle of the picture bends every start that is made with them, so that
        no majority is left: beside them the scene is seen alone, and with its cameras they are told apart.

        Raises:
            Cancelled: If asked to stop.
        """
        pairs = self.pairs("sides")
        return self.trial(pairs[0], self.factors()[0], "sides") if pairs else None

    def factors(self) -> list[float]:
        """Return the focal lengths to start from, as parts of the given ones; that for all pairs first."""
        starts = [1.0, *(factor for factor in self.config.geometric_depth.focal_starts if factor != 1.0)]
        if self.guess is None:
            return starts
        told = self.guess.focal / float(np.mean(self.intrinsics[:2]))
        return [told, *starts] if self.guess.is_agreed else [*starts, told]

    def chosen(self, part: Part) -> BoolArray:
        """Return (N,) which observations belong to a part of the tracks."""
        if part == "all":
            return np.ones(len(self.outlier), dtype=bool)
        if part == "sides":
            return at_sides(self.observations, self.image_size)
        return self.outlier if part == "minority" else ~self.outlier

    def pairs(self, part: Part) -> list[FramePair]:
        """Return the pairs of frames between which a part of the tracks has parallax, the best first."""
        settings = self.config.geometric_depth
        seen = self.observations.select(self.chosen(part))
        if len(seen) == 0:
            return []
        ranked = rank_pairs(seen, self.num_frames, self.intrinsics, settings, known_focal=not self.free_focal)
        return [pair for pair in ranked if has_parallax(pair, settings)]

    def trials(self, starts: list[tuple[FramePair, float, Part]]) -> list[Hypothesis]:
        """Return what starts give a scene, side by side, in their order. Raises Cancelled."""
        found = map_in_order(lambda start: self.trial(*start), starts, thread_count())
        return [one for one in found if one is not None]

    def trial(self, pair: FramePair, factor: float, part: Part) -> Hypothesis | None:
        """Start from a pair, add frames around it, and judge; None if the pair gives no points."""
        if self.should_stop():
            raise Cancelled("structure from motion stopped")
        settings = self.config.geometric_depth
        frames = trial_frames(pair, self.num_frames, settings.trial_step, settings.trial_frames)
        chosen, judged, kept_out = self._picked(frames)
        used = judged.select(~kept_out & self.chosen(part)[chosen])
        if len(used) == 0:
            return None
        scene = GrowingScene.empty(
            used.with_min_observations(2),
            self.num_frames,
            self.intrinsics * np.array([factor, factor, 1.0, 1.0]),
            _quick(self.config),
            free_focal=self.free_focal,
            prior_intrinsics=self.intrinsics,
            should_stop=self.should_stop,
        )
        try:
            if scene.start(pair) < settings.min_pose_points:
                return None
            grow(scene, SilentReporter(), growth=_TRIAL_GROWTH)
        except SolverError:
            return None
        return self._judged(scene, pair, part, frames, judged.select(kept_out))

    def of_grown(self, scene: GrowingScene, pair: FramePair) -> Hypothesis:
        """Return the cameras of a grown scene as a start from a pair, judged like the others."""
        settings = self.config.geometric_depth
        frames = trial_frames(pair, self.num_frames, settings.trial_step, settings.trial_frames)
        _, judged, kept_out = self._picked(frames)
        part = scene.seeing(judged.select(~kept_out), _quick(self.config))
        part.take_out(np.setdiff1d(np.arange(self.num_frames), frames))
        return self._judged(part, pair, "all", frames, judged.select(kept_out))

    def _judged(
        self, scene: GrowingScene, pair: FramePair, part: Part, frames: IntArray, kept_out: Observations
    ) -> Hypothesis:
        settings = self.config.geometric_depth
        focal = scene.mean_focal / max(self.image_size)
        is_usual = settings.usual_focal[0] <= focal <= settings.usual_focal[1] or not self.free_focal
        held_out = HeldOut.of(scene, kept_out, self.image_size)
        return Hypothesis(
            pair, part, scene, frames, held_out, noise_px=scene.noise_of_good(), is_usual=is_usual,
            misfit=held_out.unexplained(settings.max_reprojection_px),
        )  # fmt: skip

    def _picked(self, frames: IntArray) -> tuple[IntArray, Observations, BoolArray]:
        """Return the observations (n,) that trials on some frames use, in full as well, and which (n,) are held out."""
        key = tuple(frames.tolist())
        if key not in self.picked:
            settings = self.config.geometric_depth
            inside = np.flatnonzero(np.isin(self.observations.frame, frames))
            seen = self.observations.select(inside)
            chosen = inside[spread_tracks(seen, self.image_size, settings.trial_tracks)]
            judged = self.observations.select(chosen)
            self.picked[key] = chosen, judged, held_out(judged, settings.held_out_every)
        return self.picked[key]


def ranked(found: list[Hypothesis]) -> list[Hypothesis]:
    """Return starts in the order of how much they explain to within the noise of the tracks, the best first.

    A large thing near the camera that moves, or a focal length that is wrong, bends a scene until it explains many
    tracks to within some pixels, more of them than the world does; the world explains its own to the noise. That noise
    is the least that a start has which explains enough.
    """
    sharp = [one.noise_px for one in found if one.held_out.share_within(_SIGMAS * one.noise_px) >= _ENOUGH]
    if sharp:
        config = found[0].scene.config
        noise = max(min(sharp), config.bundle_adjustment.min_reprojection_sigma_px)  # tracks may be exact
        limit = min(_SIGMAS * noise, config.geometric_depth.max_reprojection_px)
        found = [replace(one, misfit=one.held_out.unexplained(limit)) for one in found]
    return sorted(found, key=lambda one: one.cost)


def at_sides(observations: Observations, image_size: tuple[int, int]) -> BoolArray:
    """Return (N,) which observations are of tracks that are seen at the left or right of the picture, in the mean."""
    pixels, row = mean_pixels(observations)
    x, width = pixels[:, 0], image_size[1]
    beside = (x < _SIDE * width) | (x > (1.0 - _SIDE) * width)
    return np.asarray(beside[row])


def trial_frames(pair: FramePair, num_frames: int, steps: int, count: int) -> IntArray:
    """Return up to ``count`` frames around a pair, both of its frames among them, (t,) ascending."""
    between = np.unique(np.linspace(pair.first, pair.second, steps + 1).round().astype(np.int64))
    step = max(1, round((pair.second - pair.first) / steps))
    before = np.arange(pair.first - step, -1, -step)
    after = np.arange(pair.second + step, num_frames, step)
    room = max(0, count - len(between))
    # As many on either side as there are, the nearest first.
    left = min(len(before), max(room // 2, room - len(after)))
    return np.sort(np.concatenate([before[:left], between, after[: room - left]]))


def in_common(pairs: list[FramePair]) -> list[FramePair]:
    """Return pairs, those with the most common tracks first.

    Where a camera turns fast or its images are blurred tracks are short: a wide baseline has too few of them.
    """
    return sorted(pairs, key=lambda pair: -pair.common)


def distinct(pairs: list[FramePair], count: int) -> list[FramePair]:
    """Return the best ``count`` pairs that do not overlap much; then others, where there are too few."""
    chosen: list[FramePair] = []
    for pair in pairs:
        if len(chosen) < count and all(_overlap(pair, other) <= _OVERLAP for other in chosen):
            chosen.append(pair)
    rest = [pair for pair in pairs if pair not in chosen]
    return chosen + rest[: count - len(chosen)]


def _overlap(a: FramePair, b: FramePair) -> float:
    shared = min(a.second, b.second) - max(a.first, b.first)
    return max(shared, 0) / (max(a.second, b.second) - min(a.first, b.first))


def _quick(config: Config) -> Config:
    solver = config.bundle_adjustment.solver
    solver = solver.model_copy(update={"max_iterations": min(solver.max_iterations, _TRIAL_ITERATIONS)})
    return config.model_copy(
        update={"bundle_adjustment": config.bundle_adjustment.model_copy(update={"solver": solver})}
    )
