"""Scenes of one video, grown from the starts that compete, trimmed, and grown anew with other cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.depth_settings import with_smaller_angles
from uni4d_fg.cues.start_limits import OPEN_FOCAL
from uni4d_fg.cues.structure.camera_search import FoundCamera, find_camera, lens_strength, needs_zoom
from uni4d_fg.cues.structure.epipolar import epipolar_geometry
from uni4d_fg.cues.structure.first_pair import stands_still
from uni4d_fg.cues.structure.focal_interval import FocalInterval
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.growth import grow
from uni4d_fg.cues.structure.hypotheses import Competition, Hypothesis, ranked
from uni4d_fg.cues.structure.judging import errors_of
from uni4d_fg.cues.structure.lens_of_pairs import lens_of_pairs
from uni4d_fg.cues.structure.passing_thing import explains_more, most_left_over, only_seems_to_turn
from uni4d_fg.cues.structure.readout import at_one_time, find_readout
from uni4d_fg.cues.structure.reversal import nearer_to_the_tracks
from uni4d_fg.cues.structure.rivals import NEARLY_AS_WELL, Rival, rivals_of
from uni4d_fg.cues.structure.selection import spread_tracks
from uni4d_fg.cues.structure.self_calibration import focal_of_pairs
from uni4d_fg.cues.structure.trimming import trim, trim_and_converge
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.rolling_shutter import Readout
from uni4d_fg.slam.lens.strength import Strength
from uni4d_fg.slam.stages.observations import Observations

_CLEAR_GAIN = 0.02
"""Part of the reprojection energy that a lens must take away where the focal length is open: straight forward
k1 of -0.1 takes 0.8 to 2 %, -0.25 takes 13 %, and it is up to 1.1 % without a lens."""
_FAR_FOCAL, _SHARPER_FOR_IT = 1.5, 0.97
"""A lens that changes an open focal length by more than this factor must leave sharpest errors of at most this part of
the pinhole's: for lenses that were right they were 0.53 to 1.04, the focal length up to 1.39 times as long without; on
a recording whose focal length a lens halves, they were 1.003."""
_HARDLY_TRIMMED = 0.8
"""Part of ``max_reprojection_px`` at which a limit that follows the noise is about where it began."""
_MOST_AGREE = 0.8
"""Part of the tracks that agree with a scene below which something large that moves may have bent it: 0.59 to 0.78
where somebody who sits in the middle of the picture has; 0.76 to 0.97 of scenes that are right, for which it costs a
start that is not taken."""
_SHARPER = 0.85
"""Part of a scene's sharpest errors that another one has, at most, for that to be taken: 0.48 and 0.82 where a scene is
bent; 0.98 and more where both start alike."""
_SAME_PATH = 0.05
"""Part of the extent of a path by which another one departs from it, at which both end at the same scene: 0.02 at most
where a start from the sides of the picture did, 0.25 at least where it led elsewhere."""
_BLUNTER = 1.15
"""Times the sharpest errors of a scene with a pinhole that one with a lens has, at most: up to 1.03 where there is a
lens, as ideal pixels are larger; 1.37 where people who sit in the picture asked for one."""


SceneT = TypeVar("SceneT")


@dataclass(frozen=True)
class StartCameras:
    """Cameras of all frames that may be right."""

    world_T_cam: FloatArray
    """(T, 4, 4)."""
    intrinsics: FloatArray
    """(4,) px."""


@dataclass(frozen=True)
class Grown:
    """A scene, and what it came from."""

    scene: GrowingScene
    hypotheses: list[Hypothesis]
    """The best first."""
    used: Observations
    """Those that starts were grown from."""

    @cached_property
    def sharpness(self) -> float:
        """See :func:`_sharpness`."""
        return _sharpness(self.scene, self.used)


@dataclass(frozen=True)
class Search:
    """What growing scenes of one video has in common."""

    num_frames: int
    image_size: tuple[int, int]
    prior_intrinsics: FloatArray
    config: Config
    reporter: Reporter
    should_stop: Callable[[], bool]
    is_pan: bool
    """Whether the view moves on, see :func:`~uni4d_fg.cues.structure.sweep.sweeps`."""
    start: StartCameras | None = None
    is_trial: bool = False
    """Whether scenes are fitted to another camera in any case: they are not refined to the end, and nobody asks whether
    something that moves has bent them, or passes."""

    def grow(self, observations: Observations, intrinsics: FloatArray, free_focal: bool) -> Grown | None:
        """Let starts compete, and grow and trim the best; None if no two frames have parallax, but for what passes."""
        settings = self.config.geometric_depth
        used = observations.select(spread_tracks(observations, self.image_size, settings.max_tracks))
        closer = replace(self, config=with_smaller_angles(self.config, float(intrinsics[0])))
        first = closer if self.is_pan else self
        found = first._grown(used, intrinsics, free_focal)
        if found is None and first.config != closer.config:  # The camera may hardly move.
            found = closer._grown(used, intrinsics, free_focal)
        rest = None if found is None or self.is_trial else most_left_over(found.scene, used, self.image_size)
        if found is None or rest is None:
            return found
        world = _if_solved(lambda: replace(first, start=None)._grown(rest, intrinsics, free_focal))
        if world is not None and explains_more(world.scene, found.scene, used, self.image_size):
            return replace(world, used=used)
        turns = only_seems_to_turn(rest, self.num_frames, intrinsics, settings, known_focal=not free_focal)
        return None if turns else found

    def trial(self, observations: Observations, intrinsics: FloatArray) -> GrowingScene | None:
        """Return what grows with focal lengths that are held, to be judged beside others; None if nothing does."""
        grown = replace(self, is_trial=True).grow(observations, intrinsics, free_focal=False)
        return None if grown is None else grown.scene

    def _grown(self, used: Observations, intrinsics: FloatArray, free_focal: bool) -> Grown | None:
        settings = self.config.geometric_depth
        epipolar = epipolar_geometry(used, self.num_frames, self.image_size, settings)
        guess = focal_of_pairs(epipolar.fundamental, self.image_size, intrinsics[2:]) if free_focal else None
        competition = Competition(
            used, epipolar.outlier[used.rows()[1]], self.num_frames, self.image_size, intrinsics, self.config,
            free_focal, self.should_stop, guess,
        )  # fmt: skip
        self.reporter.begin("starting views", None)
        hypotheses = competition.run()
        self.reporter.end()
        if not hypotheses or stands_still(_agreeing(hypotheses[0].scene, used), self.num_frames, settings):
            return None
        scene, hypotheses = self._grown_best(competition, hypotheses, used)
        if not self.is_trial and _may_be_bent(scene):
            side = _if_solved(lambda: _start_beside(competition, scene))
            other = None if side is None else _if_sharper(lambda: self._grown_from(side, used), scene, used)
            if side is not None and other is not None:
                scene, hypotheses = other, [competition.of_grown(other, side.pair)]
        return Grown(scene, hypotheses, used)

    def _grown_best(
        self, competition: Competition, hypotheses: list[Hypothesis], used: Observations
    ) -> tuple[GrowingScene, list[Hypothesis]]:
        """Return the scene that the best start, or the cameras that may be right, lead to, and all starts, best first.

        Where these cameras explain nearly as much as any other start, nothing else is grown: what differs by so little
        are trials that end at the same scene.
        """
        best = hypotheses[0]
        if self.start is None:
            return self._grown_from(best, used.select(competition.chosen(best.tracks))), hypotheses
        start = self.start
        known = competition.of_grown(_at_cameras(best.scene, start), best.pair)
        known, *others = sorted(ranked([known, *hypotheses]), key=lambda one: one.scene is not known.scene)
        if known.cost <= others[0].cost + NEARLY_AS_WELL:
            continued = _if_solved(lambda: self._continued(best.scene, start, used))
            if continued is not None:
                return continued, [known, *others]
        scene = self._grown_from(best, used.select(competition.chosen(best.tracks)))
        other = _if_sharper(lambda: self._continued(scene, start, used), scene, used)
        return (scene, hypotheses) if other is None else (other, [competition.of_grown(other, best.pair)])

    def _grown_from(self, start: Hypothesis, observations: Observations) -> GrowingScene:
        """Grow a start over all frames, with tracks that may be others than those of its trial, and trim it."""
        scene = start.scene.seeing(observations, self.config)
        scene.prior_intrinsics = self.prior_intrinsics
        if start.tracks == "sides":
            trim(scene)
            scene.leave_out(scene.left_out | scene.seen_without_point(), scene.limit_px)
        return self._grown_to_the_end(scene)

    def _continued(self, scene: GrowingScene, start: StartCameras, observations: Observations) -> GrowingScene:
        """Return a scene that begins with cameras of all frames, for the rest as another one."""
        other = _at_cameras(scene, start).seeing(observations, self.config)
        trim(other)
        return self._grown_to_the_end(other)

    def _grown_to_the_end(self, scene: GrowingScene) -> GrowingScene:
        grow(scene, self.reporter)
        self.reporter.begin("camera refinement", None)
        (trim if self.is_trial else trim_and_converge)(scene)
        scene = nearer_to_the_tracks(scene)
        self.reporter.end()
        return scene

    def told_by_pairs(self, observations: Observations) -> CameraModel | None:
        """Return the lens that pairs of frames tell of a pan; None where they tell none, or none is looked for."""
        if not self.is_pan or self.config.camera.model != "auto":
            return None
        settings = self.config.geometric_depth
        return lens_of_pairs(observations, self.num_frames, self.image_size, self.prior_intrinsics, settings)

    def find_camera(
        self, grown: Grown, observations: Observations, proposed: CameraModel | None, blur_px: Float32Array | None,
        told: CameraModel | None = None,
    ) -> FoundCamera | None:  # fmt: skip
        """Return the camera that tracks ask for whose pinhole led to ``grown``; None for that, or without a solution.

        The other arguments are those of :func:`~uni4d_fg.cues.structure.camera_search.find_camera`.
        """
        return _if_solved(
            lambda: find_camera(
                grown.scene, observations, self.image_size, self.config, self.trial, proposed, blur_px, told
            )
        )

    def grow_with(
        self, observations: Observations, found: FoundCamera, free_focal: bool
    ) -> tuple[Grown, FoundCamera, Observations] | None:
        """Return what grows with a camera that was found, that camera, and its ideal observations.

        Where it was refined from what pairs of frames tell, that is tried as well, and the sharper scene is taken: with
        a pan, what moves may lead a lens away.
        """
        trials = []
        for camera in [found.camera] if found.told is None else [found.camera, found.told]:
            ideal = camera.ideal_observations(observations)
            grown = self.grow(ideal, camera.intrinsics, free_focal)
            if grown is not None:
                trials.append((grown, replace(found, camera=camera), ideal))
        return min(trials, key=lambda trial: trial[0].sharpness, default=None)

    def needs_zoom(self, real: Observations, intrinsics: FloatArray, blur_px: Float32Array | None) -> bool:
        """Tell whether tracks (as the images show them) ask for a zoom of a scene that is grown without one."""
        self.reporter.begin("lens and zoom", None)
        plain = _if_solved(lambda: replace(self, reporter=SilentReporter(), start=None).grow(real, intrinsics, True))
        needed = plain is None or needs_zoom(plain.scene, self.config, blur_px)
        self.reporter.end()
        return needed

    def at_one_time(
        self, grown: Grown, observations: Observations, intrinsics: FloatArray
    ) -> tuple[Grown, Observations, Readout | None]:
        """Return a scene of tracks at the time of the middle row, these, and the readout; where none is told, as given.

        The focal lengths are free.
        """
        try:
            readout = find_readout(grown.scene, observations, self.image_size)
            if readout is not None:
                moved = at_one_time(observations, readout, self.image_size)
                again = self.grow(moved, intrinsics, free_focal=True)
                if again is not None:
                    return again, moved, readout
        except SolverError:  # The scene of the tracks as they are is no worse for it.
            pass
        return grown, observations, None

    def holding_rivals(self, focal: FocalInterval, rivals: list[Rival]) -> FocalInterval:
        """Return an interval that also holds the focal lengths of other starts, as far as cameras have such ones."""
        usual = np.array(self.config.geometric_depth.usual_focal) * max(self.image_size)
        return focal.holding([rival.focal for rival in rivals if usual[0] <= rival.focal <= usual[1]])

    def is_weak(self, camera: CameraModel) -> bool:
        """Tell whether a lens bends images so little that errors of tracks may do the same."""
        return lens_strength(camera, self.image_size, self.config) is Strength.WEAK

    def tells_lens(self, plain: Grown, grown: Grown, found: FoundCamera, is_open: bool) -> bool:
        """Tell whether tracks that leave a lens, and scenes grown without and with it, leave no doubt of the lens.

        Where they leave the focal length open (``is_open``), as straight forward, they leave distortion open as well,
        unless it explains much; and where it also makes quite another focal length, unless the sharpest errors are
        smaller for it. A weak lens is also doubted where starts end at focal lengths so far from each other that a run
        says so: an error that bends the scene of one of them bends the lens, too.
        """
        if is_open and found.lens_gain < _CLEAR_GAIN:
            return False
        is_far = abs(np.log(grown.scene.mean_focal / plain.scene.mean_focal)) > np.log(_FAR_FOCAL)
        if grown.sharpness > (_SHARPER_FOR_IT if is_open and is_far else _BLUNTER) * plain.sharpness:
            return False
        if not self.is_weak(found.camera):
            return True
        rivals = rivals_of(grown.hypotheses, grown.scene.world_T_cam)
        focal = grown.scene.mean_focal
        return self.holding_rivals(FocalInterval(focal, focal), rivals).reach(focal) <= OPEN_FOCAL


def _start_beside(competition: Competition, scene: GrowingScene) -> Hypothesis | None:
    """Return the start from the sides of the picture, trimmed; None where it gives no scene, or has the path of this.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If it cannot be trimmed.
    """
    side = competition.at_sides()
    if side is None:
        return None
    trim(side.scene)
    posed = np.flatnonzero(side.scene.registered & scene.registered)
    path, other = scene.world_T_cam[posed], side.scene.world_T_cam[posed]
    apart = align_trajectories(other, path).apply(other[:, :3, 3]) - path[:, :3, 3]
    is_same = np.linalg.norm(apart) < _SAME_PATH * np.linalg.norm(path[:, :3, 3] - path[:, :3, 3].mean(axis=0))
    return None if is_same else side


def _at_cameras(scene: GrowingScene, start: StartCameras) -> GrowingScene:
    """Return a scene with cameras of all frames."""
    return replace(
        scene, world_T_cam=start.world_T_cam, intrinsics=start.intrinsics,
        registered=np.ones(len(start.world_T_cam), dtype=bool),
    )  # fmt: skip


def _agreeing(scene: GrowingScene, observations: Observations) -> Observations:
    """Return all observations of the tracks that agree with a scene of some of them."""
    return observations.select(np.isin(observations.track, scene.used()[0].track))


def _if_solved(grow_other: Callable[[], SceneT | None]) -> SceneT | None:
    """Return another scene or camera, or None where it cannot be solved: that is no reason to do without the others."""
    try:
        return grow_other()
    except SolverError:
        return None


def _if_sharper(
    grow_other: Callable[[], GrowingScene], scene: GrowingScene, observations: Observations
) -> GrowingScene | None:
    """Return another scene if it can be solved and explains what is seen more sharply than this one."""
    other = _if_solved(grow_other)
    if other is None:
        return None
    return other if _sharpness(other, observations) < _SHARPER * _sharpness(scene, observations) else None


def _sharpness(scene: GrowingScene, observations: Observations) -> float:
    """Return the error, px, that a quarter of what is seen does not reach with the cameras of a scene.

    Cameras that are bent by things that move explain as many tracks as those of the world, but none of them as well.
    """
    return float(np.quantile(errors_of(scene.seeing(observations), observations), 0.25))


def _may_be_bent(scene: GrowingScene) -> bool:
    """Tell whether no majority agrees with a trimmed scene to much less than tracks may be off, or many do not."""
    agrees = np.isfinite(scene.position[:, 0]) & ~scene.left_out
    blunt_px = _HARDLY_TRIMMED * scene.config.geometric_depth.max_reprojection_px
    return bool(np.median(scene.limit_px) >= blunt_px or np.mean(agrees) < _MOST_AGREE)
