"""Cameras from the tracks alone, where the depth cue is too poor to say anything of them.

A depth cue helps the cameras where it is right: it holds the scale of the path, and tells the focal length where
parallax does not. One that errs by several percent, alike over large parts of the image and over many frames, does the
reverse. Tracks have a hundred times its precision, but it bends what they leave open, the focal length above all, and
its errors are no noise that many observations average out. The cameras are then found by structure from motion, and
stage 2 keeps its focal lengths, as for a video without depth; the cue is left with the scale of the world.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.depth_settings import settings_of_motion, without_depth_prior
from uni4d_fg.errors import Cancelled, SolverError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.pipeline.fingerprint import stage_key
from uni4d_fg.pipeline.in_progress import RunInProgress
from uni4d_fg.pipeline.steps import STOPPED, Arrays
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.progress import Reporter
from uni4d_fg.slam.stages.lifting import frame_log_scales
from uni4d_fg.slam.stages.observations import Observations, observations_of

_STEP = "structure_from_motion"
_REMEDY = "set input.intrinsics=fixed if those that were given are right"

_POSED = 0.9
"""Part of the frames that must have a pose: stage 2 finds that of others, from one between those of their neighbors."""


def without_poor_depth(
    run: RunInProgress, key: str, sequence: Sequence, labelled: LabelledTracks, cameras: Arrays, config: Config
) -> tuple[Sequence, Config, Arrays, str]:
    """Find the cameras from the tracks alone where the depth cue is poor.

    Args:
        run: The run.
        key: Of stage 1.
        sequence: What stages solve.
        labelled: Its tracks.
        cameras: Record of stage 1.
        config: What stages are solved with.

    Returns:
        What stage 2 is solved with: sequence, configuration, starting cameras and the key of those.

    Raises:
        Cancelled: If the user interrupts.
    """
    if not _is_poor(cameras, config):
        run.forget(_STEP)
        return sequence, config, cameras, key
    key = stage_key(key, config.geometric_depth, config.bundle_adjustment)
    found = run.step(
        _STEP, key, lambda hooks: _structure_step(sequence, labelled, cameras, config, hooks, run.reporter)
    )
    return *_with_known_cameras(sequence, found, config), found, key


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
    sequence: Sequence, labelled: LabelledTracks, cameras: Arrays, config: Config, hooks: Hooks, reporter: Reporter
) -> StageRecord:
    """Find cameras by structure from motion; those of stage 1 are kept where the motion shows none.

    Args:
        sequence: Image size and intrinsics.
        labelled: All tracks; the static ones serve.
        cameras: Record of stage 1.
        config: Sections ``geometric_depth``, ``bundle_adjustment`` and ``input``.
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
    kept = {name: cameras[name] for name in ("world_T_cam", "intrinsics")}
    static = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC).with_min_observations(2)
    if len(np.unique(static.track)) < config.geometric_depth.min_pose_points:
        return StageRecord(kept, {"facts": [f"{said}; cameras are found with them all the same, as tracks are few"]})
    try:
        found = structure_from_motion(
            replace(static, weight=np.ones(len(static)), depth=np.full(len(static), np.nan)),
            labelled.tracks.num_frames, sequence.image_size, sequence.intrinsics, config, _Steps(reporter),
            hooks.should_stop or (lambda: False),
        )  # fmt: skip
    except Cancelled as error:
        raise Cancelled(STOPPED) from error
    except SolverError as error:
        return StageRecord(kept, {"facts": [f"{said}; no cameras were found without them: {error}"]})
    if found is None or found.registered.mean() < _POSED:
        why = "the camera hardly moves" if found is None else "many frames see too few points"
        return StageRecord(kept, {"facts": [f"{said}; cameras are found with them all the same, as {why}"]})
    poses = se3.inverse(found.world_T_cam[0]) @ found.world_T_cam
    row = np.full(len(labelled.label), -1)
    row[found.track] = np.arange(len(found.track))
    some = static.select((row[static.track] >= 0) & np.isfinite(static.depth))
    poses[:, :3, 3] *= _scale(some, found.world_T_cam, found.points.position[row[some.track]])
    summary: dict[str, Any] = {
        "facts": [
            f"{said}, so the tracks alone find the cameras: fx {found.intrinsics[0]:.1f} px, known to "
            f"{100 * found.focal_sigma:.1f} %"
        ],
        "depth_spread": spread,
        "start": start_summary(found),
        "warnings": start_doubts(found, sequence.image_size, config.geometric_depth, _REMEDY),
    }
    arrays = {"world_T_cam": poses, "intrinsics": found.intrinsics, "focal_sigma": np.array(found.focal_sigma)}
    return StageRecord(arrays, summary)


def _scale(observations: Observations, world_T_cam: FloatArray, points: FloatArray) -> float:
    """Return the factor on the depths of observed points (N, 3) with which the median frame agrees with its cue."""
    known = np.asarray(np.isfinite(points).all(axis=1))
    seen = observations.select(known)
    scales = frame_log_scales(seen, world_T_cam, points[known], len(world_T_cam))[np.unique(seen.frame)]
    return float(np.exp(-np.median(scales))) if len(scales) else 1.0


def _with_known_cameras(sequence: Sequence, cameras: Arrays, config: Config) -> tuple[Sequence, Config]:
    """Return what stage 2 solves from the record of :func:`_structure_step`: focal lengths and the use of depth."""
    if "focal_sigma" not in cameras:
        return sequence, config
    sequence = replace(sequence, focal_sigma=float(cameras["focal_sigma"]))
    return sequence, without_depth_prior(settings_of_motion(config))
