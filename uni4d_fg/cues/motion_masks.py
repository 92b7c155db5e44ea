"""Masks of what moves, from tracks, depth and images alone: for videos without a segmenter.

1. Tracks that contradict a static scene by themselves are known (:mod:`uni4d_fg.cues.structure`), and others that
   depart from it are found (:mod:`uni4d_fg.cues.track_motion`). Where the cameras are not those of structure from
   motion, they are solved before, robustly, and once more without what was found, and the tracks tested again.
2. A first look compares every frame with others before and after it as a static scene would look there
   (:mod:`uni4d_fg.cues.appearance`, :mod:`uni4d_fg.cues.neighbor_comparison`). Where most tracks move, depth that is
   interpolated between points and that of the scene around (:mod:`uni4d_fg.cues.behind_moving`) take turns.
3. A second look compares it with the background alone (:mod:`uni4d_fg.cues.background_comparison`).
   In both, the evidence of pixels and tracks is smoothed within surfaces of like color; regions above a threshold are
   kept unless their own tracks say that they are static (:mod:`uni4d_fg.cues.moving_regions`). In the end, colors that
   move in the whole video add to what was seen in and around them (:mod:`uni4d_fg.cues.region_colors`).
4. Regions are joined to instances over time (:mod:`uni4d_fg.cues.instances`); those of few frames are dropped.

What stands still through the whole video is static here, whatever it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.config.models import Config
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.counted import counted
from uni4d_fg.cues.depth_range import spread_at_tracks
from uni4d_fg.cues.frame_comparison import ComparedVideo
from uni4d_fg.cues.instances import associate_instances
from uni4d_fg.cues.label_store import CompressedLabels
from uni4d_fg.cues.moving_detections import detections, first_look, second_look
from uni4d_fg.cues.outlier_tracks import find_outlier_tracks
from uni4d_fg.cues.static_cameras import StaticTracks, solve_cameras
from uni4d_fg.cues.structure.motion import observations_of_tracks, structure_from_motion
from uni4d_fg.cues.track_certainty import believed, position_variance
from uni4d_fg.cues.track_motion import TrackMotion, find_moving_tracks
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.optim.threads import made_ahead, thread_count
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.scene import Cameras

ValueT = TypeVar("ValueT")

_MOST_MAY_MOVE = 0.6
"""More than this part of the image, or of the tracks, is warned of."""


@dataclass(frozen=True)
class MotionMasks:
    """Masks from motion, and what was found on the way."""

    labels: FrameSource[Int32Array]
    """T maps (H, W): 0 static, otherwise the number of an instance that moves, the same in all frames."""
    cameras: Cameras
    """Those the masks were made with; good to start from, not a result."""
    tracks: TrackMotion
    """Which tracks move."""
    facts: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def motion_masks(
    video: Video,
    depths: FrameSource[Float32Array],
    tracks: Tracks,
    intrinsics: FloatArray,
    config: MotionMaskConfig,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
    solver: Config | None = None,
    known_moving: BoolArray | None = None,
    camera: CameraModel | None = None,
    world_T_cam: FloatArray | None = None,
    is_interpolated: bool = False,
) -> MotionMasks:
    """Find what moves in a video by comparing it with a static scene.

    Args:
        video: Images.
        depths: T maps (H, W), of any one scale; NaN where missing.
        tracks: K tracks over the T frames, over the whole image.
        intrinsics: (4,) px, known or to start from.
        config: Sigmas, thresholds and sizes.
        reporter: Progress.
        should_stop: Polled often.
        solver: Stages 1 and 2 and their minimizer; None takes the defaults.
        known_moving: (K,) tracks that are known to contradict a static scene; None lets them be found from the tracks
            alone (:mod:`uni4d_fg.cues.structure`), as a thing that moves by little stays within the sigmas of depth.
        camera: A lens or a zoom that is known, with its intrinsics, which are held; None for a pinhole.
        world_T_cam: (T, 4, 4) poses that are known, in the unit of the depth; None solves them from depth and tracks.
        is_interpolated: Depth is that of points of the static scene, and knows nothing of what moves.

    Raises:
        InputError: If depth or tracks do not fit the images, or depth is missing wherever there is a track.
        DegenerateProblemError: If the tracks do not determine the cameras.
        SolverError: If the cameras cannot be solved.
        Cancelled: If ``should_stop`` turned true.
    """
    report, stop = reporter or SilentReporter(), should_stop or (lambda: False)
    for name, count in (("depth maps", len(depths)), ("frames of tracks", tracks.num_frames)):
        if count != video.num_frames:
            raise InputError(f"motion masks: {count} {name}, but {video.num_frames} images; make them of one video")
    settings = solver or Config()
    camera = camera or CameraModel(intrinsics)
    ideal = camera.ideal_tracks(tracks)
    if known_moving is None:
        known_moving, stray = _contradicting(ideal, video.image_size, intrinsics, settings, report, stop)
        if stray.any():
            tracks = tracks.without(stray)
            ideal = camera.ideal_tracks(tracks)
    report.begin("motion of tracks", config.camera_rounds if world_T_cam is None else 1)
    cameras, motion = _tracks_and_cameras(
        video, depths, tracks, ideal, camera, known_moving, world_T_cam, config, settings, report, stop
    )
    report.end()
    report.begin("motion masks", 3 * video.num_frames)
    given = ComparedVideo(video, depths, tracks, motion, cameras, camera, is_interpolated)
    first = _reported(first_look(given, config, stop), report, 0)
    second = _reported(second_look(given, config, first, stop), report, len(first))
    labels = CompressedLabels(video.image_size)
    seen_in: dict[int, int] = {}
    found = made_ahead(detections(given, config, second), thread_count())
    for frame, numbers in enumerate(associate_instances(found, video.images, config.instances, stop)):
        labels.append(numbers)
        for number in np.unique(numbers[numbers > 0]).tolist():
            seen_in[number] = seen_in.get(number, 0) + 1
        report.advance(len(first) + len(second) + frame + 1)
    kept = sorted(n for n, count in seen_in.items() if count >= min(config.min_frames, video.num_frames))
    new_ids = np.zeros(max(seen_in, default=0) + 1, np.int32)
    new_ids[kept] = np.arange(1, len(kept) + 1)
    labels.rename(new_ids)
    area = float(np.mean([np.count_nonzero(numbers) / numbers.size for numbers in labels]))
    report.end()
    facts = [
        f"{counted(len(kept), 'instance')} moving, {100 * area:.1f} % of the image; "
        f"{int(motion.moving.sum())} tracks move, {int(motion.static.sum())} are static, "
        f"{int((~motion.moving & ~motion.static).sum())} undecided"
    ]
    return MotionMasks(labels, cameras, motion, facts, _warnings(motion, area))


def _reported(frames: Iterable[ValueT], report: Reporter, before: int) -> list[ValueT]:
    """Return what is made of frames, each reported as one more than what was done before."""
    made = []
    for one in frames:
        made.append(one)
        report.advance(before + len(made))
    return made


def _warnings(motion: TrackMotion, area: float) -> list[str]:
    decided = int(motion.moving.sum() + motion.static.sum())
    if area > _MOST_MAY_MOVE or (decided and motion.moving.sum() > _MOST_MAY_MOVE * decided):
        return [
            "motion masks: most of the image seems to move, so that what was taken for the static scene may be a "
            "moving thing; give masks if the cameras look wrong"
        ]
    return []


def _tracks_and_cameras(
    video: Video,
    depths: FrameSource[Float32Array],
    tracks: Tracks,
    ideal: Tracks,
    camera: CameraModel,
    known_moving: BoolArray,
    world_T_cam: FloatArray | None,
    config: MotionMaskConfig,
    settings: Config,
    report: Reporter,
    stop: Callable[[], bool],
) -> tuple[Cameras, TrackMotion]:
    """Test tracks with the cameras that are known, or solve cameras, test, and do both without the tracks that move."""
    intrinsics = camera.intrinsics
    known = StaticTracks.of(video, depths, tracks, intrinsics, settings)
    if not np.isfinite(known.labelled.depth).any():
        raise InputError(
            f"motion masks: none of {tracks.num_tracks} tracks has depth in any frame; give depth that is not missing, "
            "or let it come from the motion of the camera"
        )
    spread = spread_at_tracks(tracks, depths, max(1, round(config.depth_edge_px)))
    variance = position_variance(video.images, tracks)
    labelled = replace(known.labelled, tracks=ideal)

    def tested(cameras: Cameras, outlier: BoolArray, with_shared: bool) -> TrackMotion:
        motion = find_moving_tracks(labelled, spread, cameras, video.image_size, config, outlier, with_shared, variance)
        moving = believed(outlier, motion, tracks, video.image_size, config)
        return replace(motion, moving=motion.moving | moving, static=motion.static & ~outlier)

    if world_T_cam is not None:
        cameras = Cameras(world_T_cam, intrinsics, np.zeros(len(world_T_cam)))
        motion = tested(cameras, known_moving, with_shared=True)
        report.advance(1)
        return cameras, motion
    outlier = find_outlier_tracks(labelled, intrinsics, config, known_moving) | known_moving
    moving = outlier
    for turn in range(config.camera_rounds):
        cameras = solve_cameras(
            labelled.without(moving),
            intrinsics,
            settings,
            # Among the first, what moves would be explained by a wrong focal length.
            free_intrinsics=config.free_intrinsics and turn > 0 and camera.is_plain,
            observations_per_frame=config.max_bundle_observations,
            should_stop=stop,
        )
        motion = tested(cameras, outlier, with_shared=turn == config.camera_rounds - 1)
        moving = motion.moving
        report.advance(turn + 1)
    return cameras, motion


def _contradicting(
    tracks: Tracks, image_size: tuple[int, int], intrinsics: FloatArray, settings: Config, report: Reporter,
    stop: Callable[[], bool],
) -> tuple[BoolArray, BoolArray]:  # fmt: skip
    """Find what contradicts a static scene, whatever its depth; nothing does without parallax to see it by.

    Returns:
        The tracks (K,) that do, and the observations (K, T) of another static surface than most of their track.
    """
    moving, stray = np.zeros(tracks.num_tracks, dtype=bool), np.zeros(tracks.visible.shape, dtype=bool)
    seen = observations_of_tracks(tracks, ~moving)
    if len(np.unique(seen.track)) < settings.geometric_depth.min_pose_points:
        return moving, stray
    found = structure_from_motion(
        seen, tracks.num_frames, image_size, intrinsics, settings, report, stop, with_doubts=False
    )
    if found is not None:
        moving[found.track] = found.moving
        stray = seen.table(found.stray, tracks.visible.shape)
    return moving, stray
