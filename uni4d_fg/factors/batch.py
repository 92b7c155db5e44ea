"""Many factors of one type at once: which variables each row reads, its data, noise and kernel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType

_PART_ROWS = 1 << 17
"""Factors whose residuals are made at once: millions of poses and points, a copy per factor, would fill the memory."""


@dataclass(frozen=True)
class Slot:
    """One argument of a factor: the variable type it reads and the row of each of the N factors."""

    variable: VariableType
    rows: IntArray  # (N,)


@dataclass(frozen=True)
class FactorBatch:
    """N factors of one type. The energy is ``sum_n weight_n rho(|r_n / sigma_n|)``.

    Raises:
        SolverError: On construction, if an array's length differs from N, naming the term and the array, or the kernel
            is no :class:`Kernel`.
    """

    factor_type: FactorType
    slots: tuple[Slot, ...]
    data: Mapping[str, FloatArray]
    sigma: FloatArray
    """Standard deviation per row (N,) or per row and component (N, d), in the residual's unit."""
    weight: FloatArray
    """(N,) non-negative factor on the row's energy."""
    kernel: Kernel
    term: str = ""
    """Name in summaries; the type's own when empty."""

    def __post_init__(self) -> None:
        n = len(self.slots[0].rows)
        if len(self.slots) != len(self.factor_type.variables):
            raise SolverError(f"{self.name}: {len(self.slots)} slots for {len(self.factor_type.variables)} variables")
        lengths = {f"slot {s.variable}": len(s.rows) for s in self.slots}
        lengths |= {f"data {name}": len(array) for name, array in self.data.items()}
        lengths |= {"sigma": len(self.sigma), "weight": len(self.weight)}
        wrong = {name: length for name, length in lengths.items() if length != n}
        if wrong:
            raise SolverError(f"{self.name}: every array needs {n} rows, got {wrong}")
        if set(self.data) != set(self.factor_type.data):
            raise SolverError(f"{self.name}: needs data {self.factor_type.data}, got {tuple(self.data)}")
        if not isinstance(self.kernel, Kernel):
            raise SolverError(f"{self.name}: kernel must be a Kernel such as Kernel('huber', 1.0), got {self.kernel!r}")

    @classmethod
    def create(
        cls,
        factor_type: FactorType,
        slots: tuple[Slot, ...],
        data: Mapping[str, FloatArray] | None = None,
        *,
        sigma: FloatArray | float = 1.0,
        weight: FloatArray | float = 1.0,
        kernel: Kernel | None = None,
        term: str = "",
    ) -> FactorBatch:
        """Build a batch, broadcasting scalar ``sigma`` and ``weight`` to all rows.

        Raises:
            SolverError: If a sigma is not positive, a weight or a row is negative, a datum has another shape, or the
                kernel is no :class:`Kernel`.
        """
        n = len(slots[0].rows)
        sigma_array = np.broadcast_to(np.asarray(sigma, dtype=np.float64), np.shape(sigma) or (n,))
        weight_array = np.broadcast_to(np.asarray(weight, dtype=np.float64), (n,))
        name = term or factor_type.term
        if not (np.isfinite(sigma_array) & (sigma_array > 0)).all():
            raise SolverError(f"{name}: every sigma must be finite and positive")
        if not (np.isfinite(weight_array) & (weight_array >= 0)).all():
            raise SolverError(f"{name}: every weight must be finite and not negative")
        for slot, variable in zip(slots, factor_type.variables, strict=False):
            if slot.variable is not variable:
                raise SolverError(f"{name}: a slot reads {slot.variable} where the factor needs {variable}")
            if len(slot.rows) and slot.rows.min() < 0:
                raise SolverError(f"{name}: a row of {variable} is negative")
        for key, array in (data or {}).items():
            if key in factor_type.data and array.shape[1:] != factor_type.data[key]:
                raise SolverError(f"{name}: {key} has rows of shape {array.shape[1:]}, not {factor_type.data[key]}")
        return cls(factor_type, slots, data or {}, sigma_array, weight_array, kernel or Kernel(), term)

    def __len__(self) -> int:
        return len(self.slots[0].rows)

    @property
    def name(self) -> str:
        """Name of the term in summaries and messages."""
        return self.term or self.factor_type.term

    def take(self, rows: IntArray | slice) -> FactorBatch:
        """Return the batch with the given rows, in the given order; with a slice, without copying them."""
        return replace(
            self,
            slots=tuple(Slot(s.variable, s.rows[rows]) for s in self.slots),
            data={name: array[rows] for name, array in self.data.items()},
            sigma=self.sigma[rows],
            weight=self.weight[rows],
        )

    def check_rows(self, state: State) -> None:
        """Check that a state has every variable that the factors read.

        Raises:
            SolverError: If it does not; names the term and the variable.
        """
        for slot in self.slots:
            try:
                count = len(state[slot.variable])
            except SolverError as error:
                raise SolverError(f"{self.name}: {error}") from None
            if len(slot.rows) and slot.rows.max() >= count:
                row = int(slot.rows[slot.rows >= count].min())
                raise SolverError(
                    f"{self.name} reads {_absent(slot.variable, row, state)}, which the problem does not have; "
                    f"give rows below {count}"
                )

    def gather(self, state: State) -> list[FloatArray]:
        """Return the variables of every row, one array per slot."""
        return [np.take(state[s.variable], s.rows, axis=0) for s in self.slots]

    def residual(self, state: State) -> FloatArray:
        """Return the raw residuals (N, d)."""
        result: FloatArray = self.factor_type.residual(*self.gather(state), **self.data)
        return result

    def _inverse_sigma(self) -> FloatArray:
        return 1.0 / (self.sigma[:, None] if self.sigma.ndim == 1 else self.sigma)

    def squared_norm(self, state: State) -> FloatArray:
        """Return the whitened squared norm of every row, (N,)."""
        if len(self) > _PART_ROWS:
            parts = (slice(start, start + _PART_ROWS) for start in range(0, len(self), _PART_ROWS))
            return np.concatenate([self.take(part).squared_norm(state) for part in parts])
        whitened = self.residual(state) * self._inverse_sigma()
        result: FloatArray = np.einsum("nd,nd->n", whitened, whitened)
        return result

    def energy(self, state: State, *, exact: bool = False) -> float:
        """Return ``sum_n weight_n rho(|r_n / sigma_n|)``.

        Args:
            state: Where.
            exact: Without the smoothing of 'norm' kernels, which is a solver's aid.
        """
        if len(self) == 0:
            return 0.0
        squared = self.squared_norm(state)
        # Not np.dot: BLAS may spread it over threads, which costs more than it gains and changes the rounding.
        return float(np.sum(self.weight * (self.kernel.exact(squared) if exact else self.kernel.rho(squared))))

    def linearize(self, state: State, kernel_curvature: float = 0.0) -> tuple[FloatArray, list[FloatArray]]:
        """Return residuals (N, d) and Jacobians (N, d, dim) with noise, weight and kernel applied.

        Args:
            state: Where.
            kernel_curvature: Part of the kernel's falloff that J^T J accounts for, in [0, 1); 0 reweights only (IRLS).
                J^T r is the gradient of the energy in any case.

        Raises:
            SolverError: If a Jacobian has the wrong shape or anything is not finite; names the variables.
        """
        r, jacobians = self.factor_type.linearize(*self.gather(state), **self.data)
        self.check(r, jacobians, state)
        inverse_sigma = self._inverse_sigma()
        r = r * inverse_sigma
        squared = np.einsum("nd,nd->n", r, r)
        scale = np.sqrt(self.weight * self.kernel.weight(squared))
        row_scale = (inverse_sigma * scale[:, None])[:, :, None]
        jacobians = [jacobian * row_scale for jacobian in jacobians]
        if kernel_curvature > 0.0:
            # With u the residual's direction: J becomes (I - a u u^T) J and r becomes r / (1 - a).
            kept = np.sqrt(1.0 - kernel_curvature * self.kernel.falloff(squared))
            direction = r / np.sqrt(np.maximum(squared, 1e-300))[:, None]
            along = ((1.0 - kept)[:, None] * direction)[:, :, None]
            jacobians = [j - along * (direction[:, None, :] @ j) for j in jacobians]
            scale = scale / kept
        return r * scale[:, None], jacobians

    def check(self, r: FloatArray, jacobians: list[FloatArray], state: State) -> None:
        """Check what the type's ``linearize`` returned; ``state`` names the variables.

        Raises:
            SolverError: If a shape is wrong or a value is not finite.
        """
        n, d = len(self), self.factor_type.dim
        if len(jacobians) != len(self.slots):
            raise SolverError(f"{self.name}: {len(jacobians)} Jacobians for {len(self.slots)} variables")
        for slot, jacobian in zip(self.slots, jacobians, strict=True):
            expected = (n, d, slot.variable.dim)
            if jacobian.shape != expected:
                raise SolverError(f"{self.name}: Jacobian of {slot.variable} is {jacobian.shape}, not {expected}")
        if r.shape != (n, d):
            raise SolverError(f"{self.name}: residual is {r.shape}, not {(n, d)}")
        # A sum is finite only if every entry is: one cheap pass in the usual case.
        if np.isfinite(r.sum() + sum(jacobian.sum() for jacobian in jacobians)):
            return
        finite = np.isfinite(r).all(axis=1)
        for jacobian in jacobians:
            finite &= np.isfinite(jacobian).all(axis=(1, 2))
        if finite.all():  # only their sum overflowed
            return
        row = int(np.flatnonzero(~finite)[0])
        raise SolverError(
            f"{self.name}: a factor is not finite (at least {int((~finite).sum())} of them); the first is on "
            f"{self.describe_row(row, state)}. Check the cue values of that observation."
        )

    def describe_row(self, row: int, state: State) -> str:
        """Return the decoded variables of one factor: "camera pose, frame 3 and landmark, track 17"."""
        return " and ".join(state.describe(s.variable, int(s.rows[row])) for s in self.slots)


def _absent(variable: VariableType, row: int, state: State) -> str:
    """Return words for a row that a state does not have: the variable itself where rows are the numbers of its keys."""
    counted = State({variable: state[variable]}).numbers(variable)
    if not np.array_equal(state.numbers(variable), counted):
        return f"row {row} of {variable}"
    return f"row {row} of {variable} ({variable.describe(row, *(0 for _ in variable.index[1:]))})"
