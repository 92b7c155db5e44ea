"""Dense depth of single frames, from the cue, the landmarks, the trajectories and the frames near them."""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, at_nearest_pixel, evenly_spread
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.frontend.sequence.model import GroundTruth, Sequence
from uni4d_fg.optim.threads import OrderedMap
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.results.fusion.averaging import Averaged, average_over_frames, chosen_by_others
from uni4d_fg.results.fusion.background import Background, View, background
from uni4d_fg.results.fusion.bleeding import EdgeProfile, bleeding_radius, edge_profile
from uni4d_fg.results.fusion.carried import carried_depth
from uni4d_fg.results.fusion.densify import ControlPoints, SomeControlPoints, densify_frame
from uni4d_fg.results.fusion.guided_median import guided_median
from uni4d_fg.results.fusion.lifting import lifted
from uni4d_fg.results.fusion.mask_band import STILL, FittedMask, compare, farthest_px, fitted_mask, looks_moving
from uni4d_fg.results.fusion.matching_choice import adds_nothing, bleeding_of, is_poor, is_preferred, tells_bleeding
from uni4d_fg.results.fusion.moving_depth import carried_moving, correct_moving, without_bleeding
from uni4d_fg.results.fusion.multiview.measured import Measured, MultiviewDepth
from uni4d_fg.results.fusion.multiview.working_frame import WorkingFrame, WorkingSize, without_band, working_frame
from uni4d_fg.results.fusion.planar_smoothing import smoothed_where_unsure
from uni4d_fg.results.fusion.static_depth import (
    HeldOut,
    StaticDepth,
    fuse_static,
    held_out_errors,
    known_depth,
    probability_right,
    without_edges,
)
from uni4d_fg.results.fusion.told_error import as_often_right, final_confidence, without_texture
from uni4d_fg.results.fusion.upsampling import upsample_guided
from uni4d_fg.slam.stages.scene import StaticNoise

_CARRIED_REACH, _CARRIED_FROM = 6, 2
"""A frame without a cue takes the depth of this many frames at most this far away."""
_BESIDE = tuple(range(1, _CARRIED_REACH + 1))
_AVERAGED_SIGMA = (0.005, 0.06)
"""Bounds of the standard deviation from which it is told which frames agree."""
_TRIED_FRAMES = 3
"""Frames that are matched first: where landmarks prefer the cue in all of them, no others are matched."""
_SURE = 0.8
"""Matched depth of this confidence tells how far the cue bleeds."""
_BLED_SHARE = 2.0
"""Moving things take their depth from this many times as far inside as the cue bleeds in the mean."""
_ADDS_NOTHING = "adds nothing to this cue, as landmarks say"


class FinalStatic(NamedTuple):
    """Static depth of one frame after averaging, as the image shows it, shrunk to the working size."""

    log_depth: Float32Array
    """(h, w), NaN where missing."""
    confidence: Float32Array
    """(h, w) probability that it is right to 3 %; 0 where something moves."""
    still: BoolArray
    """(h, w) outside of masks."""


class _Made(NamedTuple):
    """Static depth of one frame and what the frames near it need of it, at working size, (h, w) each."""

    depth: StaticDepth
    inverse: Float32Array
    """Of the depth, 1/m."""
    log_cue: Float32Array
    """Before anything was done to it."""
    unmasked: BoolArray
    """Outside of masks, or in masks from motion and shown to stand still by several frames."""
    static: BoolArray
    """The same without a band around masks."""
    color: Float32Array
    """(h, w, 3) RGB, of 1; nothing where no frame is matched."""


class _Judged(NamedTuple):
    """What one frame's cue and landmarks say, at working size."""

    cue: Float32Array
    """(h, w) m, NaN where missing."""
    uv: FloatArray
    """(N, 2) landmarks, px ..."""
    log_z: FloatArray
    """... and their log depth."""
    share: FloatArray | None
    """(N,) part of its weight that each has; None for all of it."""
    unmasked: BoolArray
    """(h, w) outside of masks."""
    static: BoolArray
    """(h, w) the same without a band around masks."""
    errors: HeldOut


@dataclass
class DenseMaps:
    """Dense depth of single frames, kept as long as frames near them need it; frames are asked for in order."""

    sequence: Sequence
    control: SequenceOf[ControlPoints]
    """Of every frame."""
    scene: Arrays
    config: FusionConfig
    intrinsics: FloatArray
    """(T, 4) px."""
    broken: frozenset[int]
    """Frames whose cue is not used."""
    unmatched: str
    """Why there is no depth from several views."""
    threads: int
    size: WorkingSize
    """Of what is done before depth is brought to the size of the images."""
    landmark_sigma: float = 0.0
    """Standard deviation of log depth that is made of landmarks alone."""
    multiview: MultiviewDepth = field(init=False)
    bleeding_px: float = 0.0
    """How far the cue bleeds across edges, working px."""
    prefers_matching: bool = False
    """Whether frames with a sound cue have depth from several views."""
    matched: set[int] = field(default_factory=set)
    """Frames with depth from several views."""
    made: dict[int, _Made] = field(default_factory=dict)
    measured: dict[int, Measured | None] = field(default_factory=dict)
    """Depth from several views of frames whose static depth is not made yet."""

    def __post_init__(self) -> None:
        multiview = self.config.multiview
        poses: FloatArray = self.scene["world_T_cam"]
        cameras = np.stack([self.size.intrinsics(each) for each in self.intrinsics])
        self.multiview = MultiviewDepth(
            self._working_frame, self.size, cameras, poses, self._landmarks, multiview, self.threads
        )

    def apart(self, first: int, stop: int) -> DenseMaps:
        """Return what makes the depth of frames ``first`` to ``stop - 1`` in another process, with one thread.

        It is small: of control points it has those that these frames and the ones near them need, of frames none.
        """
        reach = max(self.config.averaged_offsets, default=0)
        if self.broken:
            reach = max(reach, _CARRIED_REACH) + _CARRIED_REACH
        if not self.unmatched:
            reach += max(self.config.multiview.compared_offsets, default=0)
        return replace(
            self,
            sequence=replace(self.sequence, tracks=None, ground_truth=GroundTruth(), initial_world_T_cam=None),
            control=SomeControlPoints.of(self.control, first - reach, stop + reach),
            scene={name: self.scene[name] for name in ("world_T_cam", "log_scale", "noise")},
            threads=1,
            matched=set(),
            made={},
            measured={},
        )

    def try_matching(self) -> None:
        """Match a few frames to see how far the cue bleeds, and whether landmarks prefer matched depth in most of them.

        A cue that was made from landmarks is not judged by them: matching counts if it bleeds. Interpolated depth does.
        """
        if self.unmatched:
            return
        sound = [frame for frame in range(self.sequence.num_frames) if frame not in self.broken]
        if not self.broken and not self.is_interpolated:
            middle = sound[len(sound) // 2]
            if adds_nothing(self._judged(middle, self.multiview.alone(middle)).errors):
                self.unmatched = _ADDS_NOTHING
                return
        tried, edges = list[HeldOut](), list[EdgeProfile | None]()
        for at in evenly_spread(len(sound), _TRIED_FRAMES).tolist():
            measured = self.multiview.at(sound[at])
            judged = self._judged(sound[at], measured)
            tried.append(judged.errors)
            if measured is not None and tells_bleeding(judged.errors):
                edges.append(self._edge_profile(sound[at], judged, measured))
        bleeding_px = bleeding_radius([profile for profile in edges if profile is not None])
        self.bleeding_px = bleeding_of(bleeding_px, poor=self._cue_is_poor, finer=self.size.times_finer)
        # One choice for the whole video: between frames that are matched and others that are not, surfaces would jump.
        preferred = [self._prefers(errors) for errors in tried]
        self.prefers_matching = 2 * sum(preferred) > len(preferred)
        if not (self.prefers_matching or self.broken):
            self.unmatched = _ADDS_NOTHING
            if not self._cue_is_poor:
                self.bleeding_px = 0.0  # told by depth that is the worse one

    def prepare(self, frames: list[int], mapped: OrderedMap, unfinished: int) -> None:
        """Make what :meth:`final` needs for frames that follow each other, and forget what only those before needed.

        Args:
            frames: The frames.
            mapped: The threads that may work on it.
            unfinished: The first frame that :meth:`final` is still asked for, maybe on other threads meanwhile.
        """
        if self.config.static == "nearest_points":
            return
        reach = max(self.config.averaged_offsets, default=0)
        self.made = {number: made for number, made in self.made.items() if number >= unfinished - reach}
        near = {
            frame + sign * offset
            for frame in frames
            for offset in (0, *self.config.averaged_offsets, *(_BESIDE if frame in self.broken else ()))
            for sign in (-1, 1)
        }
        wanted = sorted(number for number in near if 0 <= number < self.sequence.num_frames and number not in self.made)
        if not self.unmatched and wanted:
            # Frames that are matched share what they are matched with, and matching has threads of its own.
            self.multiview.forget_before(wanted[0], unfinished)
            self.measured |= {number: self.multiview.at(number) for number in wanted}
        # A broken frame takes its cue from others.
        for numbers in ([n for n in wanted if n not in self.broken], [n for n in wanted if n in self.broken]):
            list(mapped(self._static, numbers))

    def final(self, frame: int) -> tuple[Float32Array, FinalStatic | None]:
        """Return the depth (H, W) of a frame, m, and what is known of static depth where that is made as a field.

        Frames that are prepared may be asked for on several threads.
        """
        mask, given = self.sequence.masks[frame], self._given(frame)
        if self.config.static == "nearest_points":
            return self._by_nearest_points(frame, given, mask), None
        mine = self._static(frame)
        averaged = self._averaged(frame)
        averaged = averaged._replace(log_depth=self.size.continued(averaged.log_depth))
        sure = final_confidence(mine.depth.confidence, averaged, bleeds=self.bleeding_px > 0)
        sure *= probability_right(np.float32(self.common_sigma(frame)))
        if self.is_interpolated and frame in self.matched:
            sure = without_texture(sure, self.multiview.gray(frame), self.config.multiview.window_radius_px)
        filled, moving, unmasked = averaged.log_depth, mask, mine.unmasked
        if self.prefers_matching and self.is_interpolated:
            filled = smoothed_where_unsure(filled, np.where(unmasked, sure, np.float32(0)), mine.color)
        if self.prefers_matching and (mask > 0).any():
            behind = self._behind(frame)
            fitted = self._fitted(frame, mask, behind)
            shown = self.size.straight(fitted.still) & behind.seen & ~mine.unmasked
            filled = np.where(shown, -np.log(np.where(shown, behind.inverse, np.float32(1))), filled)
            unmasked = unmasked & ~self.size.straight(fitted.missed)
            moving = fitted.applied(mask, self.size.plain)
        sure[~unmasked & (mine.depth.matched <= STILL)] = 0
        log_depth, sure = self.size.shown(filled), self.size.shown(self.size.continued(sure))
        if frame in self.broken or self.bleeding_px:
            log_depth = guided_median(log_depth, sure, self.size.shown(mine.static), self.sequence.images[frame])
            if self.prefers_matching and self.is_interpolated and self.size is self.size.plain:
                log_depth = self.multiview.edges_again(frame, log_depth, sure, mine.static)
            full = np.exp(upsample_guided(log_depth, self.sequence.images[frame]))
            full[np.isnan(given)] = np.nan
        else:
            full = lifted(filled, self.size.continued(mine.log_cue), given, self.size)
        if (moving > 0).any():
            full[moving > 0] = np.exp(self._moving(frame, given, moving)[moving > 0])
        told = as_often_right(sure) if self.is_interpolated else sure
        return full, FinalStatic(log_depth, told, self.size.shown(unmasked))

    def common_sigma(self, frame: int) -> float:
        """Return the standard deviation of log depth that a frame shares with those it is compared with."""
        return self.landmark_sigma if self.is_interpolated and frame not in self.matched else 0.0

    def _averaged(self, frame: int) -> Averaged:
        """Average a frame's static depth with that of the frames near it.

        What is made of a frame without a cue gives way to what was carried into it, where other frames choose that.
        """
        mine = self._static(frame)
        averaged = self._over_others(frame, mine.inverse)
        if frame not in self.broken:
            return averaged
        carried = self._over_others(frame, np.exp(-self.size.within(mine.depth.corrected.log_depth, np.nan)))
        return chosen_by_others(averaged, carried)

    def _over_others(self, frame: int, inverse: Float32Array) -> Averaged:
        """Average inverse depth (h, w), 1/m, in a frame with that of the frames near it."""
        poses: FloatArray = self.scene["world_T_cam"]
        near, broken = self._near(frame), frame in self.broken
        made = [self._static(number) for number in near]
        maps = [np.where(m.unmasked, m.inverse, np.float32(np.nan)) if broken else m.inverse for m in made]
        return average_over_frames(
            inverse, poses[frame], zip(maps, poses[near], map(self._camera, near), strict=True), self._camera(frame),
            self.config.averaged_sigmas * float(np.clip(self._static(frame).depth.sigma, *_AVERAGED_SIGMA)),
        )  # fmt: skip

    def _near(self, frame: int) -> list[int]:
        """Return the frames whose depth is averaged with that of a frame."""
        near = (frame + sign * offset for offset in self.config.averaged_offsets for sign in (-1, 1))
        return [number for number in near if 0 <= number < self.sequence.num_frames]

    def _behind(self, frame: int) -> Background:
        """Return what frames near one show of the still scene where it has masks, and around them."""
        # The frames next to it mostly have their masks in the same place.
        near = [number for number in self._near(frame) if abs(number - frame) > 1] or self._near(frame)
        masked = self.size.within(~self._static(frame).unmasked, False)
        around = ~without_band(~masked, farthest_px(self.size.times_finer))
        return background(self._view(frame), map(self._view, near), around)

    def _fitted(self, frame: int, mask: Int32Array, behind: Background) -> FittedMask:
        """Return where a mask is too large and where too small, as the shrunk image shows it."""
        color, variance, inverse = (self.size.shown(part) for part in behind[:3])
        seen = Background(color, variance, inverse, self.size.shown(behind.seen))
        # Of a frame without a sound cue too little is known to say what its mask misses.
        return fitted_mask(
            compare(self.sequence.images[frame], mask, seen), self.size.shown(self._static(frame).depth.matched),
            tells_missed=frame not in self.broken,
        )  # fmt: skip

    def _view(self, frame: int) -> View:
        made, pose = self._static(frame), self.scene["world_T_cam"][frame]
        return View(made.color, made.inverse, made.static, pose, self._camera(frame))

    def landmarks_in(self, frame: int) -> tuple[FloatArray, FloatArray]:
        """Return where a frame shows landmarks, (N, 2) px of the shrunk image, and their log depth (N,)."""
        mine, usable = self.control[frame], self._usable(frame)
        return self.size.plain.pixels(mine.uv[usable]), mine.log_scale[usable] + np.log(mine.cue[usable])

    def _given(self, frame: int) -> Float32Array:
        """Return the cue (H, W), m, NaN where it is not a depth."""
        cue = self.sequence.depths[frame]
        with np.errstate(invalid="ignore"):
            return np.where((cue > 0.0) & (cue < np.inf), cue, np.float32(np.nan))

    def _moving(self, frame: int, given: Float32Array, mask: Int32Array) -> Float32Array:
        """Return the log depth (H, W) of what moves; means nothing elsewhere."""
        mine = self.control[frame]
        corrected = self._static(frame).depth.corrected
        log_depth = corrected.affine(given) + self.size.enlarge(corrected.field)
        radius = self.bleeding_px / self.size.scale[0]
        for label in np.unique(mask[mask > 0]).tolist():
            pixels = mask == label
            if frame in self.broken:
                carried = carried_moving(pixels, self.sequence.images[frame], self._beside(frame, label))
                log_depth = np.where(np.isfinite(carried), carried, log_depth)
                continue
            here = (mine.instance == label) & np.isfinite(mine.log_scale)
            log_z = mine.log_scale[here] + np.log(mine.cue[here])
            log_depth = correct_moving(log_depth, pixels, mine.uv[here], log_z, radius, self.config)
            log_depth = without_bleeding(log_depth, pixels, _BLED_SHARE * radius)
        return log_depth

    def _beside(self, frame: int, label: int) -> list[tuple[ImageArray, Float32Array, BoolArray, float]]:
        """Return image, log depth and pixels of an instance, and a weight, of the nearest frames with a sound cue."""
        found: list[tuple[ImageArray, Float32Array, BoolArray, float]] = []
        for side in (-1, 1):
            for step in range(1, _CARRIED_REACH + 1):
                other = frame + side * step
                if not 0 <= other < len(self.control) or other in self.broken:
                    continue
                mask = self.sequence.masks[other]
                pixels = mask == label
                if pixels.any():
                    log_depth = self._moving(other, self._given(other), mask)
                    found.append((self.sequence.images[other], log_depth, pixels, 1.0 / step))
                    break
        return found

    def _by_nearest_points(self, frame: int, given: Float32Array, mask: Int32Array) -> Float32Array:
        return densify_frame(
            given, mask, self.intrinsics[frame], self.control[frame],
            float(self.scene["log_scale"][frame]), self._noise, self.config,
        )  # fmt: skip

    def _static(self, frame: int) -> _Made:
        if frame not in self.made:
            self.made[frame] = self._make(frame)
        return self.made[frame]

    def _make(self, frame: int) -> _Made:
        measured = None
        if not self.unmatched:
            measured = self.measured.pop(frame) if frame in self.measured else self.multiview.at(frame)
        judged = self._judged(frame, measured)
        # Where landmarks say that the corrected cue is the better one, matches would only add their noise. What is
        # carried into a broken frame was corrected by them before: they do not speak against matching there.
        if not (self.prefers_matching or (frame in self.broken and self._prefers(judged.errors))):
            measured = None
        if measured is not None:
            self.matched.add(frame)
        if measured is not None and self.bleeding_px == 0:
            measured = without_edges(measured, judged.cue)
        fused = self._fused(frame, judged, measured)
        still = self._hidden_by_mistake(fused.matched)
        fused = replace(fused, log_depth=self.size.within(fused.log_depth, np.nan))
        with np.errstate(invalid="ignore"):
            inverse, log_cue = np.exp(-fused.log_depth), np.log(judged.cue)
        return _Made(fused, inverse, log_cue, judged.unmasked | still, judged.static | still, self._color(frame))

    def _color(self, frame: int) -> Float32Array:
        """Return the image (h, w, 3), of 1; nothing where no frame is matched."""
        if not self.prefers_matching:
            return np.zeros((0, 0, 3), np.float32)
        channels = self.sequence.images[frame].transpose(2, 0, 1).astype(np.float32) / np.float32(255)
        return np.dstack([self.size.shrink(channel) for channel in channels])

    def _judged(self, frame: int, measured: Measured | None) -> _Judged:
        broken = frame in self.broken
        cue = self._carried(frame) if broken else self.size.depth(self._given(frame))
        cue = self.size.within(cue, np.nan)
        unmasked = ~self.size.marked(self.sequence.masks[frame])
        static = without_band(unmasked, self.config.multiview.mask_band_px)
        unmasked, static = self.size.within(unmasked, False), self.size.within(static, False)
        uv, log_scale_at, log_cue = self._landmark_cues(frame)
        share = self._shares(frame)
        if not broken:
            # The cue is read where the landmark is, between pixels: its error there holds for the pixel nearest.
            nearest = at_nearest_pixel(cue, uv)
            log_cue = np.where(np.isfinite(nearest), np.log(nearest), log_cue)
        log_z = log_scale_at + log_cue
        log_scale = float(self.scene["log_scale"][frame])
        errors = held_out_errors(cue, measured, uv, log_z, static, log_scale, self.config, share)
        errors = errors._replace(telling=errors.telling and not self.is_interpolated)  # between these very ones
        return _Judged(cue, uv, log_z, share, unmasked, static, errors)

    def _fused(self, frame: int, judged: _Judged, measured: Measured | None) -> StaticDepth:
        static = judged.static if measured is None else judged.static | self._hidden_by_mistake(measured.confidence)
        # A network's cue errs smoothly: what corrects it in a mask corrects what moves there, too.
        correcting = static if self.is_interpolated else judged.static
        known = known_depth(measured, judged.uv, judged.log_z, correcting, judged.cue.shape, judged.share)
        like_moving = np.zeros_like(static)
        if self.bleeding_px > 0 and not static.all():
            beside = looks_moving(self.sequence.images[frame], self.sequence.masks[frame], self.size.shown(static))
            like_moving = self.size.straight(beside)
        log_scale = float(self.scene["log_scale"][frame])
        return fuse_static(
            judged.cue, measured, known, judged.errors.cue, static, like_moving, log_scale, self.bleeding_px,
            self.config, frame in self.broken or self.is_interpolated,
        )  # fmt: skip

    def _hidden_by_mistake(self, confidence: Float32Array) -> BoolArray:
        """Return what a mask may hide by mistake, (h, w): what several frames show with confidence.

        What given masks hide may follow the camera, as a car does that is filmed from another: it would seem to stand
        still farther away.
        """
        return np.asarray((confidence > STILL) & self.sequence.masks_from_motion)

    def _edge_profile(self, frame: int, judged: _Judged, measured: Measured) -> EdgeProfile | None:
        """Return how the cue of a frame differs from matched depth beside edges; None if there are none."""
        corrected = self._fused(frame, judged, measured).corrected
        sure = judged.static & (measured.confidence > _SURE)
        return edge_profile(corrected.affine(judged.cue), measured.log_depth, sure)

    def _prefers(self, errors: HeldOut) -> bool:
        """Tell whether matched depth is the better one, as far as a frame says; once it is known whether cues bleed."""
        return is_preferred(errors, self.bleeding_px, poor=self._cue_is_poor)

    @property
    def is_interpolated(self) -> bool:
        """Whether the cue was interpolated between static points."""
        return self.sequence.depth_parallax is not None

    @property
    def _cue_is_poor(self) -> bool:
        return is_poor(self._noise, self.sequence.depth_parallax)

    @property
    def _noise(self) -> float:
        """Of the cue at landmarks, a standard deviation of the log depth."""
        return StaticNoise.of_array(self.scene["noise"]).depth_sigma

    def _landmark_cues(self, frame: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where a frame sees landmarks, (N, 2) working px, log depth over the cue, and the log cue (N,)."""
        mine, usable = self.control[frame], self._usable(frame)
        return self.size.pixels(mine.uv[usable]), mine.log_scale[usable], np.log(mine.cue[usable])

    def _shares(self, frame: int) -> FloatArray | None:
        """Return the part of its weight that each of these landmarks has, (N,); None for all of it."""
        share = self.control[frame].share
        return None if share is None else share[self._usable(frame)]

    def _usable(self, frame: int) -> BoolArray:
        """Return which control points of a frame are landmarks with a cue."""
        mine = self.control[frame]
        return np.asarray((mine.instance == 0) & np.isfinite(mine.log_scale))

    def _carried(self, frame: int) -> Float32Array:
        """Return a frame's depth as the nearest frames with a sound cue show it, at working size."""
        poses: FloatArray = self.scene["world_T_cam"]
        near = [frame + sign * step for step in range(1, _CARRIED_REACH + 1) for sign in (-1, 1)]
        sound = [other for other in near if 0 <= other < len(poses) and other not in self.broken][:_CARRIED_FROM]
        others = [(np.exp(self._static(other).depth.log_depth), poses[other], self._camera(other)) for other in sound]
        shape = (self.size.height, self.size.width)
        return carried_depth(shape, poses[frame], others, self._camera(frame))

    def _camera(self, frame: int) -> FloatArray:
        """Return intrinsics (4,) at working size."""
        camera: FloatArray = self.multiview.cameras[frame]
        return camera

    def _working_frame(self, frame: int) -> WorkingFrame:
        return working_frame(
            self.sequence.images[frame], self.sequence.masks[frame], self.size, self.config.multiview.mask_band_px,
            hides=not self.sequence.masks_from_motion,
        )  # fmt: skip

    def _landmarks(self, frame: int) -> FloatArray:
        points: FloatArray = self.control[frame].points[self.control[frame].instance == 0]
        return points
