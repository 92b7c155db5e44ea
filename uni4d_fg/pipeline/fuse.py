"""Dense depth of every frame from the sparse result, written frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.files import remove_file
from uni4d_fg.frontend.sequence.frames import FramesInTurn
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.optim.extension import INSTALL_COMMAND, find_extension
from uni4d_fg.optim.threads import thread_count
from uni4d_fg.pipeline.control import BegunControl, with_moving
from uni4d_fg.pipeline.dense_maps import DenseMaps
from uni4d_fg.pipeline.fuse_parts import can_be_sent, fuse_in_parts
from uni4d_fg.pipeline.fused_frames import fused_frames
from uni4d_fg.pipeline.path_uncertainty import path_uncertainty
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.pipeline.window_workers import WindowWorkers
from uni4d_fg.progress import Reporter
from uni4d_fg.results.confidence_store import ConfidenceWriter, write_confidence
from uni4d_fg.results.depth_store import DepthWriter, write_depth
from uni4d_fg.results.fusion.matching_size import finer_settings, matching_side
from uni4d_fg.results.fusion.multiview.ideal_size import ideal_size
from uni4d_fg.results.fusion.multiview.working_frame import WorkingSize
from uni4d_fg.results.fusion.static_depth import probability_right
from uni4d_fg.results.fusion.told_error import ToldError
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import zoomed

_STOPPED = "stopped during fusion; finished stages are kept, --resume continues from them"
_LEAST_SHARE = 0.1
"""However bad the path: so that of pixels the surer ones can still be told, in the 8 bits that confidence has."""


def fuse_depth(
    folder: RunFolder,
    sequence: Sequence,
    labelled: LabelledTracks,
    scene: Arrays,
    motion: Arrays,
    config: FusionConfig,
    reporter: Reporter,
    should_stop: Callable[[], bool],
    zoom: FloatArray | None,
    lens: Lens,
    workers: WindowWorkers | None,
    static: BegunControl,
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
        lens: Distortion of the images.
        workers: Processes of this machine that make parts of the frames, if they can read them; the result is the same.
        static: What landmarks say of the frames.

    Returns:
        What the summary says of it: ``facts``, ``warnings`` and ``broken_frames``.

    Raises:
        Cancelled: If ``should_stop`` said so; nothing is left behind.
        OutputError: If the file cannot be written.
    """
    sequence = replace(
        sequence,
        images=FramesInTurn(sequence.images),
        depths=FramesInTurn(sequence.depths),
        masks=FramesInTurn(sequence.masks),
    )
    intrinsics = zoomed(scene["intrinsics"], zoom, sequence.num_frames)
    known = static.of(scene)
    control = [with_moving(points, labelled, scene, motion, frame) for frame, points in enumerate(known.frames)]
    plain = WorkingSize.of(sequence.image_size, matching_side(sequence.image_size, config.multiview))
    config = config.model_copy(update={"multiview": finer_settings(config.multiview, plain.times_finer)})
    size = ideal_size(plain, lens, intrinsics[0]) if zoom is None else plain
    maps = DenseMaps(
        sequence,
        control,
        scene,
        config,
        intrinsics,
        frozenset(known.broken),
        _unmatchable(config, zoom is not None and not lens.is_pinhole, size, sequence.depth_parallax),
        thread_count(),
        size or plain,
        landmark_sigma=known.sigma,
    )
    maps.try_matching()
    right = share_right(path_uncertainty(scene["world_T_cam"], scene.get("pose_covariance")))
    told = ToldError(maps.is_interpolated, float(scene.get("focal_depth_error", 0.0)))
    remove_file(folder.confidence)
    with ExitStack() as files:
        writer = files.enter_context(write_depth(folder.depth, sequence.num_frames, sequence.image_size))
        working = plain.height, plain.width
        sure = None
        if config.static == "field":
            sure = files.enter_context(write_confidence(folder.confidence, sequence.num_frames, working))
        if workers is not None and can_be_sent(maps):
            _on_workers(maps, workers, writer, sure, told, right, reporter)
            return _summary(maps, told)
        for fused in fused_frames(maps, 0, sequence.num_frames):
            if should_stop():
                raise Cancelled(_STOPPED)
            writer.write(fused.frame, fused.depth)
            _note(sure, told, right, fused.confidence, fused.told)
            reporter.advance(fused.frame + 1)
    return _summary(maps, told)


def _on_workers(
    maps: DenseMaps, workers: WindowWorkers, writer: DepthWriter, sure: ConfidenceWriter | None, told: ToldError,
    right: float, reporter: Reporter,
) -> None:  # fmt: skip
    try:
        for part in fuse_in_parts(maps, writer, workers, reporter.advance):
            for confidence, of_frame in zip(part.confidence, part.told, strict=True):
                _note(sure, told, right, confidence, of_frame)
    except Cancelled as error:
        raise Cancelled(_STOPPED) from error


def _note(
    sure: ConfidenceWriter | None, told: ToldError, right: float, confidence: ImageArray | None, of_frame: ToldError
) -> None:
    """Keep how sure the next frame's depth is (the cameras share ``right`` of that), and what is told of its error."""
    if sure is not None and confidence is not None:
        sure.write_steps(np.rint(right * confidence).astype(np.uint8))
        told.follow(of_frame)


def share_right(uncertainty: float) -> float:
    """Return the probability that depth is right to 3 % as far as the path goes, whose uncertainty this is.

    Triangulated depth is off by the same part as the distance between the cameras that saw it. 1 where nothing is
    known.
    """
    return 1.0 if math.isnan(uncertainty) else max(float(probability_right(np.float32(uncertainty))), _LEAST_SHARE)


def _unmatchable(
    config: FusionConfig, zooms_and_bends: bool, size: WorkingSize | None, depth_parallax: bool | None
) -> str:
    """Return why there can be no depth from several views, which no size is for; nothing if there can be."""
    core, reason = find_extension()
    if not config.multiview.enabled:
        return "is switched off"
    if depth_parallax is False:
        return "is not made of a camera that stays in one place"
    if zooms_and_bends:
        return "is not made of frames that zoom through a lens that bends them"
    if size is None:
        return "is not made of images of so wide a lens"
    return "" if core is not None else f"is left out, as {reason}: run `{INSTALL_COMMAND}`"


def _summary(maps: DenseMaps, told: ToldError) -> dict[str, Any]:
    """Return facts and warnings; after the last frame."""
    broken, matched = sorted(maps.broken), len(maps.matched)
    out: dict[str, Any] = {"broken_frames": broken, "matched_frames": matched}
    out["facts"] = [f"depth from several views {maps.unmatched or f'in {matched} of {len(maps.control)} frames'}"]
    error = told.mean()
    if maps.sequence.depth_parallax is False:
        out["depth_is_unknown"] = True
        out["facts"].append("nothing is known of depth: the camera stays in one place, and a distance was assumed")
    elif error is not None:
        out["depth_error"] = error
        out["facts"].append(f"static depth is off by some {100 * error:.1f} % (estimated, but for scale)")
    if broken:
        out["warnings"] = [
            f"the depth cue of {len(broken)} frame(s) contradicts what the other frames show; their depth was "
            f"made without it: {some_of(broken)}"
        ]
    return out
