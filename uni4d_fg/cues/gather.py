"""From a video to a sequence: cues that did not come with it are made, stored and reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array, at_nearest_pixel
from uni4d_fg.config.models import Config
from uni4d_fg.counted import counted
from uni4d_fg.cues.cache import FloatMaps
from uni4d_fg.cues.geometric_depth import GeometricDepth
from uni4d_fg.cues.geometry_makers import aligned_depth, geometric_depth, moving_masks, video_key
from uni4d_fg.cues.interpolated_depth import GridDepths
from uni4d_fg.cues.intrinsics import shared_intrinsics
from uni4d_fg.cues.manifest import save_manifest
from uni4d_fg.cues.network_makers import NetworkDepth, network_depth, network_masks, network_tracks
from uni4d_fg.cues.plan import GUESSED, CuePlan, CueReport
from uni4d_fg.cues.scale_notes import NOT_METRIC, NOT_METRIC_GIVEN, NOT_METRIC_RELATIVE
from uni4d_fg.cues.start_doubts import doubts_of_masks
from uni4d_fg.cues.structure.search import StartCameras
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.sequence.assemble import as_sequence
from uni4d_fg.frontend.sequence.bars import without_bars
from uni4d_fg.frontend.sequence.calibration import given_doubts, guess_intrinsics
from uni4d_fg.frontend.sequence.frames import no_masks
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.cache import load_or_track
from uni4d_fg.optim.threads import on_one_blas_thread
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel

_LESS_PARALLAX = 0.6
"""By which factor less parallax is enough once some was seen: what moved is masked then, and had its share in it."""


@on_one_blas_thread
def gather_cues(
    video: Video,
    plan: CuePlan,
    folder: Path,
    config: Config,
    *,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
    track_cache: Path | None = None,
) -> tuple[Sequence, CueReport]:
    """Make the cues that a video lacks.

    Args:
        video: Frames, and the cues that came with them.
        plan: Where every cue comes from.
        folder: Keeps what is made, frame by frame; what is there and fits is not made again. Not touched when
            nothing is to be made.
        config: Networks, tracker, geometry and motion masks.
        reporter: Progress.
        should_stop: Polled often.
        track_cache: Folder of the built-in tracker's memory; ``folder`` if not given.

    Returns:
        The video with all its cues, and what was made of what.

    Raises:
        ConfigError: If a model card is wrong, or the plan asks for a cue that is not there.
        InputError: If a frame, a cue or a network cannot be used.
        DegenerateProblemError: If depth or masks from motion are asked for and the motion does not determine them.
        MissingDependencyError: If ONNX Runtime is needed and not installed.
        OutputError: If ``folder`` cannot be written.
        Cancelled: If ``should_stop`` turned true; frames that are done are kept.
    """
    # For the tracker and the makers here; the stages look for themselves, as most cues are made of whole images.
    video = without_bars(video, look=config.input.black_bars == "auto")
    work = _Gathering(
        video, plan, folder, config, reporter or SilentReporter(), should_stop or (lambda: False), track_cache or folder
    )
    return work.run()


class _Gathering:
    """One video on its way to a sequence."""

    def __init__(
        self, video: Video, plan: CuePlan, folder: Path, config: Config, reporter: Reporter,
        should_stop: Callable[[], bool], track_cache: Path,
    ) -> None:  # fmt: skip
        self.video, self.plan, self.folder, self.config = video, plan, folder, config
        self.reporter, self.should_stop, self.track_cache = reporter, should_stop, track_cache
        self.report = CueReport()
        if plan.depth == "given" and not video.depth_is_metric:
            self.report.metric = False
            self.report.warnings.append(NOT_METRIC_GIVEN)
        self.depth_parallax = video.depth_parallax if plan.depth == "given" else None
        self.focal_sigma = video.focal_sigma if plan.depth == "given" else None
        self.tracks = video.tracks if plan.tracks == "given" else None
        self.track_file: Path | None = None
        self.intrinsics = video.intrinsics
        self.intrinsics_of_motion: FloatArray | None = None
        self.world_T_cam = video.initial_world_T_cam
        self.cameras_of_motion: FloatArray | None = None
        self.camera: CameraModel | None = None
        if not video.lens.is_pinhole and video.intrinsics is not None:
            self.camera = CameraModel(video.intrinsics, video.lens)
            # They belong to the lens.
            self.config = config.model_copy(update={"input": config.input.model_copy(update={"intrinsics": "fixed"})})
        self.moving_tracks: BoolArray | None = None
        self.motion_has_parallax = False
        self.is_read_at_once = True
        self.motion_facts: list[str] = []
        self.motion_warnings: list[str] = []
        self._video_key: str | None = None

    def run(self) -> tuple[Sequence, CueReport]:
        plan, report = self.plan, self.report
        self._sources()
        if plan.tracks == "card":
            self._network_tracks()
        masks = self._known_masks()
        network = self._network_depth() if plan.depth == "card" else None
        depths: FrameSource[Float32Array] | None = self.video.depths if plan.depth == "given" else None
        if network is not None and not network.is_affine:
            depths = network.maps
        if depths is None:
            depths = self._scaled_by_motion(network, masks)
        if masks is None:
            masks = self._motion_masks(depths)
            if plan.depth == "geometry" or (network is not None and network.is_affine):
                # What moves is known now, and was in the way of the cameras before.
                before = self.cameras_of_motion
                depths = self._scaled_by_motion(network, masks)
                if before is not None and self.cameras_of_motion is not None:
                    self.motion_warnings += doubts_of_masks(before, self.cameras_of_motion)
        if plan.keep_built_in_tracks:
            self._any_tracks()
        guessed = self.intrinsics is None and self.intrinsics_of_motion is None
        if guessed:
            report.sources["intrinsics"] = GUESSED
        if self.intrinsics_of_motion is not None and self.video.intrinsics is not None:
            self.motion_warnings[:0] = given_doubts(self.video.intrinsics, self.video.image_size)
        report.facts += self.motion_facts
        report.warnings[:0] = self.motion_warnings
        sequence = as_sequence(
            replace(
                self.video, depths=depths, masks=masks, tracks=self.tracks,
                intrinsics=None if guessed else self._best_intrinsics(),
                initial_world_T_cam=self.world_T_cam, content=None, depth_is_metric=report.metric,
                depth_parallax=self.depth_parallax, focal_sigma=self.focal_sigma,
                masks_from_motion=plan.masks == "motion" or (plan.masks == "given" and self.video.masks_from_motion),
                lens=self.video.lens if self.camera is None else self.camera.lens, zoom=self._zoom(),
            )
        )  # fmt: skip
        if not plan.is_given:
            save_manifest(self.folder, self.video, sequence, plan, report, self.track_file)
        return sequence, report

    def _sources(self) -> None:
        video, plan, sources = self.video, self.plan, self.report.sources
        for cue, source, there in (
            ("depth", plan.depth, video.depths is not None),
            ("masks", plan.masks, video.masks is not None),
            ("tracks", plan.tracks, video.tracks is not None),
        ):
            if source == "given" and not there:
                raise ConfigError(f"{video.name}: {cue} are to be taken as given, but the video brings none")
            sources[cue] = {
                "given": "given", "none": "none, everything is static", "built_in": "built-in tracker",
                "motion": "from motion", "geometry": "from camera motion", "card": "network",
            }[source]  # fmt: skip
        sources["intrinsics"] = "given" if video.intrinsics is not None else "not known"

    def _network_tracks(self) -> None:
        assert self.plan.track_model is not None
        self.tracks, title, self.track_file = network_tracks(
            self.video, self.plan.track_model, self.folder, self.config.networks, self.reporter, self.should_stop
        )
        self.report.sources["tracks"] = title
        self.report.facts.append(f"tracks: {self.tracks.num_tracks} by {title}")

    def _known_masks(self) -> FrameSource[Int32Array] | None:
        """Return the masks that need no depth, or None when they come from motion."""
        plan, video = self.plan, self.video
        if plan.masks == "motion":
            return None
        if plan.masks == "none":
            return no_masks(video.image_size, video.num_frames)
        if plan.masks == "given":
            return video.masks
        assert plan.mask_model is not None
        masks, title, count = network_masks(
            video, plan.mask_model, plan.classes, self.folder, self.config.networks,
            self.config.motion_masks.instances, self.reporter, self.should_stop,
        )  # fmt: skip
        self.report.sources["masks"] = title
        self.report.facts.append(f"masks: {counted(count, 'instance')} by {title}")
        if count == 0:
            self.report.warnings.append(f"{title} finds nothing that may move: everything is taken for static")
        return masks

    def _network_depth(self) -> NetworkDepth:
        video, plan, report = self.video, self.plan, self.report
        assert plan.depth_model is not None
        known = self.intrinsics is not None
        focal = float(self._start_intrinsics()[0])
        found = network_depth(
            video, plan.depth_model, focal, known, self.folder, self.config.networks, self.reporter, self.should_stop,
        )  # fmt: skip
        report.sources["depth"] = found.title
        if found.assumed_focal:
            report.warnings.append(
                f"{found.title} scales depth by the focal length, which is not known and was guessed: depth is metric "
                "only as far as the guess is right; give a calibration (K.npy)"
            )
        shared = None if known else shared_intrinsics(found.per_frame_intrinsics)
        if shared is not None:
            self.intrinsics = shared.intrinsics
            report.sources["intrinsics"] = found.title
            report.facts.append(
                f"intrinsics: fx {shared.intrinsics[0]:.1f} fy {shared.intrinsics[1]:.1f} px from {shared.used} frames "
                f"of {found.title}, which agree to {100 * shared.spread:.1f} %"
            )
            report.warnings += shared.warnings()
        return found

    def _scaled_by_motion(
        self, network: NetworkDepth | None, masks: FrameSource[Int32Array] | None
    ) -> FrameSource[Float32Array]:
        """Return depth up to scale: from camera motion alone, or a network's relative depth scaled by it."""
        tracks, video, report = self._any_tracks(), self.video, self.report
        static = np.ones(tracks.num_tracks, bool) if masks is None else static_tracks(tracks, masks)
        config = self.config
        if self.motion_has_parallax:
            settings = config.geometric_depth
            lower = settings.model_copy(update={"min_parallax_px": _LESS_PARALLAX * settings.min_parallax_px})
            config = config.model_copy(update={"geometric_depth": lower})
        masked = replace(video, masks=masks)
        start = None
        if self.motion_has_parallax and self.cameras_of_motion is not None and self.intrinsics_of_motion is not None:
            start = StartCameras(self.cameras_of_motion, self.intrinsics_of_motion)

        def from_motion(intrinsics: FloatArray) -> GeometricDepth:
            return geometric_depth(
                masked, tracks, static, intrinsics, self._known_camera(), start, self._key(), self.folder, config,
                self.reporter, self.should_stop,
            )  # fmt: skip

        found = from_motion(self._start_intrinsics())
        if not found.has_parallax and self.intrinsics_of_motion is not None:
            # Rotations are best at the focal length that the first round found.
            found = from_motion(self.intrinsics_of_motion)
        report.metric = False
        report.start = found.start
        self.motion_has_parallax = found.has_parallax
        self.cameras_of_motion = found.world_T_cam
        self.moving_tracks = found.moving
        if found.stray.any():
            self.tracks = tracks = tracks.without(found.stray)
        self.intrinsics_of_motion, self.focal_sigma = found.intrinsics, found.focal_sigma
        if found.has_parallax:
            self.camera, self.is_read_at_once = found.camera, found.is_read_at_once
        if video.intrinsics is None:
            report.sources["intrinsics"] = "from camera motion"
        self.motion_facts = [f"depth: {fact}" for fact in found.facts]
        if network is None:
            self.motion_warnings = [NOT_METRIC, *found.warnings]
            self.depth_parallax = found.has_parallax
            self.world_T_cam = found.world_T_cam
            return found.depths
        self.motion_warnings = [NOT_METRIC_RELATIVE, *found.warnings]
        depths, facts, warnings = aligned_depth(
            network.maps, tracks, found, self.folder, self.config, self.reporter, self.should_stop
        )
        self.motion_facts += [f"depth: {fact}" for fact in facts]
        self.motion_warnings += warnings
        return depths

    def _motion_masks(self, depths: FrameSource[Float32Array]) -> FrameSource[Int32Array]:
        tracks = self._any_tracks()
        masks, facts, warnings = moving_masks(
            self.video, depths, tracks, self._best_camera(), self._key(), _name_of(depths), self.moving_tracks,
            self.cameras_of_motion, self.folder, self.config, self.reporter, self.should_stop,
        )  # fmt: skip
        self.report.facts += [f"masks: {fact}" for fact in facts]
        self.report.warnings += warnings
        return masks

    def _known_camera(self) -> CameraModel | None:
        """Return a lens or a zoom that needs not be looked for; None lets the tracks tell.

        A lens that was found among things that move is looked for again once they are masked: they can mimic one. But
        if all tracks of the picture ask for none, those that are left after masking hardly do. Whether there is a zoom
        is asked again, too, but not which: its search takes twice as long.
        """
        camera = self.camera
        if camera is None or camera.zoom is not None or not self.video.lens.is_pinhole:
            return camera
        return CameraModel(self._start_intrinsics()) if camera.is_plain and self.is_read_at_once else None

    def _best_camera(self) -> CameraModel:
        """Return what is known of the camera so far, its lens and zoom too."""
        camera = self.camera or CameraModel(self._best_intrinsics())
        return replace(camera, intrinsics=self._best_intrinsics())

    def _best_intrinsics(self) -> FloatArray:
        """Return what is known of the intrinsics so far, (4,) px, from camera motion too."""
        return self._start_intrinsics() if self.intrinsics_of_motion is None else self.intrinsics_of_motion

    def _start_intrinsics(self) -> FloatArray:
        """Return what is known of the intrinsics before camera motion, (4,) px; a guess where that is nothing.

        Also in the second round: a focal length that the motion left open is no knowledge for the next.
        """
        return guess_intrinsics(self.video.image_size) if self.intrinsics is None else self.intrinsics

    def _zoom(self) -> FloatArray | None:
        """Return the focal length of each frame over the longest (T,); None where the camera does not zoom."""
        zoom = None if self.camera is None else self.camera.zoom
        return self.video.zoom if zoom is None else zoom

    def _key(self) -> str:
        if self._video_key is None:
            self._video_key = video_key(self.video, self.should_stop)
        return self._video_key

    def _any_tracks(self) -> Tracks:
        """Return tracks, by the built-in tracker where there are none."""
        if self.tracks is None:
            total = 2 * (self.video.num_frames - 1)
            self.reporter.begin("tracks", total)
            self.tracks = load_or_track(
                self.video, self.config.tracking, self.track_cache,
                lambda done, _: self.reporter.advance(done), self.should_stop,
            )  # fmt: skip
            self.reporter.end(f"{self.tracks.num_tracks} tracks")
            self.report.facts.append(f"tracks: {self.tracks.num_tracks} by the built-in tracker")
        return self.tracks


def static_tracks(tracks: Tracks, masks: FrameSource[Int32Array]) -> BoolArray:
    """Return (K,) which tracks are never seen on a mask."""
    static = np.ones(tracks.num_tracks, bool)
    for frame, mask in enumerate(masks):
        seen = np.flatnonzero(tracks.visible[:, frame])
        static[seen[at_nearest_pixel(mask, tracks.uv[seen, frame]) != 0]] = False
    return static


def _name_of(depths: FrameSource[Float32Array]) -> str:
    """Return what tells depth that was made from other depth of the same images; given depth is in the video's key."""
    if isinstance(depths, GridDepths):
        return depths.name
    return depths.paths[0].parent.name if isinstance(depths, FloatMaps) else "given"
