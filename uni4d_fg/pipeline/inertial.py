"""Inertial measurements in a run: what goes with them, and what the summary says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uni4d_fg.config.models import Config
from uni4d_fg.cues.scale_notes import NOT_METRIC, NOT_METRIC_GIVEN, NOT_METRIC_RELATIVE
from uni4d_fg.errors import ConfigError
from uni4d_fg.factors.variable_types import CUE_SCALE, GRAVITY, IMU_BIAS
from uni4d_fg.optim.added_factors import AddingRunner
from uni4d_fg.slam.measurements.imu_start import InertialStart


def check_goes_with_imu(config: Config, num_windows: int) -> None:
    """Refuse configurations that inertial measurements cannot take part in.

    Raises:
        ConfigError: With solver 'adam', energy 'paper', fixed poses, or windows.
    """
    reasons = {
        "solver: adam (GTSAM's factors are not differentiated by PyTorch)": config.solver == "adam",
        "energy: paper (its terms are not likelihoods to be weighed against a sensor's)": config.energy == "paper",
        "input.poses: fixed (nothing is left to estimate)": config.input.poses == "fixed",
        "windows (solve the video as one graph)": num_windows > 0,
    }
    for reason, applies in reasons.items():
        if applies:
            raise ConfigError(f"inertial measurements do not go with {reason}; leave one of the two out")


def metric_cues(cues: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is said of the cues of a video whose scale an IMU finds."""
    said = (NOT_METRIC, NOT_METRIC_GIVEN, NOT_METRIC_RELATIVE)
    warnings = [text for text in cues.get("warnings", []) if text not in said]
    return {**cues, "warnings": warnings, "metric": True}


def imu_summary(start: InertialStart, runner: AddingRunner) -> dict[str, Any]:
    """Return what ``summary.json`` says of the IMU, from the alignment and the variables that were added."""
    aligned = start.alignment
    known = {variable: np.array(list(values.values())) for variable, values in runner.known.values.items()}
    gravity, bias = known.get(GRAVITY, aligned.gravity[None])[0], known.get(IMU_BIAS, aligned.bias[None])
    scale = known.get(CUE_SCALE)
    return {
        "aligned_scale": aligned.scale,
        "aligned_scale_sigma": aligned.scale_sigma,
        "cue_scale": None if scale is None else float(np.exp(scale[0, 0])),
        "gravity": gravity.tolist(),
        "accelerometer_bias": bias[0, :3].tolist(),
        "gyroscope_bias": bias[0, 3:].tolist(),
        "parts": int(start.part.max()) + 1,
        "frames_by_imu_alone": np.flatnonzero(start.part < 0).tolist(),
    }


def imu_fact(summary: dict[str, Any]) -> str:
    """Return one line on the IMU."""
    alone, parts = len(summary["frames_by_imu_alone"]), summary["parts"]
    joined = f", {alone} frame(s) posed by it alone" if alone else ""
    joined += f", {parts} parts of the video joined by it" if parts > 1 else ""
    cue = "" if summary["cue_scale"] is None else f"the depth cue times {summary['cue_scale']:.3f} is metric, "
    g = summary["gravity"]
    return f"IMU: {cue}gravity ({g[0]:.2f}, {g[1]:.2f}, {g[2]:.2f}) m/s^2 in the first camera's axes{joined}"
