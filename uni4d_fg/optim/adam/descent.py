"""The loop: Adam, learning rates lowered at plateaus, and stopping when nothing improves."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from uni4d_fg.arrays import Array
from uni4d_fg.config.adam import AdamScheduleConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.optim.adam.parameters import learning_rate
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.summary import Termination

REPORT_INTERVAL = 20
"""Iterations between two progress reports."""


@dataclass
class EarlyStopping:
    """Stop when the loss has not fallen below its best by ``decrease`` for ``patience`` iterations."""

    patience: int
    decrease: float
    best: float = math.inf
    waited: int = 0

    def stops_at(self, loss: float) -> bool:
        """Take note of one loss; return whether to stop."""
        if loss <= self.best - self.decrease:
            self.best, self.waited = loss, 0
        else:
            self.waited += 1
        return self.waited >= self.patience


@dataclass
class Trace:
    """What happened: per iteration the loss before its step, and the seconds since the start after it."""

    termination: Termination = Termination.MAX_ITERATIONS
    losses: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    learning_rates: dict[str, float] = field(default_factory=dict)
    """Per parameter, at the end."""
    best: dict[str, Array] | None = None
    """Copies of the parameters at the lowest loss, if asked for."""


def descend(
    torch: Any,
    parameters: Mapping[str, Array],
    loss_of: Callable[[], Array],
    schedule: AdamScheduleConfig,
    *,
    amsgrad: bool = True,
    keep_best: bool = False,
    name: str = "descent",
    hooks: Hooks | None = None,
) -> Trace:
    """Minimize a loss in place with a new optimizer.

    Args:
        torch: The module.
        parameters: Leaf tensors by name; the name decides the learning rate.
        loss_of: Evaluates the loss at the parameters' current values.
        schedule: Step sizes and stopping.
        amsgrad: Variant of Adam.
        keep_best: Copy the parameters whenever the loss is the lowest so far.
        name: Name in messages and progress reports.
        hooks: Progress and cancellation.

    Raises:
        SolverError: If the loss is not finite.
    """
    hooks = hooks or Hooks()
    leaves = dict(parameters)
    optimizer = torch.optim.Adam(
        [{"params": [leaf], "lr": learning_rate(key, schedule)} for key, leaf in leaves.items()], amsgrad=amsgrad
    )
    plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimizer,
        factor=schedule.plateau_factor,
        patience=schedule.plateau_patience,
        threshold=schedule.plateau_threshold,
        min_lr=schedule.min_learning_rate,
    )
    stopping = EarlyStopping(schedule.stop_patience, schedule.stop_decrease)
    trace, lowest, began = Trace(), math.inf, time.perf_counter()
    while len(trace.losses) < schedule.max_iterations:
        if hooks.should_stop is not None and hooks.should_stop():
            trace.termination = Termination.CANCELLED
            break
        optimizer.zero_grad(set_to_none=True)
        loss = loss_of()
        loss.backward()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise SolverError(f"{name}: the loss is {value} in iteration {len(trace.losses) + 1}; lower learning rates")
        if keep_best and value < lowest:
            lowest, trace.best = value, {key: leaf.detach().clone() for key, leaf in leaves.items()}
        optimizer.step()
        plateau.step(value)
        trace.losses.append(value)
        trace.seconds.append(time.perf_counter() - began)
        if hooks.on_iteration is not None and len(trace.losses) % REPORT_INTERVAL == 0:
            hooks.on_iteration(name, len(trace.losses), value)
        if stopping.stops_at(value):
            trace.termination = Termination.EARLY_STOPPED
            break
    trace.learning_rates = {key: group["lr"] for key, group in zip(leaves, optimizer.param_groups, strict=True)}
    if keep_best and float(loss_of().detach()) < lowest:
        trace.best = None
    return trace
