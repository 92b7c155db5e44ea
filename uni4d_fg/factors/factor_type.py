"""Factor types: an energy term as a function on arrays, declared once.

    @factor(POSE, data={"xyz": 3}, dim=3)
    def position_prior(world_T_cam, *, xyz):
        return world_T_cam[..., :3, 3] - xyz

    problem.add(position_prior(frames, xyz=measured, sigma=0.05))

The residual is written once, batched, for NumPy and torch. An analytic Jacobian is optional
(``@position_prior.jacobian``); without one the residual is differentiated by central differences on the variables'
manifolds. Solvers, the exact energy, the Adam baseline, the GTSAM bridge, the C++ kernels and the tests of Jacobians
all go by what is declared here.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.variable import VariableType

if TYPE_CHECKING:
    from uni4d_fg.factors.batch import FactorBatch
    from uni4d_fg.factors.kernels import Kernel

ResidualFunction: TypeAlias = Callable[..., Array]
"""``residual(*variables, **data) -> (N, d)``; NumPy or torch, leading batch axis N."""

Linearized: TypeAlias = tuple[FloatArray, list[FloatArray]]
LinearizeFunction: TypeAlias = Callable[..., Linearized]
"""``linearize(*variables, **data) -> r (N, d), [J_i (N, d, dim_i)]`` with respect to each variable's tangent; NumPy."""

NativeFunction: TypeAlias = Callable[["NativeRow"], Any]
"""Makes GTSAM's own factor of one row, or returns None where GTSAM has none that is equal."""

_RESERVED = {"sigma", "weight", "kernel", "term"}
_STEP = 1e-6
"""Step of central differences, relative to entries above 1: their error is about 1e-10 of the derivative."""


@dataclass(frozen=True)
class NativeRow:
    """One factor, for :attr:`FactorType.native`."""

    keys: tuple[int, ...]
    """Key per slot."""
    values: tuple[FloatArray, ...]
    """Value per slot."""
    data: Mapping[str, Any]
    noise: Any
    """``gtsam.noiseModel`` with the factor's sigma, weight and kernel."""
    is_robust: bool


@dataclass(frozen=True, eq=False)
class FactorType:
    """One energy term as a function on arrays; calling it makes factors, see :meth:`__call__`.

    Raises:
        SolverError: On construction, if a name is used twice or a datum has a reserved name.
    """

    name: str
    """Unique; also the name of its C++ kernel, if it has one."""
    variables: tuple[VariableType, ...]
    """What each slot reads, in the order of the residual's positional arguments."""
    data: Mapping[str, tuple[int, ...]]
    """Measurements, the residual's keyword arguments: shape of one row."""
    dim: int
    """Length d of one residual."""
    residual: ResidualFunction
    linearize: LinearizeFunction = field(default=None)  # type: ignore[assignment]
    """Analytic, or by central differences where it was left out."""
    term: str = ""
    """Name in summaries, which several types may share; the type's name when empty."""
    stack: int | tuple[int, ...] | None = None
    """Slots whose first number collects rows into one ``gtsam.CustomFactor``; one factor per row when None."""
    native: NativeFunction | None = None
    """GTSAM's own factor, where it has an equal one."""
    listed: bool = True
    """Whether :func:`factor_types` returns it; off for types that a computation makes for itself."""

    def __post_init__(self) -> None:
        if self.linearize is None:
            object.__setattr__(self, "linearize", self._differences)
        if not self.term:
            object.__setattr__(self, "term", self.name)
        if reserved := _RESERVED & set(self.data):
            raise SolverError(f"factor type '{self.name}': data may not be called {', '.join(sorted(reserved))}")
        known = _LISTED.get(self.name)
        if known is not None and known.residual.__module__ != self.residual.__module__:
            raise SolverError(f"factor type '{self.name}' is declared in {known.residual.__module__} already")
        if self.listed:
            _LISTED[self.name] = self

    def __repr__(self) -> str:
        return f"FactorType({self.name!r})"

    def __reduce__(self) -> Any:
        # By name, as variable types are: what it was declared with stands in the module under its name.
        return (_listed, (self.name, self.residual.__module__)) if self.listed else super().__reduce__()

    def __call__(
        self,
        *rows: IntArray | int,
        sigma: FloatArray | float = 1.0,
        weight: FloatArray | float = 1.0,
        kernel: Kernel | None = None,
        term: str = "",
        **data: Any,
    ) -> FactorBatch:
        """Make N factors.

        Args:
            rows: Per slot the rows (N,) of the variables in the state; a scalar counts for all.
            sigma: Standard deviation, scalar, (N,) or (N, d), in the residual's unit.
            weight: Factor on the energy, scalar or (N,), not negative.
            kernel: Robust kernel on the whitened norm; none when left out.
            term: Name in summaries; the type's own when empty.
            **data: Measurements, N rows each.

        Raises:
            SolverError: If a shape does not fit, a number is not finite, not positive or negative, or the kernel is no
                :class:`~uni4d_fg.factors.kernels.Kernel`.
        """
        from uni4d_fg.factors.batch import FactorBatch, Slot

        count = next((np.size(r) for r in rows if np.ndim(r)), 1)
        full = [np.broadcast_to(np.asarray(r, dtype=np.int64), (count,)) for r in rows]
        slots = tuple(Slot(variable, r) for variable, r in zip(self.variables, full, strict=False))
        arrays = {name: np.asarray(array, dtype=np.float64) for name, array in data.items()}
        return FactorBatch.create(self, slots, arrays, sigma=sigma, weight=weight, kernel=kernel, term=term)

    @property
    def is_analytic(self) -> bool:
        """Whether its Jacobian was written by hand."""
        return getattr(self.linearize, "__func__", None) is not FactorType._differences

    def jacobian(self, linearize: LinearizeFunction) -> LinearizeFunction:
        """Take the decorated function as :attr:`linearize`."""
        object.__setattr__(self, "linearize", linearize)
        return linearize

    def _differences(self, *variables: FloatArray, **data: FloatArray) -> Linearized:
        """Differentiate the residual by central differences in the tangent of every variable."""
        r = np.asarray(self.residual(*variables, **data))
        jacobians = []
        for slot, (variable, values) in enumerate(zip(self.variables, variables, strict=True)):
            manifold = variable.manifold
            jacobian = np.zeros((*r.shape, variable.dim))
            flat = len(manifold.shape) == 1
            for j in range(variable.dim):
                size = np.maximum(1.0, np.abs(values[:, j])) if flat else np.ones(len(values))
                step = np.zeros((len(values), variable.dim))
                step[:, j] = _STEP * size
                ends = []
                for tangent in (step, -step):
                    moved = list(variables)
                    moved[slot] = manifold.retract(values, tangent)
                    ends.append(np.asarray(self.residual(*moved, **data)))
                jacobian[:, :, j] = (ends[0] - ends[1]) / (2.0 * step[:, j, None])
            jacobians.append(jacobian)
        return r, jacobians


_LISTED: dict[str, FactorType] = {}


def factor(
    *variables: VariableType,
    dim: int,
    data: Mapping[str, int | tuple[int, ...]] | None = None,
    name: str = "",
    term: str = "",
    stack: int | tuple[int, ...] | None = None,
    native: NativeFunction | None = None,
) -> Callable[[ResidualFunction], FactorType]:
    """Declare the decorated residual as a factor type; arguments as the fields of :class:`FactorType`.

    ``data`` gives the shape of one row: 3 for a 3-vector, () for a number, (4, 4) for a pose.
    """
    shapes = {key: (shape,) if isinstance(shape, int) else tuple(shape) for key, shape in (data or {}).items()}

    def declare(residual: ResidualFunction) -> FactorType:
        return FactorType(
            name or residual.__name__, tuple(variables), shapes, dim, residual, term=term, stack=stack, native=native
        )

    return declare


def _listed(name: str, module: str) -> FactorType:
    """Return the factor type of a name, in a process that may not have loaded its module yet."""
    importlib.import_module(module)
    return _LISTED[name]


def factor_types() -> tuple[FactorType, ...]:
    """Return every declared type, in the order of declaration."""
    return tuple(_LISTED.values())
