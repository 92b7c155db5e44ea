"""Whether a camera zooms, and how: the focal length of every frame, where the images ask for it.

At the minimum of a camera that does not zoom, a few undamped steps with a focal length per frame tell by which part the
reprojection energy would fall; the errors of a tracker reach no fixed part of it, as with the lens. Only where they do,
everything is solved to the end. A lens with distortion asks for a zoom, too, where the camera moves along its view, but
for itself more. A zoom moves all pixels alike, motion along the view moves near ones more: the two are
told apart by the relief of the scene and by its depth. The covariance of the solve says how well.

A thing that moves and that no mask covers lets a zoom take away energy, too: its own, at the cost of what stands. A
zoom that is one explains most tracks better.

A camera that does not zoom can end far from one that does, where a few steps say little of the zoom and distortion
takes away more. A zoom that is asked for beside a lens is therefore solved after it, and compared with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.camera import CameraConfig
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.slam.lens.fit import FittedLens
from uni4d_fg.slam.lens.zoom_fit import FittedZoom, ZoomFit
from uni4d_fg.slam.stages.scene import StaticScene


@dataclass(frozen=True)
class ZoomCalibration:
    """What was found."""

    zoom: FloatArray | None
    """(T,) focal length of each frame over that of the intrinsics, at most 1; None where the camera does not zoom."""
    intrinsics: FloatArray
    """(4,) px, of the longest focal length."""
    evidence: float
    """Part of the reprojection energy that a focal length per frame takes away."""
    open_by: float
    """Standard deviation of the log focal length, relative to the first frame, where it is largest."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    beside_lens: bool = False
    """Whether tracks ask for a zoom, but for distortion more: :func:`solve_zoom` compares it with the lens."""


def find_zoom(work: ZoomFit, scene: StaticScene, num_frames: int, config: CameraConfig) -> ZoomCalibration:
    """Find the focal length of every frame, where the tracks ask for that first.

    Args:
        work: The tracks, and how they are fitted.
        scene: Stages 1 and 2 of a camera that does not zoom.
        num_frames: T of the video.
        config: What is asked for.

    Raises:
        DegenerateProblemError: If the cues do not determine the cameras.
        SolverError: If a system is singular or a cue is not finite.
    """
    stride = int(work.frames[1] - work.frames[0]) if len(work.frames) > 1 else 1
    none = ZoomCalibration(None, scene.cameras.intrinsics, 0.0, 0.0)
    if work.frames[-1] + stride < num_frames:
        return replace(none, notes=(f"no zoom was sought: tracks are too short for {num_frames} frames",))
    if config.zoom == "on":
        return solve_zoom(work, scene, FittedLens(PINHOLE, scene), num_frames, config)
    probe = work.probe(scene)
    said = f"a focal length per frame would lower the reprojection energy by {100 * probe.evidence:.2f} %"
    none = replace(none, evidence=probe.evidence, open_by=_spread(probe), warnings=_warnings(probe))
    moves = float(np.ptp(probe.zoom)) >= _PROBED * config.min_zoom or probe.evidence >= _LOUD
    if probe.evidence < config.min_zoom_evidence or not moves:
        return replace(none, notes=(said,))
    distortion = work.fit.probe(scene) if config.model == "auto" else 0.0
    if distortion > probe.evidence:
        return replace(none, notes=(f"{said}, distortion by {100 * distortion:.2f} %",), beside_lens=True)
    return solve_zoom(work, scene, FittedLens(PINHOLE, scene), num_frames, config)


def solve_zoom(
    work: ZoomFit, scene: StaticScene, rival: FittedLens, num_frames: int, config: CameraConfig
) -> ZoomCalibration:
    """Solve for the focal length of every frame to the end, and take it if it explains the tracks best.

    Args:
        work: The tracks, and how they are fitted.
        scene: Stages 1 and 2 of a camera that does not zoom.
        rival: The camera that the zoom is compared with: that pinhole, or a lens.
        num_frames: T of the video.
        config: What is asked for.

    Raises:
        DegenerateProblemError: If the cues do not determine the cameras.
        SolverError: If a system is singular or a cue is not finite.
    """
    found = work.solve(scene)
    for _ in range(1, config.rounds):
        found = work.refine(found)
    warnings = _warnings(found)
    none = ZoomCalibration(None, scene.cameras.intrinsics, found.evidence, _spread(found), warnings=warnings)
    span = float(np.expm1(np.ptp(found.zoom)))
    note = f"a focal length per frame lowers the reprojection energy by {100 * found.evidence:.2f} %"
    if config.zoom == "auto" and (found.evidence < config.min_zoom_evidence or span < config.min_zoom):
        return replace(none, notes=(f"{note} and varies by {100 * span:.1f} % only",))
    if config.zoom == "auto":
        agreement = work.agreement(found, scene)
        note += f" and explains {100 * agreement:.0f} % of the tracks better"
        if agreement < config.min_zoom_agreement:
            return replace(none, notes=(note,), warnings=(_ONLY_PART.format(100 * agreement),))
        if not rival.lens.is_pinhole:
            gain = work.gain(found, scene, rival)
            note += f"; all tracks together {100 * gain:.0f} % better than the lens does"
            if gain <= 0.0:
                return replace(none, notes=(note,))
    if not found.focal_sigma <= _FOCAL_OPEN:
        warnings += (_FOCAL_IS_OPEN,)
    focal = found.intrinsics[0] * np.exp(np.interp(np.arange(num_frames), work.frames, found.zoom))
    said = f"the camera zooms: fx from {focal.min():.1f} to {focal.max():.1f} px"
    return ZoomCalibration(
        focal / found.intrinsics[0], found.intrinsics, found.evidence, _spread(found), (said, note), warnings
    )


_PROBED = 0.4
"""Part of a zoom that the undamped steps of the probe find, at least."""

_LOUD = 0.05
"""Evidence from which the probe need not move the focal length: a camera that ended far from a zoom does not in two
steps, while errors of recordings ask for 1 to 2 %."""

_OPEN = 0.03
"""Standard deviation of the log focal length from which it counts as open."""

_FOCAL_OPEN = 0.08
"""Standard deviation of the log focal length of a camera that zooms from which little tells its zoom from motion."""
_FOCAL_IS_OPEN = "the camera zooms, and tracks hardly determine its focal length: the zoom and the path may be off too"

_ONLY_PART = (
    "part of the tracks asks for a focal length that changes, and others contradict it (it explains {:.0f} % of them "
    "better), so none was taken: something may move that no mask covers; give masks, or have them made from motion "
    "(--masks motion), or set camera.zoom=on if it zooms"
)


def _spread(fit: FittedZoom) -> float:
    return float("nan") if fit.sigma is None else float(fit.sigma.max())


def _warnings(fit: FittedZoom) -> tuple[str, ...]:
    """Return what is to be said where zoom and motion along the view cannot be told apart."""
    spread = _spread(fit)
    if spread <= _OPEN:
        return ()
    known = f"the focal length of a frame is open by {100 * spread:.0f} %" if np.isfinite(spread) else "it is open"
    return (f"zoom and motion along the view can hardly be told apart: {known}, and the path with it",)
