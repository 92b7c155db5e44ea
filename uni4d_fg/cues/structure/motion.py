"""Structure from motion over a video: from tracks to cameras and static points, up to scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.depth_settings import with_smaller_angles, without_rolling_shutter
from uni4d_fg.cues.start_limits import OPEN_FOCAL
from uni4d_fg.cues.structure.all_tracks import points_of_all_tracks
from uni4d_fg.cues.structure.camera_fit import zoom_freedom
from uni4d_fg.cues.structure.camera_search import FoundCamera, find_camera, lens_strength, needs_zoom
from uni4d_fg.cues.structure.epipolar import epipolar_geometry
from uni4d_fg.cues.structure.first_pair import CommonTracks, FramePair, rank_pairs
from uni4d_fg.cues.structure.focal_interval import FocalInterval, focal_interval, focal_is_open
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.growth import grow
from uni4d_fg.cues.structure.hypotheses import Competition, Hypothesis, ranked
from uni4d_fg.cues.structure.judging import errors_of
from uni4d_fg.cues.structure.passing_thing import explains_more, most_left_over, only_seems_to_turn
from uni4d_fg.cues.structure.readout import at_one_time, find_readout, is_told_still
from uni4d_fg.cues.structure.reversal import nearer_to_the_tracks
from uni4d_fg.cues.structure.rivals import NEARLY_AS_WELL, Rival, rivals_of
from uni4d_fg.cues.structure.selection import spread_tracks
from uni4d_fg.cues.structure.self_calibration import focal_of_pairs
from uni4d_fg.cues.structure.sweep import view_sweep
from uni4d_fg.cues.structure.triangulation import Points
from uni4d_fg.cues.structure.trimming import trim, trim_and_converge
from uni4d_fg.cues.structure.two_view import fit_rotation
from uni4d_fg.errors import Cancelled, SolverError
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.rolling_shutter import Readout
from uni4d_fg.slam.lens.strength import Strength
from uni4d_fg.slam.stages.observations import Observations

_CLEAR_GAIN = 0.02
"""Part of the reprojection energy that a lens must take away where the focal length is open: straight forward
k1 of -0.1 takes 0.8 to 2 %, -0.25 takes 13 %, and it is up to 1.1 % without a lens."""
_HARDLY_TRIMMED = 0.8
"""Part of ``max_reprojection_px`` at which a limit that follows the noise is about where it began."""
_SWEPT = 0.5
"""Part of the picture by which its content moves on from which far points tell turns and focal length: 1.0 to 1.5 of
pans, up to 0.36 of other clips. Where a view stays, they would let a thing that passes be the world."""
_MOST_AGREE = 0.8
"""Part of the tracks that agree with a scene below which something large that moves may have bent it: 0.59 to 0.78
where somebody who sits in the middle of the picture has; 0.76 to 0.97 of scenes that are right, for which it costs a
start that is not taken."""
_SHARPER = 0.85
"""Part of a scene's sharpest errors that another one has, at most, for that to be taken: 0.48 and 0.82 where a scene is
bent; 0.98 and more where both start alike."""
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
class Structure:
    """Cameras and points, up to one scale."""

    world_T_cam: FloatArray
    """(T, 4, 4)."""
    camera: CameraModel
    """Intrinsics, lens and zoom; errors, noise and focal lengths are those of its ideal pixels."""
    registered: BoolArray
    """(T,) False for frames that are bridged."""
    track: IntArray
    """(M,) tracks that were triangulated."""
    points: Points
    """M points, NaN where a track cannot be triangulated."""
    moving: BoolArray
    """(M,) tracks that contradict a static point: half of their errors are beyond the limit for tracks."""
    stray: BoolArray
    """(N,) observations, of those given, that are of another static surface than most of their track."""
    sigma_px: float
    """Noise of the tracks (robust standard deviation of a reprojection residual)."""
    pair: FramePair
    """The two frames it started from."""
    focal: FocalInterval
    """Focal lengths that explain the tracks as well."""
    focal_sigma: float
    """Standard deviation of the log of the focal lengths that were found; 0 for those that were held."""
    unexplained: float
    """Part of the held-out observations of the first frames that their cameras leave unexplained, see
    :class:`~uni4d_fg.cues.structure.judging.HeldOut`."""
    rivals: list[Rival]
    """Starts that explain them nearly as well."""
    readout: Readout | None = None
    """How images are read, in units of the time between two; None where all rows are read at once. Cameras and points
    are then those of the middle rows."""
    denied_px: float = 0.0
    """How far distortion that explains the tracks better, but that no lens has, moves a pixel at most; 0 without."""

    @property
    def intrinsics(self) -> FloatArray:
        """(4,) px."""
        return self.camera.intrinsics

    @property
    def parallax_px(self) -> float:
        """By how much the median track shows its point from other sides, px at the middle of the image; 0 without."""
        angle = self.points.angle[np.isfinite(self.points.position[:, 0])]
        return float(np.median(angle) * np.mean(self.intrinsics[:2])) if len(angle) else 0.0


def observations_of_tracks(tracks: Tracks, which: BoolArray) -> Observations:
    """Return what is seen of some tracks (K,) at least twice, without depth."""
    track, frame = np.nonzero(tracks.visible & which[:, None])
    uv = tracks.uv[track, frame].astype(np.float64)
    observations = Observations(
        track.astype(np.int64), frame.astype(np.int64), uv, np.full(len(track), np.nan), np.ones(len(track))
    )
    return observations.with_min_observations(2)


def structure_from_motion(
    observations: Observations,
    num_frames: int,
    image_size: tuple[int, int],
    intrinsics: FloatArray,
    config: Config,
    reporter: Reporter,
    should_stop: Callable[[], bool],
    with_doubts: bool = True,
    camera: CameraModel | None = None,
    any_camera: bool = False,
    proposed: CameraModel | None = None,
    blur_px: Float32Array | None = None,
    start: StartCameras | None = None,
) -> Structure | None:
    """Find cameras and static points from tracks.

    Args:
        observations: Observations of static tracks; some of them may move all the same.
        num_frames: T.
        image_size: (height, width), px.
        intrinsics: (4,) known, or a guess when ``config.input.intrinsics`` is 'free'.
        config: Sections ``geometric_depth``, ``bundle_adjustment`` and ``input``.
        reporter: Told the steps, and the number of frames that have a pose.
        should_stop: Polled before every frame.
        with_doubts: Also look for what the tracks leave open; else there is one focal length and no rival.
        camera: A lens or a zoom that is known; None for a pinhole.
        any_camera: Also look for a lens and a zoom, as section ``camera`` says, where intrinsics are free and none is
            known; a known zoom must be asked for by these tracks, too.
        proposed: Then also try the zoom of this camera.
        blur_px: (T,) length of the motion blur of each frame, where it is known: sharp ones tell a lens.
        start: Cameras that are taken instead of those that starting views lead to where they explain the tracks better.

    Returns:
        The structure, or None if no two frames have enough parallax to see depth.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    settings = config.geometric_depth
    free_focal = config.input.intrinsics == "free"
    if should_stop():
        raise Cancelled("structure from motion stopped")
    sweeps = view_sweep(observations, num_frames, image_size) > _SWEPT
    search = _Search(num_frames, image_size, intrinsics, config, reporter, should_stop, sweeps, start)
    if any_camera and camera is not None and camera.zoom is not None:
        camera = camera if search.needs_zoom(observations, intrinsics, blur_px) else None
    known, seen = camera, observations
    if camera is None or camera.is_plain:
        camera = CameraModel(intrinsics)
    observations = camera.ideal_observations(observations)
    grown = search.grow(observations, camera.intrinsics, free_focal)
    if grown is None:
        return None
    beside: list[float] = []  # focal lengths, px, of cameras that explain the tracks nearly as well
    readout, denied_px = None, 0.0
    if any_camera and free_focal and camera.is_plain:
        reporter.begin("lens and zoom", None)
        quiet = replace(search, reporter=SilentReporter())
        if not config.camera.reads_at_once:
            grown, observations, readout = quiet.at_one_time(grown, observations, camera.intrinsics)
        try:
            found = find_camera(
                grown.scene, observations, image_size, config,
                quiet.trial, proposed, blur_px,
            )  # fmt: skip
        except SolverError:  # That of another camera is no reason to do without this one.
            found = None
        reporter.end()
        if found is not None:
            beside += found.open_focal
            denied_px = found.denied_px
        if found is not None and not found.camera.is_plain:
            ideal = found.camera.ideal_observations(observations)
            again = search.grow(ideal, found.camera.intrinsics, free_focal)
            if again is not None:
                is_lens = not found.camera.lens.is_pinhole
                is_open = is_lens and any(focal_is_open(each.scene, image_size) for each in (grown, again))
                taken = not is_lens or search.tells_lens(grown, again, found, is_open)
                if is_open or (taken and search.is_weak(found.camera)):
                    beside.append((grown if taken else again).scene.mean_focal)
                if taken and readout is not None and not is_told_still(again.scene, ideal, readout, image_size):
                    return structure_from_motion(
                        seen, num_frames, image_size, intrinsics, without_rolling_shutter(config), reporter,
                        should_stop, with_doubts, known, any_camera, proposed, blur_px, start,
                    )  # fmt: skip
                if taken:
                    grown, camera, observations = again, found.camera, ideal
    scene, hypotheses, best = grown.scene, grown.hypotheses, grown.hypotheses[0]
    reporter.begin("focal lengths", None)
    sigma = scene.measure_noise()
    if with_doubts and only_turns(scene, scene.used()[0]):
        reporter.end()
        return None
    poses = _bridge(scene.world_T_cam, scene.registered)
    found_focal = scene.mean_focal
    rivals, focal = list[Rival](), FocalInterval(found_focal, found_focal)
    focal_sigma = 0.0
    if with_doubts:
        rivals = rivals_of(hypotheses, poses)
        freedom = zoom_freedom(scene, config) if free_focal and camera.zoom is not None else 1.0
        focal = focal_interval(scene, image_size, freedom)
        if free_focal:
            focal = search.holding_rivals(focal, rivals).holding(beside)
            focal_sigma = focal.deviation
        if free_focal and focal.is_wide:
            likely = focal.likely(found_focal, float(np.mean(intrinsics[:2])), settings.focal_log_sigma)
            focal = focal.holding([likely])
            focal_sigma = focal.likely_sigma(settings.focal_log_sigma)
            scene.hold_focal(likely)
            sigma = scene.measure_noise()
            poses = _bridge(scene.world_T_cam, scene.registered)
    track, points, moving, stray = points_of_all_tracks(observations, poses, scene)
    reporter.end()
    return Structure(
        poses, camera.with_intrinsics(scene.intrinsics), scene.registered, track, points, moving, stray, sigma,
        best.pair, focal, focal_sigma, best.unexplained, rivals, readout, denied_px,
    )  # fmt: skip


@dataclass(frozen=True)
class _Grown:
    scene: GrowingScene
    hypotheses: list[Hypothesis]
    """The best first."""
    used: Observations
    """Those that starts were grown from."""


@dataclass(frozen=True)
class _Search:
    """What growing scenes of one video has in common."""

    num_frames: int
    image_size: tuple[int, int]
    prior_intrinsics: FloatArray
    config: Config
    reporter: Reporter
    should_stop: Callable[[], bool]
    sweeps: bool
    """Whether the view moves on, see :data:`_SWEPT`."""
    start: StartCameras | None = None

    def grow(
        self, observations: Observations, intrinsics: FloatArray, free_focal: bool, *, is_trial: bool = False
    ) -> _Grown | None:
        """Let starts compete, and grow and trim the best; None if no two frames have parallax, but for what passes.

        Whether something that passes was taken for the world is not asked of a trial, which is judged beside others.
        """
        settings = self.config.geometric_depth
        used = observations.select(spread_tracks(observations, self.image_size, settings.max_tracks))
        closer = replace(self, config=with_smaller_angles(self.config, float(intrinsics[0])))
        first = closer if self.sweeps else self
        found = first._grown(used, intrinsics, free_focal)
        if found is None and first.config != closer.config:  # The camera may hardly move.
            found = closer._grown(used, intrinsics, free_focal)
        rest = None if found is None or is_trial else most_left_over(found.scene, used, self.image_size)
        if found is None or rest is None:
            return found
        world = _if_solved(lambda: replace(first, start=None)._grown(rest, intrinsics, free_focal))
        if world is not None and explains_more(world.scene, found.scene, used, self.image_size):
            return replace(world, used=used)
        turns = only_seems_to_turn(rest, self.num_frames, intrinsics, settings, known_focal=not free_focal)
        return None if turns else found

    def trial(self, observations: Observations, intrinsics: FloatArray) -> GrowingScene | None:
        """Return what grows with focal lengths that are held, to be judged beside others; None if nothing does."""
        grown = self.grow(observations, intrinsics, free_focal=False, is_trial=True)
        return None if grown is None else grown.scene

    def _grown(self, used: Observations, intrinsics: FloatArray, free_focal: bool) -> _Grown | None:
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
        if not hypotheses:
            return None
        scene, hypotheses = self._grown_best(competition, hypotheses, used)
        if _may_be_bent(scene) and (side := competition.at_sides()) is not None:
            other = _if_sharper(lambda: self._grown_from(side, used), scene, used)
            if other is not None:
                scene, hypotheses = other, [competition.of_grown(other, side.pair)]
        return _Grown(scene, hypotheses, used)

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
        of_some = start.tracks == "sides"
        if of_some:
            trim(start.scene)
        scene = start.scene.seeing(observations, self.config)
        scene.prior_intrinsics = self.prior_intrinsics
        if of_some:
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
        trim_and_converge(scene)
        return nearer_to_the_tracks(scene)

    def needs_zoom(self, real: Observations, intrinsics: FloatArray, blur_px: Float32Array | None) -> bool:
        """Tell whether tracks (as the images show them) ask for a zoom of a scene that is grown without one."""
        self.reporter.begin("lens and zoom", None)
        plain = _if_solved(lambda: replace(self, reporter=SilentReporter(), start=None).grow(real, intrinsics, True))
        needed = plain is None or needs_zoom(plain.scene, self.config, blur_px)
        self.reporter.end()
        return needed

    def at_one_time(
        self, grown: _Grown, observations: Observations, intrinsics: FloatArray
    ) -> tuple[_Grown, Observations, Readout | None]:
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

    def tells_lens(self, plain: _Grown, grown: _Grown, found: FoundCamera, is_open: bool) -> bool:
        """Tell whether tracks that leave a lens, and scenes grown without and with it, leave no doubt of the lens.

        Where they leave the focal length open (``is_open``), as straight forward, they leave distortion open as well,
        unless it explains much. A weak lens is also doubted where starts end at focal lengths so far from each other
        that a run says so: an error that bends the scene of one of them bends the lens, too.
        """
        if is_open and found.lens_gain < _CLEAR_GAIN:
            return False
        if _sharpness(grown.scene, grown.used) > _BLUNTER * _sharpness(plain.scene, plain.used):
            return False
        if not self.is_weak(found.camera):
            return True
        rivals = rivals_of(grown.hypotheses, grown.scene.world_T_cam)
        focal = grown.scene.mean_focal
        return self.holding_rivals(FocalInterval(focal, focal), rivals).reach(focal) <= OPEN_FOCAL


def _at_cameras(scene: GrowingScene, start: StartCameras) -> GrowingScene:
    """Return a scene with cameras of all frames."""
    return replace(
        scene, world_T_cam=start.world_T_cam, intrinsics=start.intrinsics,
        registered=np.ones(len(start.world_T_cam), dtype=bool),
    )  # fmt: skip


def _if_solved(grow_other: Callable[[], SceneT | None]) -> SceneT | None:
    """Return another scene, or None where it cannot be solved: that is no reason to do without the other starts."""
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


def only_turns(scene: GrowingScene, used: Observations) -> bool:
    """Tell whether, at the focal length that was found, a rotation explains what any two frames see.

    At another focal length a camera that only turns seems to move.
    """
    settings = scene.config.geometric_depth
    pairs = rank_pairs(used, len(scene.registered), scene.intrinsics, settings, known_focal=True)
    return max((pair.parallax.median for pair in pairs), default=0.0) < settings.min_parallax_px


def rotations_only(observations: Observations, num_frames: int, intrinsics: FloatArray) -> FloatArray:
    """Return poses (T, 4, 4) of a camera that only turns, from one frame to the next; frame 0 is the world."""
    common = CommonTracks(observations, num_frames)
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    for frame in range(1, num_frames):
        a, b = common.between(frame - 1, frame)
        turn = np.eye(3)
        if len(a) >= 3:
            turn = fit_rotation(observations.uv[a], observations.uv[b], intrinsics)
        poses[frame, :3, :3] = poses[frame - 1, :3, :3] @ turn.T
    return poses


def _bridge(world_T_cam: FloatArray, registered: BoolArray) -> FloatArray:
    """Give frames without a pose one between those of their neighbors; at the ends the nearest one."""
    known = np.flatnonzero(registered)
    frame = np.clip(np.arange(len(registered)), known[0], known[-1])
    out = world_T_cam.copy()
    turned = Slerp(known, Rotation.from_matrix(world_T_cam[known, :3, :3]))(frame).as_matrix()
    moved = np.stack([np.interp(frame, known, world_T_cam[known, a, 3]) for a in range(3)], axis=1)
    missing = ~registered
    out[missing, :3, :3], out[missing, :3, 3] = turned[missing], moved[missing]
    return out
