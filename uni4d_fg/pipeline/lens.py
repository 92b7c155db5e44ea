"""The camera model of a run: given, found, or the pinhole; stages then work on ideal pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled, ConfigError, DegenerateProblemError, SolverError
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.steps import STOPPED
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.slam.lens.calibration import LensCalibration
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.rolling_shutter import Readout, readout_to_array
from uni4d_fg.slam.lens.shutter_calibration import calibrate_with_shutter


def as_pinhole(
    camera: CameraModel, sequence: Sequence, labelled: LabelledTracks, config: Config
) -> tuple[Sequence, LabelledTracks, Config]:
    """Return what the stages solve: the sequence and tracks of a pinhole that does not zoom.

    Intrinsics are held where lens and zoom are theirs; those of a zoom are of its longest focal length. Else the
    lens goes along with them: see :func:`goes_along`.
    """
    if camera.is_plain:
        return sequence, labelled, config
    pinhole = replace(sequence, intrinsics=camera.intrinsics, focal_sigma=camera.focal_sigma, lens=PINHOLE, zoom=None)
    if not goes_along(camera, sequence):
        held = config.input.model_copy(update={"intrinsics": "fixed"})
        config = config.model_copy(update={"input": held})
    return pinhole, camera.ideal_labelled(labelled), config


def goes_along(camera: CameraModel, sequence: Sequence) -> bool:
    """Tell whether the stages may move focal lengths on, and radial distortion with them: that of a lens not given.

    :meth:`CameraModel.with_intrinsics` says how it moves.
    """
    found = camera.lens.model in ("SIMPLE_RADIAL", "RADIAL") and camera.lens != sequence.lens
    return found and camera.zoom is None and camera.focal_sigma is None


def is_sought(sequence: Video | Sequence, config: Config) -> bool:
    """Return whether the lens, or a zoom, is estimated.

    That needs the likelihood of energy 'map', Levenberg-Marquardt, and poses and intrinsics that may move. A lens or a
    zoom that came with the sequence is taken as it is, unless a model is asked for, and so is a camera that was found
    from motion.
    """
    model, zooms = config.camera.model, config.camera.zoom == "on"
    # Structure from motion has looked for both with the tracks that its depth is made of.
    known = not sequence.lens.is_pinhole or sequence.zoom is not None or sequence.focal_sigma is not None
    if (model == "pinhole" and not zooms) or (model == "auto" and known):
        return False
    return _rules_it_out(config) is None


def is_readout_sought(config: Config) -> bool:
    """Return whether the time in which rows are read is estimated; intrinsics may be given."""
    return config.camera.rolling_shutter == "auto" and _rules_out_fits(config) is None


def _rules_it_out(config: Config) -> tuple[str, str] | None:
    """Return the setting with which no lens can be estimated, and the one that it needs; None if nothing does."""
    has = config.input.intrinsics
    return ("input.intrinsics=fixed", "input.intrinsics=free") if has == "fixed" else _rules_out_fits(config)


def _rules_out_fits(config: Config) -> tuple[str, str] | None:
    """Return the setting with which neither lens nor readout can be estimated, and the one that they need."""
    needs = {
        "input.poses": (config.input.poses, "estimate"),
        "energy": (config.energy, "map"),
        "solver": (config.solver, "lm"),
        "bundle_adjustment.depth_prior": (str(config.bundle_adjustment.depth_prior).lower(), "true"),
    }
    found = ((f"{name}={has}", f"{name}={wanted}") for name, (has, wanted) in needs.items() if has != wanted)
    return next(found, None)


def known_camera(sequence: Sequence, config: Config) -> CameraModel:
    """Return the camera of a sequence whose lens is not estimated. Raises ConfigError as :func:`check_camera`."""
    check_camera(sequence, config)
    lens = PINHOLE if config.camera.model == "pinhole" else sequence.lens
    return CameraModel(sequence.intrinsics, lens, sequence.zoom, sequence.focal_sigma)


def check_camera(sequence: Video | Sequence, config: Config) -> None:
    """Check that what is asked for of a camera whose lens is not estimated is known.

    Raises:
        ConfigError: If a model is asked for whose parameters are neither given nor to be estimated, or a zoom.
    """
    ruled_out = _rules_it_out(config)
    if ruled_out is not None:
        has, wanted = ruled_out
        check_parameters(sequence, config, f"with {has}", f"set {wanted}")
        if config.camera.zoom == "on":
            raise ConfigError(f"camera.zoom=on: with {has} no zoom is estimated; set {wanted}, or camera.zoom=auto")


def check_parameters(sequence: Video | Sequence, config: Config, where: str, remedy: str) -> None:
    """Check that the parameters of a model that is asked for are known where the lens is not estimated.

    Raises:
        ConfigError: If they are not; says where that is, and the remedy.
    """
    model = config.camera.model
    if model not in ("auto", "pinhole") and sequence.lens.is_pinhole:
        raise ConfigError(
            f"camera.model: the parameters of {model} came with no calibration, and {where} they are not estimated; "
            f"give a calibration that has them (--intrinsics), {remedy}, or leave camera.model=auto"
        )


def lens_step(
    sequence: Sequence, labelled: LabelledTracks, readout: Readout | None, config: Config, hooks: Hooks,
    run: StageRunner,
) -> StageRecord:  # fmt: skip
    """Find the lens, and the readout with it; where 'auto' cannot, the pinhole is kept and the summary says why.

    Raises:
        DegenerateProblemError: If a model was asked for and the cues do not determine the cameras.
        SolverError: If a model was asked for and a system is singular.
        Cancelled: If the user interrupts.
    """
    try:
        found = calibrate_with_shutter(
            labelled, sequence.timestamps, sequence.image_size, sequence.intrinsics, config, readout, sequence.lens,
            hooks, run,
        )  # fmt: skip
    except (DegenerateProblemError, SolverError) as error:
        if config.camera.model != "auto" or config.camera.zoom == "on":
            raise
        note = f"no distortion was sought: {error}"
        found = LensCalibration(PINHOLE, sequence.intrinsics, note=note, readout=readout)
    except Cancelled as error:
        raise Cancelled(STOPPED) from error
    zoom, camera = found.zoom, found.camera
    summary: dict[str, Any] = {
        "solves": [solve_dict(solve) for solve in found.solves],
        "facts": found.facts(),
        "camera_model": found.lens.model,
        "warnings": [] if zoom is None else list(zoom.warnings),
        "candidates": [
            {
                "camera_model": c.lens.model,
                "parameters": list(c.lens.parameters),
                "intrinsics": c.intrinsics.tolist(),
                "evidence": c.evidence,
                "held_out_gain": c.held_out_gain,
                "displacement_px": c.displacement_px,
            }
            for c in found.candidates
        ],
    }
    if zoom is not None:
        summary["zoom"] = {
            "evidence": zoom.evidence,
            "focal_sigma": zoom.open_by if np.isfinite(zoom.open_by) else None,
            "focal_px": None if zoom.zoom is None else (zoom.intrinsics[0] * zoom.zoom).tolist(),
        }
    sigma = np.nan if camera.focal_sigma is None else camera.focal_sigma
    arrays = {
        "camera": camera.to_array(), "intrinsics": camera.intrinsics, "focal_sigma": np.array(sigma),
        "readout": readout_to_array(found.readout),
    }  # fmt: skip
    return StageRecord(arrays, summary)


def found_camera(record: Mapping[str, npt.NDArray[Any]]) -> CameraModel:
    """Return the camera of a record of :func:`lens_step`, or of structure from motion."""
    camera = CameraModel.of_array(record["camera"], record["intrinsics"])
    sigma = float(record.get("focal_sigma", np.nan))
    return camera if np.isnan(sigma) else replace(camera, focal_sigma=sigma)
