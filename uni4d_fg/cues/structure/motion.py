"""Structure from motion over a video: from tracks to cameras and static points, up to scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.structure.first_pair import CommonTracks, FramePair, rank_pairs
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.selection import spread_tracks
from uni4d_fg.cues.structure.triangulation import Points, RayBundle, triangulate
from uni4d_fg.cues.structure.two_view import fit_rotation
from uni4d_fg.errors import Cancelled
from uni4d_fg.progress import Reporter
from uni4d_fg.slam.stages.noise import robust_sigma
from uni4d_fg.slam.stages.observations import Observations


@dataclass(frozen=True)
class Structure:
    """Cameras and points, up to one scale."""

    world_T_cam: FloatArray
    """(T, 4, 4)."""
    intrinsics: FloatArray
    """(4,) px."""
    registered: BoolArray
    """(T,) False for frames that are bridged."""
    track: IntArray
    """(M,) tracks that were triangulated."""
    points: Points
    """M points, NaN where a track cannot be triangulated."""
    sigma_px: float
    """Noise of the tracks (robust standard deviation of a reprojection residual)."""
    pair: FramePair
    """The two frames it started from."""
    focal_deviation: float
    """Standard deviation of the focal lengths, as a part of their value; 0 if they are held."""


def structure_from_motion(
    observations: Observations,
    num_frames: int,
    image_size: tuple[int, int],
    intrinsics: FloatArray,
    config: Config,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> Structure | None:
    """Find cameras and static points from tracks.

    Args:
        observations: Observations of static tracks; some of them may move all the same.
        num_frames: T.
        image_size: (height, width), px.
        intrinsics: (4,) known, or a guess when ``config.input.intrinsics`` is 'free'.
        config: Sections ``geometric_depth``, ``bundle_adjustment`` and ``input``.
        reporter: Told the number of frames that have a pose.
        should_stop: Polled before every frame.

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
    used = observations.select(spread_tracks(observations, image_size, settings.max_tracks))
    pairs = rank_pairs(used, num_frames, intrinsics, settings, known_focal=not free_focal)
    pairs = [pair for pair in pairs if pair.parallax_px >= settings.min_parallax_px]
    scene, pair = _best_start(used, num_frames, intrinsics, pairs, config, free_focal, should_stop)
    if scene is None or pair is None:
        return None
    _grow(scene, num_frames, reporter, should_stop)
    scene.adjust()
    scene.triangulate(~np.isfinite(scene.position[:, 0]))
    scene.adjust()
    sigma = robust_sigma(scene.errors()[scene.good] / np.sqrt(2.0))
    poses = _bridge(scene.world_T_cam, scene.registered)
    track, points = _triangulate_all(observations, poses, scene)
    return Structure(poses, scene.intrinsics, scene.registered, track, points, sigma, pair, scene.focal_deviation())


def rotations_only(observations: Observations, num_frames: int, intrinsics: FloatArray) -> FloatArray:
    """Return poses (T, 4, 4) of a camera that only turns, from one frame to the next; frame 0 is the world."""
    common = CommonTracks(observations, num_frames)
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    for frame in range(1, num_frames):
        a, b = common.between(frame - 1, frame)
        turn = np.eye(3)
        if len(a) >= 3:
            turn = fit_rotation(observations.uv[a], observations.uv[b], intrinsics).second_R_first
        poses[frame, :3, :3] = poses[frame - 1, :3, :3] @ turn.T
    return poses


def _best_start(
    observations: Observations,
    num_frames: int,
    intrinsics: FloatArray,
    pairs: list[FramePair],
    config: Config,
    free_focal: bool,
    should_stop: Callable[[], bool],
) -> tuple[GrowingScene | None, FramePair | None]:
    """Try pairs and focal lengths on a few frames; return the scene that explains the tracks best."""
    best: tuple[float, GrowingScene, FramePair] | None = None
    tried = [(pair, 1.0) for pair in pairs[: config.geometric_depth.tried_pairs]]
    while tried:
        pair, factor = tried.pop(0)
        scene = GrowingScene.empty(
            observations,
            num_frames,
            intrinsics * np.array([factor, factor, 1.0, 1.0]),
            config,
            free_focal=free_focal,
            prior_intrinsics=intrinsics,
            should_stop=should_stop,
        )
        cost = _trial(scene, pair)
        if cost is not None and (best is None or cost < best[0]):
            best = (cost, scene, pair)
        if not tried and factor == 1.0 and best is not None and free_focal:
            tried = [(best[2], other) for other in config.geometric_depth.focal_starts if other != 1.0]
    return (None, None) if best is None else best[1:]


def _trial(scene: GrowingScene, pair: FramePair) -> float | None:
    """Start from a pair, add some frames between, and return how badly the scene explains their tracks.

    None if the pair gives no points.
    """
    if scene.should_stop():
        raise Cancelled("structure from motion stopped")
    if scene.start(pair) < scene.config.geometric_depth.min_pose_points:
        return None
    between = np.unique(
        np.linspace(pair.first, pair.second, scene.config.geometric_depth.trial_frames).astype(np.int64)
    )
    for frame in between.tolist():
        if not scene.registered[frame]:
            scene.register(frame)
    scene.adjust()
    scene.triangulate(~np.isfinite(scene.position[:, 0]))
    scene.adjust()
    frames = np.zeros(len(scene.registered), dtype=bool)
    frames[between] = True
    return scene.cost(frames)


def _grow(scene: GrowingScene, num_frames: int, reporter: Reporter, should_stop: Callable[[], bool]) -> None:
    """Add frames until no further one can be posed."""
    settings = scene.config.geometric_depth
    failed: set[int] = set()
    adjusted = int(scene.registered.sum())
    reporter.begin("structure from motion", num_frames)
    while True:
        if should_stop():
            raise Cancelled("structure from motion stopped")
        frame = scene.next_frame(failed)
        count = int(scene.registered.sum())
        if frame is None or count >= settings.growth * adjusted:
            if count > adjusted:
                scene.adjust()
                scene.triangulate(~np.isfinite(scene.position[:, 0]))
                adjusted = count
                failed.clear()  # better points may now pose a frame that failed before
                continue
            break
        if scene.register(frame):
            reporter.advance(int(scene.registered.sum()), f"frame {frame}")
        else:
            failed.add(frame)
    reporter.end()


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


def _triangulate_all(observations: Observations, poses: FloatArray, scene: GrowingScene) -> tuple[IntArray, Points]:
    """Triangulate every track from the frames with a pose, twice: the second time without what did not fit."""
    observations = observations.select(scene.registered[observations.frame])
    tracks, row = observations.rows()
    settings = scene.config.geometric_depth
    limit, huber_px = settings.max_reprojection_px, settings.triangulation_huber_px
    rays = RayBundle(row, poses[observations.frame], observations.uv, scene.intrinsics, len(tracks))
    points = triangulate(rays.select(triangulate(rays, huber_px).errors_of(rays) <= limit), huber_px)
    with np.errstate(invalid="ignore"):
        wrong = ~(points.error_px <= limit)
    points.position[wrong] = np.nan
    return tracks, points
