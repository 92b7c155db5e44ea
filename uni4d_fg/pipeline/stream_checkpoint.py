"""The whole state of an incremental solve as plain arrays, so that it can go on in another process.

Everything is stored in full precision: a solve that goes on from a checkpoint gives, number by number, what it
would have given without the interruption. The Bayes tree of ``incremental.smoother: isam2`` is not stored: it grows
anew from the stored keyframes, and the numbers agree within the solver's tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.errors import InputError
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.marginalization_prior import marginalization_prior_type
from uni4d_fg.factors.variable import variable_type
from uni4d_fg.frontend.tracks.first_views import FirstViews
from uni4d_fg.optim.cluster_robust import Spread
from uni4d_fg.slam.incremental.model import DynamicPoints, FinishedFrame, FrameStatus, Landmarks
from uni4d_fg.slam.incremental.reconstructor import IncrementalReconstructor, PendingFrame
from uni4d_fg.slam.incremental.window import KeyedPrior, no_observations
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise

Arrays = dict[str, npt.NDArray[Any]]

_WINDOW = (
    "frame", "bridged", "start", "pose", "log_scale", "covariance", "log_scale_sigma", "intrinsics",
    "intrinsics_covariance", "landmark_track", "landmark",
)  # fmt: skip
_OBSERVATIONS = ("track", "frame", "uv", "depth", "weight")
_BOOK = ("track", "first_frame", "last_frame", "label", "votes", "disagreeing", "color")
_TRACKER = ("track", "points", "velocity")
_FIRST_VIEWS = "first_views_"
_DYNAMIC_POINTS = ("track", "instance", "point", "observed", "color")
_LANDMARKS = ("track", "point", "error", "count", "color", "keyframe")


def state_arrays(solver: IncrementalReconstructor) -> Arrays:
    """Return the state of a solve, without its results."""
    window, dynamic, tracker = solver.window, solver.dynamic, solver.tracker
    out: Arrays = {f"window_{name}": getattr(window, name) for name in _WINDOW}
    out |= {f"window_observed_{name}": getattr(window.observations, name) for name in _OBSERVATIONS}
    out["window_noise"] = window.noise.array()
    out["window_counters"] = np.array([window.slides, int(window.intrinsics_free)])
    out["window_error_px"] = np.array(window.error_px)
    out["window_prior_intrinsics"] = window.prior_intrinsics
    if window.prior is not None:
        prior = window.prior.batch
        out |= {f"prior_{name}": array for name, array in prior.data.items()}
        out["prior_variables"] = np.array([slot.variable.name for slot in prior.slots])
        if window.spread is not None:
            out["prior_scores"], out["prior_rest"] = window.spread.scores, window.spread.rest
        # The second number of types that have one only is a filler.
        out["prior_numbers"] = np.array([(*n, 0)[:2] for n in window.prior.numbers], dtype=np.int64)
    for variable, values in window.added.values.items():
        if values:
            out[f"added_{variable.name}_numbers"] = np.array(list(values), dtype=np.int64)
            out[f"added_{variable.name}"] = np.stack(list(values.values()))
    out |= {f"dynamic_{name}": getattr(dynamic, name) for name in ("frame", "pose", "instance")}
    out |= {f"dynamic_observed_{name}": getattr(dynamic.observations, name) for name in _OBSERVATIONS}
    out["dynamic_depth_sigma"] = np.array(dynamic.depth_sigma)
    out |= {f"book_{name}": getattr(solver.book, name) for name in _BOOK}
    out |= {f"tracker_{name}": getattr(tracker.followed, name) for name in _TRACKER}
    if tracker.followed.views is not None:
        out |= {f"{_FIRST_VIEWS}{name}": array for name, array in tracker.followed.views.to_arrays().items()}
    out["tracker_counters"] = np.array([tracker.next_track, tracker.since_query])
    if tracker.previous is not None:
        out["tracker_previous"] = tracker.previous
    pending = solver.pending
    out |= _posed_arrays("pending", pending)
    out["pending_keyframe"] = np.array([p.keyframe for p in pending], dtype=np.int64)
    out["pending_keyframe_T_cam"] = np.array([p.keyframe_T_cam for p in pending]).reshape(-1, 4, 4)
    out["pending_covariance"] = np.array([p.covariance for p in pending]).reshape(-1, 6, 6)
    for name in _OBSERVATIONS:
        rows = [getattr(p.seen, name) for p in pending]
        out[f"pending_observed_{name}"] = np.concatenate([getattr(no_observations(), name), *rows])
    out |= _points_arrays("pending", [p.dynamic for p in pending])
    out["num_frames"] = np.array(solver.num_frames)
    out["last_timestamp"], out["last_pose"] = np.array(solver.last_timestamp), solver.last_pose
    return out


def restore(solver: IncrementalReconstructor, arrays: Arrays) -> None:
    """Bring a new solver, made with the same arguments, to a stored state.

    Raises:
        InputError: If an array is missing or malformed.
    """
    try:
        _restore(solver, arrays)
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"the stored state is damaged ({error!r}); start again with --overwrite") from error


def _restore(solver: IncrementalReconstructor, arrays: Arrays) -> None:
    window, dynamic, tracker = solver.window, solver.dynamic, solver.tracker
    for name in _WINDOW:
        setattr(window, name, arrays[f"window_{name}"])
    window.observations = Observations(*(arrays[f"window_observed_{name}"] for name in _OBSERVATIONS))
    window.noise = StaticNoise.of_array(arrays["window_noise"])
    slides, free = arrays["window_counters"].tolist()
    window.slides, window.intrinsics_free = int(slides), bool(free)
    window.error_px, window.prior_intrinsics = float(arrays["window_error_px"]), arrays["window_prior_intrinsics"]
    if "prior_variables" in arrays:
        variables = tuple(variable_type(str(name)) for name in arrays["prior_variables"].tolist())
        prior_type = marginalization_prior_type(variables)
        slots = tuple(Slot(variable, np.zeros(1, dtype=np.int64)) for variable in variables)
        numbers = zip(variables, arrays["prior_numbers"].tolist(), strict=True)
        data = {name: arrays[f"prior_{name}"] for name in prior_type.data}
        batch = FactorBatch.create(prior_type, slots, data)
        window.prior = KeyedPrior(batch, tuple(tuple(row[: len(variable.index)]) for variable, row in numbers))
        if "prior_scores" in arrays:
            window.spread = Spread(arrays["prior_scores"], arrays["prior_rest"])
    for name in arrays:
        if name.startswith("added_") and name.endswith("_numbers"):
            variable = variable_type(name.removeprefix("added_").removesuffix("_numbers"))
            rows = map(tuple, arrays[name].tolist())
            window.added.values[variable] = dict(zip(rows, arrays[f"added_{variable.name}"], strict=True))
    for name in ("frame", "pose", "instance"):
        setattr(dynamic, name, arrays[f"dynamic_{name}"])
    dynamic.observations = Observations(*(arrays[f"dynamic_observed_{name}"] for name in _OBSERVATIONS))
    dynamic.depth_sigma = float(arrays["dynamic_depth_sigma"])
    for name in _BOOK:
        setattr(solver.book, name, arrays[f"book_{name}"])
    for name in _TRACKER:
        setattr(tracker.followed, name, arrays[f"tracker_{name}"])
    # As the stream began, whether or not the C++ extension is here too.
    views = {n.removeprefix(_FIRST_VIEWS): array for n, array in arrays.items() if n.startswith(_FIRST_VIEWS)}
    tracker.followed.views = FirstViews.of_arrays(tracker.config, views) if views else None
    tracker.next_track, tracker.since_query = (int(n) for n in arrays["tracker_counters"].tolist())
    tracker.previous = arrays.get("tracker_previous")
    points = _points_list("pending", arrays)
    seen = Observations(*(arrays[f"pending_observed_{name}"] for name in _OBSERVATIONS))
    solver.pending = [
        PendingFrame(
            int(arrays["pending_frame"][i]), float(arrays["pending_timestamp"][i]),
            FrameStatus(str(arrays["pending_status"][i])), int(arrays["pending_keyframe"][i]),
            arrays["pending_keyframe_T_cam"][i], arrays["pending_covariance"][i],
            float(arrays["pending_log_scale"][i]), points[i],
            seen.select(seen.frame == int(arrays["pending_frame"][i])),
        )
        for i in range(len(arrays["pending_frame"]))
    ]  # fmt: skip
    solver.num_frames, solver.last_timestamp = int(arrays["num_frames"]), float(arrays["last_timestamp"])
    solver.last_pose = arrays["last_pose"]


def seconds_arrays(seconds: Mapping[str, float]) -> Arrays:
    """Return the seconds that went into a stream, by part, as arrays."""
    return {"seconds_part": np.array(list(seconds), dtype=np.str_), "seconds": np.array(list(seconds.values()), float)}


def take_seconds(arrays: Arrays) -> dict[str, float]:
    """Take what :func:`seconds_arrays` was given out of a checkpoint; nothing where it was not written.

    Raises:
        InputError: If an array is malformed.
    """
    names, values = arrays.pop("seconds_part", np.zeros(0)), arrays.pop("seconds", np.zeros(0))
    try:
        return {str(name): float(value) for name, value in zip(names.tolist(), values.tolist(), strict=True)}
    except (TypeError, ValueError) as error:
        raise InputError(f"the stored state is damaged ({error!r}); start again with --overwrite") from error


def result_arrays(frames: list[FinishedFrame], landmarks: list[Landmarks]) -> Arrays:
    """Return finished frames and landmarks as arrays."""
    out = _posed_arrays("frames", frames)
    out["frames_world_T_cam"] = np.array([f.world_T_cam for f in frames]).reshape(-1, 4, 4)
    out["frames_covariance"] = np.array([f.covariance for f in frames]).reshape(-1, 6, 6)
    out |= _points_arrays("frames", [f.dynamic for f in frames])
    empty = Landmarks(
        np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3), np.uint8),
        np.zeros(0, np.int64),
    )  # fmt: skip
    for name in _LANDMARKS:
        out[f"landmarks_{name}"] = np.concatenate([getattr(part, name) for part in (empty, *landmarks)])
    return out


def results_of(arrays: Arrays) -> tuple[list[FinishedFrame], Landmarks]:
    """Return what :func:`result_arrays` was given."""
    points = _points_list("frames", arrays)
    frames = [
        FinishedFrame(
            int(arrays["frames_frame"][i]), float(arrays["frames_timestamp"][i]),
            FrameStatus(str(arrays["frames_status"][i])), arrays["frames_world_T_cam"][i],
            arrays["frames_covariance"][i], float(arrays["frames_log_scale"][i]), points[i],
        )
        for i in range(len(arrays["frames_frame"]))
    ]  # fmt: skip
    return frames, Landmarks(*(arrays[f"landmarks_{name}"] for name in _LANDMARKS))


def _posed_arrays(prefix: str, items: list[Any]) -> Arrays:
    return {
        f"{prefix}_frame": np.array([item.frame for item in items], dtype=np.int64),
        f"{prefix}_timestamp": np.array([item.timestamp for item in items], dtype=np.float64),
        f"{prefix}_status": np.array([item.status.value for item in items], dtype=np.str_),
        f"{prefix}_log_scale": np.array([item.log_scale for item in items], dtype=np.float64),
    }


def _points_arrays(prefix: str, points: list[DynamicPoints]) -> Arrays:
    parts = [DynamicPoints.none(), *points]
    out: Arrays = {
        f"{prefix}_dynamic_{name}": np.concatenate([getattr(part, name) for part in parts]) for name in _DYNAMIC_POINTS
    }
    out[f"{prefix}_dynamic_count"] = np.array([len(part.track) for part in points], dtype=np.int64)
    return out


def _points_list(prefix: str, arrays: Arrays) -> list[DynamicPoints]:
    end = np.cumsum(arrays[f"{prefix}_dynamic_count"])
    start = end - arrays[f"{prefix}_dynamic_count"]
    parts = [arrays[f"{prefix}_dynamic_{name}"] for name in _DYNAMIC_POINTS]
    return [DynamicPoints(*(part[a:b] for part in parts)) for a, b in zip(start, end, strict=True)]
