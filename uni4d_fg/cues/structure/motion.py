"""Structure from motion over a video: from tracks to cameras and static points, up to scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.depth_settings import without_rolling_shutter
from uni4d_fg.cues.structure.all_tracks import points_of_all_tracks
from uni4d_fg.cues.structure.camera_fit import zoom_freedom
from uni4d_fg.cues.structure.first_pair import CommonTracks, FramePair, rank_pairs
from uni4d_fg.cues.structure.focal_interval import FocalInterval, focal_interval, focal_is_open
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.readout import is_told_still
from uni4d_fg.cues.structure.rivals import Rival, rivals_of
from uni4d_fg.cues.structure.search import Search, StartCameras
from uni4d_fg.cues.structure.sweep import sweeps
from uni4d_fg.cues.structure.triangulation import Points
from uni4d_fg.cues.structure.two_view import fit_rotation
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.rolling_shutter import Readout
from uni4d_fg.slam.stages.observations import Observations


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
    is_pan = sweeps(observations, num_frames, image_size)
    search = Search(num_frames, image_size, intrinsics, config, reporter, should_stop, is_pan, start)
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
        # What a pan through a lens is bent to with a pinhole asks for a lens less than for a readout.
        told, found = quiet.told_by_pairs(observations), None
        if told is not None:
            found = quiet.find_camera(grown, observations, proposed, blur_px, told)
        if found is None or found.told is None:
            if not config.camera.reads_at_once:
                grown, observations, readout = quiet.at_one_time(grown, observations, camera.intrinsics)
            if told is None or readout is not None:
                found = quiet.find_camera(grown, observations, proposed, blur_px)
        reporter.end()
        if found is not None:
            beside += found.open_focal
            denied_px = found.denied_px
        again, is_misled = None, False
        if found is not None and not found.camera.is_plain:
            again = search.grow_with(observations, found, free_focal)
        if again is not None:
            other, found, ideal = again
            is_lens = not found.camera.lens.is_pinhole
            is_open = is_lens and any(focal_is_open(each.scene, image_size) for each in (grown, other))
            taken = not is_lens or search.tells_lens(grown, other, found, is_open)
            if is_open or (taken and search.is_weak(found.camera)):
                beside.append((grown if taken else other).scene.mean_focal)
            is_misled = taken and readout is not None and not is_told_still(other.scene, ideal, readout, image_size)
            if taken:
                grown, camera, observations = other, found.camera, ideal
        if is_misled:
            return structure_from_motion(
                seen, num_frames, image_size, intrinsics, without_rolling_shutter(config), reporter,
                should_stop, with_doubts, known, any_camera, proposed, blur_px, start,
            )  # fmt: skip
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
