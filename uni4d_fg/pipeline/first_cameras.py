"""The cameras that stages begin with: beside the depth cue, or from the tracks alone where it is too poor for that.

A depth cue helps the cameras where it is right: it holds the scale of the path, and tells the focal length where
parallax does not. One that errs by several percent, alike over large parts of the image and over many frames, does the
reverse. Tracks have a hundred times its precision, but it bends what they leave open, the focal length above all, and
its errors are no noise that many observations average out. The cameras are then found by structure from motion, and
stage 2 keeps its focal lengths, as for a video without depth; the cue is left with the scale of the world.

Through a lens or a zoom depths contradict each other as well, but no longer with the lens or the zoom that was found
beside them. Where they still do, that is not believed: structure from motion looks for both itself, and takes such a
zoom for one start among others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.depth_settings import (
    settings_behind_lens,
    settings_of_motion,
    without_depth_prior,
    without_rolling_shutter,
)
from uni4d_fg.errors import Cancelled, SolverError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.fingerprint import stage_key
from uni4d_fg.pipeline.in_progress import RunInProgress
from uni4d_fg.pipeline.lens import as_pinhole, found_camera
from uni4d_fg.pipeline.steps import STOPPED, Arrays, camera_init_step
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.warnings import KEEP_GIVEN
from uni4d_fg.progress import Reporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.lifting import frame_log_scales
from uni4d_fg.slam.stages.observations import Observations, observations_of

_STEP = "structure_from_motion"

_POSED = 0.9
"""Part of the frames that must have a pose: stage 2 finds that of others, from one between those of their neighbors."""


@dataclass(frozen=True)
class StageInputs:
    """What stages 1 to 3 solve: what a pinhole that does not zoom would have seen."""

    sequence: Sequence
    labelled: LabelledTracks
    config: Config

    @classmethod
    def of(
        cls, sequence: Sequence, labelled: LabelledTracks, camera: CameraModel, config: Config, *, depth_is_needed: bool
    ) -> StageInputs:
        """Undo the lens and the zoom of a camera, and choose the settings that its origin asks for.

        ``depth_is_needed`` says whether the run relies on the depth cue for the scale of the world.
        """
        ideal, tracks, settings = as_pinhole(camera, sequence, labelled, config)
        return cls(ideal, tracks, settings_behind_lens(settings, sequence, depth_is_needed=depth_is_needed))


@dataclass(frozen=True)
class FirstCameras:
    """What bundle adjustment begins from."""

    camera: CameraModel
    inputs: StageInputs
    poses: Arrays
    """A record with ``world_T_cam`` (T, 4, 4) and ``intrinsics`` (4,) px."""
    key: str
    """Of that record."""


def first_cameras(
    run: RunInProgress,
    key: str,
    sequence: Sequence,
    labelled: LabelledTracks,
    camera: CameraModel,
    run_stage: StageRunner,
    *,
    is_sought: bool,
    depth_is_needed: bool,
) -> FirstCameras:
    """Run stage 1, and structure from motion where that shows that the depth cue is poor.

    Args:
        run: The run.
        key: Of what goes into stage 1.
        sequence: Cues of the frames that are solved.
        labelled: Its tracks, on real pixels.
        camera: What is known of the camera.
        run_stage: What solves each declared stage.
        is_sought: Whether lens and zoom are what tracks and depth cue ask for, and not given.
        depth_is_needed: Whether the run relies on the depth cue for the scale of the world.

    Raises:
        Cancelled: If the user interrupts.
        DegenerateProblemError: If no two frames share enough tracks with depth.
        SolverError: If a window cannot be solved.
    """
    inputs = StageInputs.of(sequence, labelled, camera, run.config, depth_is_needed=depth_is_needed)
    poses = run.step(
        "camera_init",
        key,
        lambda hooks: camera_init_step(inputs.sequence, inputs.labelled, inputs.config, hooks, run_stage),
    )
    if not _is_poor(poses, inputs.config):
        run.forget(_STEP)
        return FirstCameras(camera, inputs, poses, key)
    key = stage_key(key, run.config.geometric_depth, run.config.bundle_adjustment, *([run.config.camera] * is_sought))
    seen = StageInputs(sequence, labelled, run.config) if is_sought else inputs
    beside = camera if is_sought else None
    found = run.step(_STEP, key, lambda hooks: _structure_step(seen, poses, beside, hooks, run.reporter))
    if "focal_sigma" not in found:
        return FirstCameras(camera, inputs, found, key)
    if is_sought:
        camera = _found_camera(found, sequence)
        inputs = StageInputs.of(sequence, labelled, camera, run.config, depth_is_needed=depth_is_needed)
    return FirstCameras(camera, _with_known_cameras(inputs, found), found, key)


def _is_poor(cameras: Arrays, config: Config) -> bool:
    """Tell from the record of stage 1 whether the cameras are to be found without the depth cue."""
    limit = config.camera_init.max_depth_spread
    return limit is not None and "depth_spread" in cameras and bool(cameras["depth_spread"] > limit)


@dataclass(frozen=True)
class _Steps:
    """The steps of structure from motion as progress of the step of the run that they are part of."""

    reporter: Reporter

    def begin(self, task: str, total: int | None) -> None:
        self.reporter.advance(0, task)

    def advance(self, done: int, text: str = "") -> None:
        self.reporter.advance(done, text)

    def end(self, text: str = "") -> None:
        pass


def _structure_step(
    seen: StageInputs, cameras: Arrays, beside_cue: CameraModel | None, hooks: Hooks, reporter: Reporter
) -> StageRecord:
    """Find cameras by structure from motion; those of stage 1 are kept where the motion shows none.

    Args:
        seen: Image size, intrinsics, tracks, of which the static ones serve, and settings.
        cameras: Record of stage 1.
        beside_cue: What was found of a lens and a zoom with the depth cue: they are looked for again without it. None
            where they are given.
        hooks: Cancellation.
        reporter: Progress.

    Raises:
        Cancelled: If the user interrupts.
    """
    # Hundreds of milliseconds to load, and most runs need nothing of it.
    from uni4d_fg.cues.start_doubts import start_doubts, start_summary
    from uni4d_fg.cues.structure.motion import structure_from_motion

    spread = float(cameras["depth_spread"])
    said = f"depths of static points depart by {100 * spread:.0f} % from frame to frame"
    sequence, labelled = seen.sequence, seen.labelled
    # One has been asked for, and what was found is undone.
    config = without_rolling_shutter(seen.config)
    static = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC).with_min_observations(2)
    if len(np.unique(static.track)) < config.geometric_depth.min_pose_points:
        return _kept(cameras, said, "tracks are few")
    try:
        found = structure_from_motion(
            replace(static, weight=np.ones(len(static)), depth=np.full(len(static), np.nan)),
            labelled.tracks.num_frames, sequence.image_size, sequence.intrinsics, config, _Steps(reporter),
            hooks.should_stop or (lambda: False), any_camera=beside_cue is not None, proposed=beside_cue,
            blur_px=labelled.tracks.blur_px,
        )  # fmt: skip
    except Cancelled as error:
        raise Cancelled(STOPPED) from error
    except SolverError as error:
        return _kept(cameras, said, f"none were found without them: {error}")
    if found is None or found.registered.mean() < _POSED:
        return _kept(cameras, said, "the camera hardly moves" if found is None else "many frames see too few points")
    poses = se3.inverse(found.world_T_cam[0]) @ found.world_T_cam
    row = np.full(len(labelled.label), -1)
    row[found.track] = np.arange(len(found.track))
    static = found.camera.ideal_observations(static)
    some = static.select((row[static.track] >= 0) & np.isfinite(static.depth))
    poses[:, :3, 3] *= _scale(some, found.world_T_cam, found.points.position[row[some.track]])
    camera = found.camera.facts()
    if beside_cue is not None and not beside_cue.is_plain and not camera:
        camera = ["the tracks alone ask for a pinhole that does not zoom"]
    summary: dict[str, Any] = {
        "facts": [
            f"{said}, so the tracks alone find the cameras: fx {found.intrinsics[0]:.1f} px, known to "
            f"{100 * found.focal_sigma:.1f} %",
            *camera,
        ],
        "depth_spread": spread,
        "start": start_summary(found),
        "warnings": start_doubts(found, KEEP_GIVEN),
    }
    arrays = {
        "world_T_cam": poses, "intrinsics": found.intrinsics, "focal_sigma": np.array(found.focal_sigma),
        "camera": found.camera.to_array(),
    }  # fmt: skip
    return StageRecord(arrays, summary)


def _kept(cameras: Arrays, said: str, why: str) -> StageRecord:
    """Return the cameras of stage 1, which rest on depths that are poor."""
    warning = f"{said}, and cameras are found with them all the same, as {why}: path and focal lengths may be wrong"
    record = {name: cameras[name] for name in ("world_T_cam", "intrinsics")}
    return StageRecord(record, {"warnings": [f"{warning}; give better depth maps, or intrinsics that are right"]})


def _scale(observations: Observations, world_T_cam: FloatArray, points: FloatArray) -> float:
    """Return the factor on the depths of observed points (N, 3) with which the median frame agrees with its cue."""
    known = np.asarray(np.isfinite(points).all(axis=1))
    seen = observations.select(known)
    scales = frame_log_scales(seen, world_T_cam, points[known], len(world_T_cam))[np.unique(seen.frame)]
    return float(np.exp(-np.median(scales))) if len(scales) else 1.0


def _found_camera(found: Arrays, sequence: Sequence) -> CameraModel:
    """Return the lens and the zoom of the record of :func:`_structure_step`."""
    camera = found_camera(found)
    if camera.is_plain:
        return CameraModel(sequence.intrinsics)
    return replace(camera, focal_sigma=float(found["focal_sigma"]))


def _with_known_cameras(inputs: StageInputs, found: Arrays) -> StageInputs:
    """Return what stage 2 solves from the record of :func:`_structure_step`: focal lengths and the use of depth."""
    sequence = replace(inputs.sequence, focal_sigma=float(found["focal_sigma"]))
    return replace(inputs, sequence=sequence, config=without_depth_prior(settings_of_motion(inputs.config)))
