"""Learning rates, early stopping and the iteration limit, on losses written down in advance."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from uni4d_fg.config.adam import AdamConfig, AdamScheduleConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.optim.adam.descent import EarlyStopping, Trace, descend
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.summary import Termination


def follow(losses: Sequence[float], schedule: AdamScheduleConfig, hooks: Hooks | None = None) -> Trace:
    """Descend on a loss whose values are given and whose gradient is one."""
    parameters = {name: torch.zeros(1, requires_grad=True) for name in ("pose.center", "landmark", "intrinsics")}
    values = iter(losses)

    def loss() -> torch.Tensor:
        total = sum(p.sum() for p in parameters.values())
        return total - total.detach() + next(values)

    return descend(torch, parameters, loss, schedule, hooks=hooks)


def plateau_rate(losses: Sequence[float], first: float, schedule: AdamScheduleConfig) -> float:
    """The learning rate after the losses, by the rule: more than ``patience`` iterations in a row without progress."""
    best, waited, rate = math.inf, 0, first
    for loss in losses:
        if loss < best * (1.0 - schedule.plateau_threshold):
            best, waited = loss, 0
        else:
            waited += 1
        if waited > schedule.plateau_patience:
            rate, waited = min(rate, max(rate * schedule.plateau_factor, schedule.min_learning_rate)), 0
    return rate


@pytest.mark.parametrize("length", [1, 11, 12, 13, 40, 90])
def test_learning_rates_are_lowered_at_plateaus_and_have_a_floor(length: int) -> None:
    rng = np.random.default_rng(length)
    losses = (1.0 + 0.001 * rng.normal(size=length)).tolist()
    schedule = AdamScheduleConfig(
        max_iterations=length,
        plateau_patience=10,
        stop_patience=1000,
        pose_learning_rate=1e-3,
        min_learning_rate=2e-4,
        intrinsics_learning_rate=1e-5,
    )
    trace = follow(losses, schedule)
    assert trace.losses == pytest.approx(losses, rel=1e-6)
    expected = {
        "pose.center": plateau_rate(losses, 1e-3, schedule),
        "landmark": plateau_rate(losses, 1e-2, schedule),
        "intrinsics": 1e-5,
    }
    assert trace.learning_rates == pytest.approx(expected)


def test_the_iteration_limit_ends_a_falling_loss() -> None:
    trace = follow([10.0 - i for i in range(9)], AdamScheduleConfig(max_iterations=7))
    assert trace.termination is Termination.MAX_ITERATIONS
    assert len(trace.losses) == len(trace.seconds) == 7
    assert (np.diff(trace.seconds) >= 0).all()


def test_a_fall_that_is_too_small_stops_after_the_patience() -> None:
    schedule = AdamScheduleConfig(stop_patience=5, stop_decrease=1e-2)
    trace = follow([3.0, 2.0, 1.999, 1.998, 1.997, 1.996, 1.995, 0.0], schedule)
    assert trace.termination is Termination.EARLY_STOPPED
    assert len(trace.losses) == 7


def test_many_small_falls_add_up_to_progress() -> None:
    stopping = EarlyStopping(patience=3, decrease=0.25)
    assert not any(stopping.stops_at(5.0 - 0.125 * i) for i in range(40))


def test_the_schedules_are_those_of_the_reference() -> None:
    config = AdamConfig()
    numbers = [
        (s.max_iterations, s.pose_learning_rate, s.plateau_patience, s.stop_patience, s.stop_decrease)
        for s in (config.camera_init, config.bundle_adjustment, config.nonrigid)
    ]
    assert numbers == [(600, 1e-3, 10, 20, 1e-4), (2000, 1e-2, 20, 100, 1e-4), (1000, 1e-2, 10, 100, 1e-4)]
    assert (config.amsgrad, config.precision, config.keep_best) == (True, "float32", False)


def test_a_loss_that_is_not_finite_is_an_error() -> None:
    with pytest.raises(SolverError, match="iteration 2"):
        follow([1.0, math.nan], AdamScheduleConfig())


def test_hooks_stop_the_descent_and_see_its_progress() -> None:
    seen: list[int] = []
    left = iter([False] * 45 + [True])
    hooks = Hooks(on_iteration=lambda name, i, loss: seen.append(i), should_stop=lambda: next(left))
    trace = follow([100.0 - i for i in range(99)], AdamScheduleConfig(), hooks)
    assert trace.termination is Termination.CANCELLED
    assert (len(trace.losses), seen) == (45, [20, 40])
