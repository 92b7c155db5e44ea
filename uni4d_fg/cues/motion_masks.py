"""Masks of what moves, from tracks, depth and images alone: for videos without a segmenter.

1. Tracks that contradict a static scene by themselves are known (:mod:`uni4d_fg.cues.structure`), and others that
   depart from it are found (:mod:`uni4d_fg.cues.track_motion`). Where the cameras are not those of structure from
   motion, they are solved before, robustly, and once more without what was found, and the tracks tested again.
2. Every frame is compared with others before and after it as a static scene would look there
   (:mod:`uni4d_fg.cues.appearance`). Of the two directions the less suspicious one counts: what is hidden in one is
   mostly seen in the other. Where most tracks move, depth that is interpolated between points and that of the scene
   around (:mod:`uni4d_fg.cues.behind_moving`) take turns.
3. The evidence of pixels and tracks, and of the frames next to it, is smoothed within surfaces of like color; regions
   above a threshold are kept unless their own tracks say that they are static (:mod:`uni4d_fg.cues.moving_regions`).
   They end where colors do (:mod:`uni4d_fg.cues.region_colors`).
4. Regions are joined to instances over time (:mod:`uni4d_fg.cues.instances`); those of few frames are dropped.

What stands still through the whole video is static here, whatever it is.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.config.models import Config
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.counted import counted
from uni4d_fg.cues.appearance import FrameAppearance, frame_appearance, moved_evidence, with_other_depth
from uni4d_fg.cues.behind_moving import depth_behind
from uni4d_fg.cues.dense_flow import DenseFlow, shrink, shrunk_size, warp_back, working_scale
from uni4d_fg.cues.depth_range import spread_at_tracks
from uni4d_fg.cues.detections import FrameDetections
from uni4d_fg.cues.instances import associate_instances
from uni4d_fg.cues.label_store import CompressedLabels
from uni4d_fg.cues.moving_regions import disk, grown, moving_region, track_evidence, trusted_components
from uni4d_fg.cues.outlier_tracks import find_outlier_tracks
from uni4d_fg.cues.pixel_grid import PixelGrid
from uni4d_fg.cues.region_colors import end_at_colors
from uni4d_fg.cues.static_cameras import StaticTracks, solve_cameras
from uni4d_fg.cues.static_scene import relative_pose
from uni4d_fg.cues.structure.motion import observations_of_tracks, structure_from_motion
from uni4d_fg.cues.track_motion import QuadraticGrid, TrackMotion, find_moving_tracks
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.optim.threads import OrderedMap, made_ahead, thread_count, workers_in_order
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.scene import Cameras

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
        known_moving = _contradicting(ideal, video.image_size, intrinsics, settings, report, stop)
    report.begin("motion of tracks", config.camera_rounds if world_T_cam is None else 1)
    cameras, motion = _tracks_and_cameras(
        video, depths, tracks, ideal, camera, known_moving, world_T_cam, config, settings, report, stop
    )
    report.end()
    report.begin("motion masks", video.num_frames)
    comparison = _Comparison(video, depths, tracks, cameras, camera, motion, config, is_interpolated)
    labels = CompressedLabels(video.image_size)
    seen_in: dict[int, int] = {}
    found = made_ahead(comparison.detections(stop), thread_count())
    for frame, numbers in enumerate(associate_instances(found, video.images, config.instances, stop)):
        labels.append(numbers)
        for number in np.unique(numbers[numbers > 0]).tolist():
            seen_in[number] = seen_in.get(number, 0) + 1
        report.advance(frame + 1)
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
    labelled = replace(known.labelled, tracks=ideal)

    def tested(cameras: Cameras, outlier: BoolArray, with_shared: bool) -> TrackMotion:
        motion = find_moving_tracks(labelled, spread, cameras, video.image_size, config, outlier, with_shared)
        return replace(motion, moving=motion.moving | outlier, static=motion.static & ~outlier)

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
) -> BoolArray:  # fmt: skip
    """Return which tracks (K,) contradict a static scene, whatever their depth; none without parallax to see it by."""
    out = np.zeros(tracks.num_tracks, dtype=bool)
    seen = observations_of_tracks(tracks, ~out)
    if len(np.unique(seen.track)) < settings.geometric_depth.min_pose_points:
        return out
    found = structure_from_motion(
        seen, tracks.num_frames, image_size, intrinsics, settings, report, stop, with_doubts=False
    )
    if found is not None:
        out[found.track] = found.moving
    return out


@dataclass(frozen=True)
class _Prepared:
    """A frame at working size, (h, w)."""

    image: ImageArray
    tracks: Float32Array
    """What its tracks say, from -1 (static) to 1 (moving)."""
    appearance: FrameAppearance
    """With the depth that there is."""
    behind: FrameAppearance
    """With that of the scene around where most tracks move."""


class _Comparison:
    """Frames compared with those around them; a window of frames is held."""

    def __init__(
        self,
        video: Video,
        depths: FrameSource[Float32Array],
        tracks: Tracks,
        cameras: Cameras,
        camera: CameraModel,
        motion: TrackMotion,
        config: MotionMaskConfig,
        is_interpolated: bool,
    ) -> None:
        self.video, self.depths, self.tracks = video, depths, tracks
        self.cameras, self.motion, self.config, self.is_interpolated = cameras, motion, config, is_interpolated
        self.size = shrunk_size(video.image_size, working_scale(video.image_size, config.working_size_px))
        self.scale = np.array([self.size[1] / video.image_size[1], self.size[0] / video.image_size[0]])
        self.pixels = PixelGrid.of(replace(camera, intrinsics=cameras.intrinsics), self.size, video.image_size)
        self.grid = QuadraticGrid.of(self.size, self.scale, video.image_size)
        self.frames: dict[int, _Prepared] = {}
        self.flow = DenseFlow(fine=False)

    def detections(self, stop: Callable[[], bool]) -> Generator[FrameDetections, None, None]:
        """Yield the regions that move, frame by frame."""
        count = self.video.num_frames
        window: deque[Float32Array] = deque()  # evidence of the frame before, of this one, and of the next
        with workers_in_order(thread_count()) as mapped:
            compared = self._compared(0, mapped)
            for frame in range(count + 1):
                if stop():
                    raise Cancelled("stopped while comparing frames for the motion masks")
                if frame < count:
                    window.append(self._evidence(frame, compared))
                if frame + 1 < count:  # on the threads, while this one finds regions
                    compared = self._compared(frame + 1, mapped)
                if frame == 0:
                    continue
                this = frame - 1
                near = {this - 1 + n + (0 if this else 1): evidence for n, evidence in enumerate(window)}
                yield self._regions(this, near)
                if this > 0:
                    window.popleft()
                self._forget_before(this - max(self.config.baselines))

    def _frame(self, frame: int) -> _Prepared:
        if frame not in self.frames:
            height, width = self.size
            image = shrink(self.video.images[frame], self.size)
            depth = cv2.resize(self.depths[frame], (width, height), interpolation=cv2.INTER_NEAREST)
            edge = max(1, round(self.config.depth_edge_px * float(self.scale.mean())))
            settings = (float(self.cameras.log_scale[frame]), edge, self.config)
            tracks = track_evidence(self.tracks, self.motion, frame, self.size, self.scale, self.config)
            appearance = behind = frame_appearance(image, depth, *settings)
            if self.is_interpolated and (tracks > 0).any():
                moving = cv2.dilate((tracks > 0).astype(np.uint8), disk(self.config.behind_reach_px)) > 0
                behind = with_other_depth(appearance, depth_behind(depth, moving), *settings)
            self.frames[frame] = _Prepared(image, tracks, appearance, behind)
        return self.frames[frame]

    def _forget_before(self, frame: int) -> None:
        for old in [f for f in self.frames if f < frame]:
            del self.frames[old]

    def _pairs(self, frame: int) -> list[list[tuple[int, int]]]:
        """Return the pairs of frames that tell what moves in a frame, by baseline."""
        return [
            [(frame, f) for f in (frame - step, frame + step) if 0 <= f < self.video.num_frames]
            for step in self.config.baselines
        ]

    def _compared(self, frame: int, mapped: OrderedMap) -> Iterator[Float32Array]:
        """Begin to compare a frame with others; return what :meth:`_pair` says of each pair."""
        pairs = [pair for sides in self._pairs(frame) for pair in sides]
        for needed in sorted({f for pair in pairs for f in pair}):
            self._frame(needed)
        return mapped(self._pair, pairs)

    def _evidence(self, frame: int, compared: Iterator[Float32Array]) -> Float32Array:
        total, count = np.zeros(self.size, np.float32), 0
        for sides in self._pairs(frame):
            if sides:
                total += np.minimum.reduce([next(compared) for _ in sides])
                count += 1
        if count:
            total *= len(self.config.baselines) / count
        return total + np.float32(self.config.track_weight) * self._frame(frame).tracks

    def _pair(self, pair: tuple[int, int]) -> Float32Array:
        source, target = pair
        error = self.motion.shared.get(pair)
        shared = None
        if error is not None:
            plain = self.pixels.camera.is_plain
            shared = self.grid.displacement(error) if plain else self.pixels.displacement(error, source, target)
        pose = relative_pose(self.cameras.world_T_cam, source, target)
        # Both hypotheses of what is still have their say, at every second baseline each.
        one, other = self._frame(source), self._frame(target)
        if self.config.baselines.index(abs(target - source)) % 2:
            ours, theirs = one.appearance, other.appearance
        else:
            ours, theirs = one.behind, other.behind
        static = self.pixels.predict(ours.z, pose, source, target)
        return moved_evidence(ours, theirs, static, shared, self.config)

    def _regions(self, frame: int, near: dict[int, Float32Array]) -> FrameDetections:
        evidence, weight = near[frame].copy(), self.config.neighbor_frames_weight
        others = [f for f in near if f != frame]
        if weight > 0 and others:
            gray = self._gray(frame)
            for other in others:
                flow = self.flow.between(gray, self._gray(other))
                evidence += weight * warp_back(near[other], flow)
            evidence /= 1 + weight * len(others)
        image = self._frame(frame).image
        threshold = self.config.interpolated_threshold if self.is_interpolated else self.config.threshold
        region = moving_region(evidence, image, self.video.image_size, threshold, self.config)
        region = np.asarray(self._trusted(region, frame).any(axis=0))
        region = end_at_colors(region, image, self.tracks, self.motion, frame, self.scale, self.config)
        masks = grown(self._trusted(region, frame), self.config.grow_px)
        return FrameDetections(masks, np.ones(len(masks), np.int32), np.ones(len(masks), np.float32))

    def _trusted(self, region: BoolArray, frame: int) -> BoolArray:
        return trusted_components(region, self.tracks, self.motion, frame, self.config)

    def _gray(self, frame: int) -> ImageArray:
        return np.asarray(cv2.cvtColor(self._frame(frame).image, cv2.COLOR_RGB2GRAY))
