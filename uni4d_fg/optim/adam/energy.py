r"""The energy of factor batches in torch, from the residual functions that every solver shares.

    E = sum over terms of  sum_n weight_n e(|r_n / sigma_n|)

e is the batch's kernel rho, except that a 'norm' kernel stands for the plain Euclidean norm: its smoothing is
for solvers that need a second derivative, and descent does not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from uni4d_fg.arrays import Array
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType


class TorchBatch:
    """One factor batch with its data, rows and frozen variables as tensors."""

    def __init__(
        self, torch: Any, batch: FactorBatch, state: State, moving: set[VariableType], dtype: Any, device: Any
    ):
        def tensor(array: Any) -> Array:
            return torch.tensor(np.asarray(array), dtype=dtype, device=device)

        self.name = batch.name
        self._torch, self._batch = torch, batch
        self._data = {name: tensor(array) for name, array in batch.data.items()}
        self._weight = tensor(batch.weight)
        inverse_sigma = 1.0 / (batch.sigma[:, None] if batch.sigma.ndim == 1 else batch.sigma)
        self._inverse_sigma = None if (inverse_sigma == 1.0).all() else tensor(inverse_sigma)
        # Per slot either the constant values of its rows, or the rows to gather in every evaluation.
        self._constant = [None if s.variable in moving else tensor(state[s.variable][s.rows]) for s in batch.slots]
        self._rows = [torch.tensor(s.rows, device=device) if s.variable in moving else None for s in batch.slots]

    def energy(self, values: Mapping[VariableType, Array]) -> Array:
        """Return the scalar energy at the current values of the moving variables."""
        variables = [
            values[slot.variable].index_select(0, rows) if rows is not None else constant
            for slot, rows, constant in zip(self._batch.slots, self._rows, self._constant, strict=True)
        ]
        r = self._batch.factor_type.residual(*variables, **self._data)
        if self._inverse_sigma is not None:
            r = r * self._inverse_sigma
        if self._batch.kernel.kind == "norm":
            # Its gradient at zero is defined to be zero.
            return (self._weight * self._torch.linalg.vector_norm(r, dim=1)).sum()
        return (self._weight * self._batch.kernel.rho((r * r).sum(dim=1))).sum()


class TorchEnergy:
    """The sum of all terms."""

    def __init__(
        self,
        torch: Any,
        batches: Iterable[FactorBatch],
        state: State,
        moving: Iterable[VariableType],
        dtype: Any,
        device: Any,
    ):
        """Prepare the batches.

        Args:
            torch: The module.
            batches: Terms; empty ones are skipped.
            state: Values of the variables that do not move.
            moving: Variable types that are given to every evaluation.
            dtype: torch dtype.
            device: torch device.
        """
        names = set(moving)
        self.batches = [TorchBatch(torch, batch, state, names, dtype, device) for batch in batches if len(batch)]

    def terms(self, values: Mapping[VariableType, Array]) -> dict[str, Array]:
        """Return the energy per term name, as scalar tensors."""
        out: dict[str, Array] = {}
        for batch in self.batches:
            energy = batch.energy(values)
            out[batch.name] = out[batch.name] + energy if batch.name in out else energy
        return out

    def __call__(self, values: Mapping[VariableType, Array]) -> Array:
        """Return the total energy, a scalar tensor."""
        return sum(self.terms(values).values())
