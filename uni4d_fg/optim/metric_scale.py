r"""What holds the scale of the world when measurements know lengths.

Without them the depth cue is all there is: every frame's log-scale has a prior about zero,

    sum_t (s_t / sigma)^2,

and the cue's mean over the frames is the world's meter. A cue may be wrong as a whole, though, by far more than frame
differs from frame. Where something else knows lengths the prior is therefore on the deviation from a common log-scale,

    sum_t ((s_t - s) / sigma)^2 + s^2,

so that T frames do not say T times over that the cue's meter is right. The distance that anchors a solve without
depth prior is loosened likewise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.priors import cue_scale_prior, log_scale_deviation, log_scale_prior, scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LOG_SCALE
from uni4d_fg.optim.problem import Problem

COMMON_SIGMA = 1.0
"""Standard deviation of the log-scale that all frames share: a cue is hardly wrong by more than a factor of e."""


def common_log_scale(problem: Problem, state: State) -> FloatArray | None:
    """Return where the common log-scale (1, 1) starts; None where a problem has no prior on free log-scales."""
    has_prior = any(batch.factor_type is log_scale_prior for batch in problem.batches)
    return state[LOG_SCALE].mean(axis=0, keepdims=True) if has_prior and problem.is_free(LOG_SCALE) else None


def release_scale(problem: Problem, *, common: bool) -> None:
    """Loosen what holds the scale of the world, see the module's docstring.

    Args:
        problem: Changed in place.
        common: Whether its state has the common log-scale.
    """
    batches: list[FactorBatch] = []
    for batch in problem.batches:
        if batch.factor_type is scale_anchor:
            batches.append(replace(batch, sigma=np.maximum(batch.sigma, COMMON_SIGMA)))
        elif common and batch.factor_type is log_scale_prior:
            rows = batch.slots[0].rows
            batches.append(log_scale_deviation(rows, 0, sigma=batch.sigma, weight=batch.weight, kernel=batch.kernel))
        else:
            batches.append(batch)
    if common:
        batches.append(cue_scale_prior(0, measured=np.zeros((1, 1)), sigma=COMMON_SIGMA))
    problem.batches = tuple(batches)
