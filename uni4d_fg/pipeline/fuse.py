"""Dense depth of every frame from the sparse result, written frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, IntArray, evenly_spread
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.files import remove_file
from uni4d_fg.frontend.sequence.frames import FramesInTurn
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.optim.extension import INSTALL_COMMAND, find_extension
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.progress import Reporter
from uni4d_fg.results.confidence_store import write_confidence
from uni4d_fg.results.depth_store import write_depth
from uni4d_fg.results.fusion.averaging import average_over_frames
from uni4d_fg.results.fusion.bleeding import bleeding_radius
from uni4d_fg.results.fusion.broken_frames import contradicting_frames
from uni4d_fg.results.fusion.carried import carried_depth
from uni4d_fg.results.fusion.cue_error import affine_log_depth
from uni4d_fg.results.fusion.densify import ControlPoints, densify_frame
from uni4d_fg.results.fusion.mask_band import looks_moving
from uni4d_fg.results.fusion.moving_depth import carried_moving, correct_moving, without_bleeding
from uni4d_fg.results.fusion.multiview.measured import MultiviewDepth
from uni4d_fg.results.fusion.multiview.working_frame import WorkingFrame, WorkingSize, working_frame
from uni4d_fg.results.fusion.static_depth import StaticDepth, fuse_static, held_out_errors, known_depth, without_edges
from uni4d_fg.results.fusion.told_error import ToldError, final_confidence
from uni4d_fg.results.fusion.upsampling import upsample_guided
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import zoomed

_CARRIED_REACH, _CARRIED_FROM = 6, 2
"""A frame without a cue takes the depth of this many frames at most this far away."""
_BESIDE = tuple(range(1, _CARRIED_REACH + 1))
_AVERAGED_SIGMA = (0.005, 0.06)
"""Bounds of the standard deviation from which it is told which frames agree."""
_SHARP_PX = 4.0
"""Matching blurs edges by this itself: a cue that is found to bleed no farther has the detail of edges, working px."""
_BETTER = 1.0
"""Matched depth is used if its error at landmarks is below this part of the corrected cue's ..."""
_NOT_WORSE = 1.5
"""... and below this one if the cue bleeds: landmarks do not lie on edges."""
_SURE = 0.8
"""Matched depth of this confidence tells how far the cue bleeds."""
_STILL = 0.6
"""Pixels of a mask whose depth several frames show with this confidence are taken to stand still."""
_BLED_SHARE = 2.0
"""Moving things take their depth from this many times as far inside as the cue bleeds in the mean."""
_EDGE = 0.04
"""Change of log depth over a pixel of the working size, from which on there may be an edge."""


def fuse_depth(
    folder: RunFolder,
    sequence: Sequence,
    labelled: LabelledTracks,
    scene: Arrays,
    motion: Arrays,
    config: FusionConfig,
    reporter: Reporter,
    should_stop: Callable[[], bool],
    zoom: FloatArray | None = None,
    lens: Lens = PINHOLE,
) -> dict[str, Any]:
    """Write the fused depth of all frames, and how sure it is where static depth is made as a field.

    Args:
        folder: Of the run.
        sequence: Images, depth cue and masks.
        labelled: Observations, with the cue at each.
        scene: Record of stage 2.
        motion: Record of stage 3.
        config: Fusion.
        reporter: Progress, in frames.
        should_stop: Polled before every frame.
        zoom: (T,) focal length of each frame over that of the record's intrinsics; None without a zoom.
        lens: Distortion of the images; distorted ones are not matched.

    Returns:
        What the summary says of it: ``facts``, ``warnings`` and ``broken_frames``.

    Raises:
        Cancelled: If ``should_stop`` said so; nothing is left behind.
        OutputError: If the file cannot be written.
    """
    core, reason = find_extension()
    unmatched = "" if config.multiview.enabled else "is switched off"
    if config.multiview.enabled and not lens.is_pinhole:
        unmatched = "is not made of distorted images"
    elif config.multiview.enabled and zoom is not None:
        unmatched = "is not made of frames that zoom"
    elif config.multiview.enabled and core is None:
        unmatched = f"is left out, as {reason}: run `{INSTALL_COMMAND}`"
    sequence = replace(
        sequence,
        images=FramesInTurn(sequence.images),
        depths=FramesInTurn(sequence.depths),
        masks=FramesInTurn(sequence.masks),
    )
    control = [control_points(labelled, scene, motion, frame) for frame in range(sequence.num_frames)]
    broken = contradicting_frames(control, config)
    intrinsics = zoomed(scene["intrinsics"], zoom, sequence.num_frames)
    maps = DenseMaps(sequence, control, scene, config, intrinsics, frozenset(broken), unmatched)
    if not unmatched and not maps.gains_by_matching():
        unmatched = "adds nothing to this cue, as landmarks say"
    # Anew, as the frames that were tried are not in order.
    maps = replace(maps, unmatched=unmatched, bleeding_px=maps.bleeding_px or 0.0, matched=0, made={})
    remove_file(folder.confidence)
    with ExitStack() as files:
        writer = files.enter_context(write_depth(folder.depth, sequence.num_frames, sequence.image_size))
        working = maps.size.height, maps.size.width
        sure = None
        if config.static == "field":
            sure = files.enter_context(write_confidence(folder.confidence, sequence.num_frames, working))
        threads = thread_count()
        for first in range(0, sequence.num_frames, threads):
            if should_stop():
                raise Cancelled("stopped during fusion; finished stages are kept, --resume continues from them")
            frames = list(range(first, min(first + threads, sequence.num_frames)))
            maps.prepare(frames, threads)
            for frame, (depth, static) in zip(frames, map_in_order(maps.final, frames, threads), strict=True):
                writer.write(frame, depth)
                if sure is not None and static is not None:
                    sure.write(static.confidence)
                    maps.told.add(static.log_depth, static.confidence, static.still, *maps.landmarks_in(frame))
                reporter.advance(frame + 1)
    return maps.summary()


class FinalStatic(NamedTuple):
    """Static depth of one frame after averaging, at working size."""

    log_depth: Float32Array
    """(h, w), NaN where missing."""
    confidence: Float32Array
    """(h, w) probability that it is right to 3 %; 0 where something moves."""
    still: BoolArray
    """(h, w) outside of masks."""


_TRIED_FRAMES = 3
"""Frames that are matched first: where landmarks prefer the cue in all of them, no others are matched."""


@dataclass
class DenseMaps:
    """Dense depth of single frames, kept as long as frames near them need it; frames are asked for in order."""

    sequence: Sequence
    control: list[ControlPoints]
    scene: Arrays
    config: FusionConfig
    intrinsics: FloatArray
    """(T, 4) px."""
    broken: frozenset[int]
    """Frames whose cue is not used."""
    unmatched: str = ""
    """Why there is no depth from several views."""
    size: WorkingSize = field(init=False)
    multiview: MultiviewDepth = field(init=False)
    matched: int = 0
    """Frames with depth from several views."""
    bleeding_px: float | None = None
    """How far the cue bleeds across edges, working px; None as long as it is measured."""
    bled: list[float] = field(default_factory=list)
    """The same of single frames ..."""
    tried: list[float] = field(default_factory=list)
    """... and the error of matched depth at landmarks over that of the cue."""
    untold: bool = False
    """The cue was made from landmarks, which then do not judge it: matching counts if the cue bleeds."""
    told: ToldError = field(default_factory=ToldError)
    """Of the frames that are done."""
    made: dict[int, tuple[StaticDepth, Float32Array]] = field(default_factory=dict)
    """Per frame: static depth, and the raw cue, at working size."""

    def __post_init__(self) -> None:
        multiview = self.config.multiview
        self.size = WorkingSize.of(self.sequence.image_size, multiview.longer_side_px)
        poses: FloatArray = self.scene["world_T_cam"]
        self.multiview = MultiviewDepth(
            self._working_frame, self.size, self.intrinsics[0], poses, self._landmarks, multiview
        )

    def gains_by_matching(self) -> bool:
        """Tell whether landmarks prefer matched depth to the corrected cue in any of a few frames; uses up the maps."""
        sound = [frame for frame in range(self.sequence.num_frames) if frame not in self.broken]
        for at in evenly_spread(len(sound), _TRIED_FRAMES).tolist():
            self._static(sound[at])
        bled = float(np.median(self.bled)) if self.bled else 0.0
        self.bleeding_px = bled if bled > _SHARP_PX else 0.0
        limit = self._limit()
        return any(error < limit for error in self.tried) or bool(self.broken) or (self.untold and self.bleeding_px > 0)

    def _limit(self) -> float:
        """Return the error of matched depth at landmarks, over that of the cue, below which it is used."""
        return _NOT_WORSE if self.bleeding_px is None or self.bleeding_px > 0 else _BETTER

    def _given(self, frame: int) -> Float32Array:
        """Return the cue (H, W), m, NaN where it is not a depth."""
        cue = self.sequence.depths[frame]
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(cue) & (cue > 0.0), cue, np.float32(np.nan))

    def prepare(self, frames: list[int], threads: int) -> None:
        """Make what :meth:`final` needs for frames that follow each other, and forget what only those before needed."""
        if self.config.static == "nearest_points":
            return
        reach = max(self.config.averaged_offsets, default=0)
        self.made = {number: made for number, made in self.made.items() if number >= frames[0] - reach}
        near = {
            frame + sign * offset
            for frame in frames
            for offset in (0, *self.config.averaged_offsets, *(_BESIDE if frame in self.broken else ()))
            for sign in (-1, 1)
        }
        wanted = sorted(number for number in near if 0 <= number < self.sequence.num_frames and number not in self.made)
        alone = [number for number in wanted if number not in self.broken]
        # Frames that are matched share what they are matched with, and matching has threads of its own; a broken frame
        # takes its cue from others.
        map_in_order(self._static, alone, threads if self.unmatched else 1)
        for number in wanted:
            self._static(number)

    def final(self, frame: int) -> tuple[Float32Array, FinalStatic | None]:
        """Return the depth (H, W) of a frame, m, and what is known of static depth where that is made as a field.

        Frames that are prepared may be asked for on several threads.
        """
        mask = self.sequence.masks[frame]
        if self.config.static == "nearest_points":
            return self._by_nearest_points(frame, mask), None
        offsets = self.config.averaged_offsets
        static, cue = self._static(frame)
        poses: FloatArray = self.scene["world_T_cam"]
        near = [frame + sign * offset for offset in offsets for sign in (-1, 1)]
        averaged = average_over_frames(
            np.exp(static.log_depth),
            poses[frame],
            (
                (np.exp(self._static(other)[0].log_depth), poses[other], self._camera(other))
                for other in near
                if 0 <= other < len(poses)
            ),
            self._camera(frame),
            self.config.averaged_sigmas * float(np.clip(np.nanmedian(static.sigma), *_AVERAGED_SIGMA)),
        )
        log_depth = np.log(averaged.depth)
        unmasked = ~self.size.marked(mask)
        sure = np.where(unmasked | (static.matched > _STILL), final_confidence(static.confidence, averaged), 0)
        full = self._lifted(frame, log_depth, cue)
        if (mask > 0).any():
            # Masks reach beyond what moves: what other frames see there just the same stands still.
            still = self.size.enlarge(static.matched) > _STILL
            full = np.where((mask > 0) & ~still, np.exp(self._moving(frame)), full)
        return full, FinalStatic(log_depth, sure.astype(np.float32), unmasked)

    def _moving(self, frame: int) -> Float32Array:
        """Return the log depth (H, W) of what moves; means nothing elsewhere."""
        mask, mine = self.sequence.masks[frame], self.control[frame]
        corrected, raw = self._static(frame)[0].corrected, self._given(frame)
        log_depth = affine_log_depth(raw, corrected.scale, corrected.shift) + self.size.enlarge(corrected.field)
        radius = (self.bleeding_px or 0.0) / self.size.scale[0]
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
                pixels = self.sequence.masks[other] == label
                if pixels.any():
                    found.append((self.sequence.images[other], self._moving(other), pixels, 1.0 / step))
                    break
        return found

    def _lifted(self, frame: int, log_depth: Float32Array, cue: Float32Array) -> Float32Array:
        """Bring static depth to the size of the image: at edges by correcting the cue, which has the detail."""
        raw = self._given(frame)
        if frame in self.broken or self.bleeding_px:
            guided = np.exp(upsample_guided(log_depth, self.sequence.images[frame]))
            return np.where(np.isfinite(raw), guided, np.float32(np.nan))
        with np.errstate(invalid="ignore"):
            change = self.size.enlarge(log_depth - np.log(cue))
            detailed = np.log(raw) + change
            # Within a surface the coarse map is smooth, and has less noise than one frame's cue.
            window = np.ones((3, 3), np.uint8)
            filled = np.nan_to_num(log_depth, nan=-99.0)
            range_ = cv2.dilate(filled, window) - cv2.erode(filled, window)
            edge = np.clip(self.size.enlarge(range_.astype(np.float32)) / np.float32(_EDGE) - 1, 0, 1)
            smooth = self.size.enlarge(log_depth)
            blended = np.where(np.isfinite(smooth), (1 - edge) * np.nan_to_num(smooth) + edge * detailed, detailed)
            # Beside missing depth nothing is known at working size: there the cue has its frame's usual error.
            known = (log_depth - np.log(cue))[np.isfinite(log_depth) & np.isfinite(cue)]
            usual = np.log(raw) + np.float32(np.median(known) if known.size else np.nan)
            blended = np.where(np.isfinite(blended), blended, usual)
        return np.exp(np.where(np.isfinite(raw), blended, np.float32(np.nan)))

    def _by_nearest_points(self, frame: int, mask: Int32Array) -> Float32Array:
        return densify_frame(
            self._given(frame), mask, self.intrinsics[frame], self.control[frame],
            float(self.scene["log_scale"][frame]), float(self.scene["noise"][1]), self.config,
        )  # fmt: skip

    def _static(self, frame: int) -> tuple[StaticDepth, Float32Array]:
        if frame not in self.made:
            broken = frame in self.broken
            cue = self._carried(frame) if broken else self.size.depth(self._given(frame))
            shown = self.multiview.shown.get(frame) or self._working_frame(frame)
            measured = None if self.unmatched else self.multiview.at(frame)
            uv, log_scale_at, log_cue = self._landmark_cues(frame)
            if not broken:
                # The cue is read where the landmark is, between pixels: its error there holds for the pixel nearest.
                column, row = np.clip(np.rint(uv), 0, (self.size.width - 1, self.size.height - 1)).astype(np.int64).T
                nearest = cue[row, column]
                log_cue = np.where(np.isfinite(nearest), np.log(nearest), log_cue)
            log_z = log_scale_at + log_cue
            static, log_scale = np.isfinite(shown.matched), float(self.scene["log_scale"][frame])
            # Where landmarks say that the corrected cue is the better one, matches would only add their noise.
            errors = held_out_errors(cue, measured, uv, log_z, static, log_scale, self.config)
            if self.bleeding_px is None:
                self.tried.append(errors.matching)
                self.untold |= not errors.telling
            bleeds = self.bleeding_px is None or self.bleeding_px > 0
            if not (errors.matching < self._limit() or (bleeds and not errors.telling)):
                measured = None
            self.matched += measured is not None
            if measured is not None and self.bleeding_px == 0:
                measured = without_edges(measured, cue)
            known = known_depth(measured, uv, log_z, static, cue.shape)
            bleeding_px = self.bleeding_px or 0.0
            like_moving = np.zeros_like(static)
            if bleeding_px > 0 and not static.all():
                like_moving = looks_moving(self.sequence.images[frame], self.sequence.masks[frame], static)
            fused = fuse_static(
                cue, measured, known, errors.cue, static, like_moving, log_scale, bleeding_px, self.config
            )
            if measured is not None and self.bleeding_px is None:
                affine = affine_log_depth(cue, fused.corrected.scale, fused.corrected.shift)
                bled = bleeding_radius(affine, np.log(measured.depth), static & (measured.confidence > _SURE))
                self.bled += [bled] if np.isfinite(bled) else []
            self.made[frame] = fused, cue
        return self.made[frame]

    def landmarks_in(self, frame: int) -> tuple[FloatArray, FloatArray]:
        """Return where a frame sees landmarks, (N, 2) working px, and their log depth (N,)."""
        uv, log_scale, log_cue = self._landmark_cues(frame)
        return uv, log_scale + log_cue

    def _landmark_cues(self, frame: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where a frame sees landmarks, (N, 2) working px, log depth over the cue, and the log cue (N,)."""
        mine = self.control[frame]
        usable = (mine.instance == 0) & np.isfinite(mine.log_scale)
        return self.size.pixels(mine.uv[usable]), mine.log_scale[usable], np.log(mine.cue[usable])

    def _carried(self, frame: int) -> Float32Array:
        """Return a frame's depth as the nearest frames with a sound cue show it, at working size."""
        poses: FloatArray = self.scene["world_T_cam"]
        near = [frame + sign * step for step in range(1, _CARRIED_REACH + 1) for sign in (-1, 1)]
        sound = [other for other in near if 0 <= other < len(poses) and other not in self.broken][:_CARRIED_FROM]
        others = [(np.exp(self._static(other)[0].log_depth), poses[other], self._camera(other)) for other in sound]
        shape = (self.size.height, self.size.width)
        return carried_depth(shape, poses[frame], others, self._camera(frame))

    def _camera(self, frame: int) -> FloatArray:
        """Return intrinsics (4,) at working size."""
        return self.size.intrinsics(self.intrinsics[frame])

    def _working_frame(self, frame: int) -> WorkingFrame:
        return working_frame(
            self.sequence.images[frame], self.sequence.masks[frame], self.size, self.config.multiview.mask_band_px
        )

    def _landmarks(self, frame: int) -> FloatArray:
        points: FloatArray = self.control[frame].points[self.control[frame].instance == 0]
        return points

    def summary(self) -> dict[str, Any]:
        """Return facts and warnings; after the last frame."""
        out: dict[str, Any] = {"broken_frames": sorted(self.broken), "matched_frames": self.matched}
        done = f"in {self.matched} of {self.sequence.num_frames} frames"
        out["facts"] = [f"depth from several views {self.unmatched or done}"]
        error = self.told.mean()
        if error is not None:
            out["depth_error"] = error
            out["facts"].append(f"static depth is off by some {100 * error:.1f} % (estimated, but for scale)")
        if self.broken:
            out["warnings"] = [
                f"the depth cue of {len(self.broken)} frame(s) contradicts what the other frames show; their depth was "
                f"made without it: {some_of(sorted(self.broken))}"
            ]
        return out


def control_points(labelled: LabelledTracks, scene: Arrays, motion: Arrays, frame: int) -> ControlPoints:
    """Collect the landmarks and dynamic points that are seen, with a cue, in one frame."""
    pose = scene["world_T_cam"][frame]
    static_track: IntArray = scene["landmark_track"]
    seen = (labelled.weight[static_track, frame] > 0) & np.isfinite(labelled.depth[static_track, frame])
    moving_track: IntArray = motion["track"]
    here = motion["observed"][:, frame] & np.isfinite(labelled.depth[moving_track, frame])
    track = np.concatenate([static_track[seen], moving_track[here]]).astype(np.int64)
    points: FloatArray = np.concatenate([scene["landmarks"][seen], motion["points"][here, frame]])
    instance = np.concatenate([np.zeros(int(seen.sum())), motion["instance"][here]]).astype(np.int32)
    z = world_to_camera(np.broadcast_to(pose, (len(points), 4, 4)), points)[:, 2]
    cue = labelled.depth[track, frame].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        log_scale = np.where(z > 0, np.log(np.maximum(z, 1e-9)) - np.log(cue), np.nan)
    return ControlPoints(labelled.tracks.uv[track, frame].astype(np.float64), cue, log_scale, instance, points)
