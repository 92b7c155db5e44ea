"""The error of depth that comes from focal lengths that are held, and known to a standard deviation only.

Where a long lens looks at things that all lie at about the same distance, a longer focal length and depth that is drawn
out explain the tracks nearly as well: an error of 1 % of the focal length may be one of 12 % of depth.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry.camera import seen_from
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage, run_stage, until_converged
from uni4d_fg.slam.stages.observations import Observations

_MOST_OBSERVATIONS = 40_000
"""Of so many the bend is found: it is one of the whole scene, and solves take as long as there are observations."""


def focal_depth_error(
    declared: Callable[[State, Observations], tuple[Stage, State]],
    state: State,
    observations: Observations,
    focal_sigma: float,
    hooks: Hooks | None = None,
) -> float:
    """Return the mean relative change of depth, one scale apart, as focal lengths grow by a standard deviation.

    Of a large scene it is that of evenly spread tracks. Both ends are minima: far landmarks move by more while a solve
    converges in full than focal lengths move them.

    Args:
        declared: Makes bundle adjustment of some landmarks in which the intrinsics are held, and where it starts.
        state: Its minimum.
        observations: Of the state's landmarks.
        focal_sigma: Standard deviation of the log of the focal lengths.
        hooks: Cancellation; what it leaves is then measured.

    Raises:
        SolverError: If the system is singular.
    """
    if len(observations) > _MOST_OBSERVATIONS:
        observations, rows = observations.parted(_MOST_OBSERVATIONS)[::2]
        tracks = state.numbers(LANDMARK)[rows, 0]
        state = State({**state.arrays, LANDMARK: state[LANDMARK][rows]}, {**state.index, LANDMARK: tracks})
    stage, state = declared(state, observations)
    quiet = None if hooks is None else Hooks(should_stop=hooks.should_stop)
    minimum, _ = run_stage(until_converged(stage), state, quiet)
    longer = minimum[INTRINSICS] * np.array([np.exp(focal_sigma)] * 2 + [1.0, 1.0])
    bent, _ = run_stage(until_converged(stage), minimum.replace({INTRINSICS: longer}), quiet)
    change = _log_depth(bent, observations) - _log_depth(minimum, observations)
    change = change[np.isfinite(change)]
    return float(np.mean(np.abs(change - np.median(change)))) if len(change) else 0.0


def _log_depth(state: State, observations: Observations) -> FloatArray:
    """Return log depth (N,) of what is observed, NaN behind the camera."""
    _, row = observations.rows()
    z = seen_from(state[POSE], observations.frame, state[LANDMARK][row])[:, 2]
    result: FloatArray = np.log(np.where(z > 0, z, np.nan))
    return result
