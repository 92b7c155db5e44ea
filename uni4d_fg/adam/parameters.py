"""The free variables of a stage as torch parameters, and back.

A pose is a plain rotation vector and a camera centre, as in the reference program: neither is re-based while the
descent runs. Every other group is its own array.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.adam.rotations import rotation_matrix
from uni4d_fg.arrays import Array, BoolArray, FloatArray
from uni4d_fg.config.adam import AdamScheduleConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry import se3
from uni4d_fg.graph.state import State

ROTATION, CENTRE = "pose.rotation", "pose.centre"


@dataclass(frozen=True)
class Parameters:
    """Leaf tensors that move, with the fixed values of the entries that do not."""

    torch: Any
    state: State
    free: Mapping[str, BoolArray]
    """Free entries per parameter, of the parameter's shape."""
    values: dict[str, Array]
    """The leaf tensors: rotation vectors (T, 3), centres (T, 3), and the array of every other free group."""
    fixed: dict[str, tuple[Array, Array]]
    """For parameters with frozen entries: which are free, and the values of the rest."""

    @classmethod
    def create(cls, torch: Any, state: State, free: Mapping[str, BoolArray], dtype: Any, device: Any) -> Parameters:
        """Build the parameters of every group with a free entry.

        Args:
            torch: The module.
            state: Where the descent starts.
            free: Free entries per group, (n, tangent dim).
            dtype: torch dtype.
            device: torch device.

        Raises:
            SolverError: If a part of a pose's rotation or centre is free and another is not.
        """
        start: dict[str, FloatArray] = {}
        masks: dict[str, BoolArray] = {}
        for group, mask in free.items():
            if not mask.any():
                continue
            if group == "pose":
                start[ROTATION], start[CENTRE] = se3.so3_log(state["pose"][:, :3, :3]), state["pose"][:, :3, 3]
                masks[ROTATION], masks[CENTRE] = _as_a_whole(mask[:, :3]), _as_a_whole(mask[:, 3:])
            else:
                start[group], masks[group] = state[group], mask
        values, fixed = {}, {}
        for name, array in start.items():
            tensor = torch.tensor(array, dtype=dtype, device=device)
            values[name] = tensor.clone().requires_grad_(True)
            if not masks[name].all():
                fixed[name] = torch.tensor(masks[name], device=device), tensor
        return cls(torch, state, masks, values, fixed)

    @property
    def moving(self) -> set[str]:
        """Groups of the state that :meth:`groups` returns."""
        return {"pose" if name in (ROTATION, CENTRE) else name for name in self.values}

    def groups(self) -> dict[str, Array]:
        """Return the current value of every moving group: poses as (T, 4, 4), others as they are."""
        moved = {name: self._masked(name) for name in self.values}
        out = {name: value for name, value in moved.items() if name not in (ROTATION, CENTRE)}
        if ROTATION in moved:
            top = self.torch.cat((rotation_matrix(moved[ROTATION]), moved[CENTRE][:, :, None]), dim=2)
            bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(top), 1, 4)
            out["pose"] = self.torch.cat((top, bottom), dim=1)
        return out

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
        moved = {name: array for name, array in arrays.items() if name not in (ROTATION, CENTRE)}
        out = {name: np.where(self.free[name], array, self.state[name]) for name, array in moved.items()}
        if ROTATION in arrays:
            poses = self.state["pose"].copy()
            turned, shifted = self.free[ROTATION][:, 0], self.free[CENTRE][:, 0]
            poses[turned, :3, :3] = se3.so3_exp(arrays[ROTATION][turned])
            poses[shifted, :3, 3] = arrays[CENTRE][shifted]
            out["pose"] = poses
        return self.state.replace(**out)


def learning_rate(name: str, schedule: AdamScheduleConfig) -> float:
    """Return the first learning rate of a parameter."""
    if name in (ROTATION, CENTRE):
        return schedule.pose_learning_rate
    rates = {"intrinsics": schedule.intrinsics_learning_rate, "log_scale": schedule.log_scale_learning_rate}
    return rates.get(name, schedule.point_learning_rate)


def _as_a_whole(mask: BoolArray) -> BoolArray:
    """Return the (T, 3) mask of a pose's rotation or centre."""
    some = mask.any(axis=1)
    if (some != mask.all(axis=1)).any():
        raise SolverError("Adam moves a pose's rotation and its centre each as a whole: free or freeze all 3 entries")
    return mask
