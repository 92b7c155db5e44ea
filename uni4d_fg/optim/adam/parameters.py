"""The free variables of a stage as torch parameters, and back.

Which plain arrays stand for a variable, its manifold says: a pose is a rotation vector and a camera center, as in the
reference program, and neither is re-based while the descent runs; a vector is its own array.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import Array, BoolArray, FloatArray
from uni4d_fg.config.adam import AdamScheduleConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import SE3, VariableType
from uni4d_fg.factors.variable_types import INTRINSICS, LOG_SCALE


@dataclass(frozen=True)
class Parameters:
    """Leaf tensors that move, with the fixed values of the entries that do not."""

    torch: Any
    state: State
    free: Mapping[str, BoolArray]
    """Free entries per parameter, of the parameter's shape."""
    values: dict[str, Array]
    """The leaf tensors by name: the variable type's, and what of it ("pose.rotation")."""
    fixed: dict[str, tuple[Array, Array]]
    """For parameters with frozen entries: which are free, and the values of the rest."""
    variables: tuple[VariableType, ...]
    """Types that move."""

    @classmethod
    def create(
        cls, torch: Any, state: State, free: Mapping[VariableType, BoolArray], dtype: Any, device: Any
    ) -> Parameters:
        """Build the parameters of every variable type with a free entry.

        Args:
            torch: The module.
            state: Where the descent starts.
            free: Free entries per variable type, (n, tangent dim).
            dtype: torch dtype.
            device: torch device.

        Raises:
            SolverError: If a part of a pose's rotation or center is free and another is not.
        """
        start: dict[str, FloatArray] = {}
        masks: dict[str, BoolArray] = {}
        moving = tuple(variable for variable, mask in free.items() if mask.any())
        for variable in moving:
            manifold = variable.manifold
            for suffix, array in manifold.to_parameters(state[variable]).items():
                mask = free[variable][:, manifold.parameter_columns[suffix]]
                # A rotation vector is no tangent: part of it cannot be frozen.
                masks[variable.name + suffix] = mask if len(manifold.parameter_columns) == 1 else _as_a_whole(mask)
                start[variable.name + suffix] = array
        values, fixed = {}, {}
        for name, array in start.items():
            tensor = torch.tensor(array, dtype=dtype, device=device)
            values[name] = tensor.clone().requires_grad_(True)
            if not masks[name].all():
                fixed[name] = torch.tensor(masks[name], device=device), tensor
        return cls(torch, state, masks, values, fixed, moving)

    @property
    def moving(self) -> set[VariableType]:
        """Variable types that :meth:`current` returns."""
        return set(self.variables)

    def current(self) -> dict[VariableType, Array]:
        """Return the current value of every moving variable type, differentiable."""
        return {
            variable: variable.manifold.from_parameters(
                {suffix: self._masked(variable.name + suffix) for suffix in variable.manifold.parameter_columns}
            )
            for variable in self.variables
        }

    def _masked(self, name: str) -> Array:
        if name not in self.fixed:
            return self.values[name]
        free, rest = self.fixed[name]
        return self.torch.where(free, self.values[name], rest)

    def to_state(self, values: Mapping[str, Array] | None = None) -> State:
        """Return the state of the given (default: current) leaf values; frozen entries are those of the start."""
        arrays = {
            name: np.asarray(value.detach().cpu().numpy(), dtype=np.float64)
            for name, value in (values or self.values).items()
        }
        out = {}
        for variable in self.variables:
            manifold, old = variable.manifold, self.state[variable]
            start = manifold.to_parameters(old)
            kept = {
                suffix: np.where(self.free[variable.name + suffix], arrays[variable.name + suffix], start[suffix])
                for suffix in start
            }
            moved = np.asarray(manifold.from_parameters(kept))
            if manifold is SE3:  # a rotation that did not move keeps its bits
                still = ~self.free[variable.name + ".rotation"][:, 0]
                moved[still, :3, :3] = old[still, :3, :3]
            out[variable] = moved
        return self.state.replace(out)


def learning_rate(name: str, schedule: AdamScheduleConfig) -> float:
    """Return the first learning rate of a parameter."""
    if name.endswith((".rotation", ".center")):
        return schedule.pose_learning_rate
    rates = {
        INTRINSICS.name: schedule.intrinsics_learning_rate,
        LOG_SCALE.name: schedule.log_scale_learning_rate,
    }
    return rates.get(name, schedule.point_learning_rate)


def _as_a_whole(mask: BoolArray) -> BoolArray:
    """Return the (T, 3) mask of a pose's rotation or center."""
    some = mask.any(axis=1)
    if (some != mask.all(axis=1)).any():
        raise SolverError("Adam moves a pose's rotation and its center each as a whole: free or freeze all 3 entries")
    return mask
