"""Variable types: what a variable is, declared once.

A variable type is a name, a manifold and a GTSAM key character. Everything that handles variables - the state, the
solvers, the marginals, the Adam baseline, the GTSAM bridge, the messages - asks the type and never its name, so that a
new type is one declaration:

    OBJECT_POSE = VariableType("object_pose", "o", SE3, index=("instance", "frame"), label="object pose")

A key is the character in the top 8 bits and an index in the lower 56, the layout of ``gtsam.Symbol``. A type with two
numbers packs them in decimal, so that GTSAM's own printing shows them: track 2 in frame 3 is ``p20003``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import Array, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry import se3

INDEX_BITS = 56
MAX_INDEX = (1 << INDEX_BITS) - 1
_FRAMES = 10_000
"""Frames below this take the four last decimal digits of a key's index."""
_LATE = 10**15
"""Offset of indices whose frame needs more digits."""
_LATE_FRAMES = 10**8


@dataclass(frozen=True)
class Manifold:
    """The space a variable lives in, on batches of n values."""

    name: str
    dim: int
    """Dimension of the tangent space."""
    shape: tuple[int, ...]
    """Shape of one value."""
    retract: Callable[[FloatArray, FloatArray], FloatArray]
    """``retract(values, tangents (n, dim))``."""
    local: Callable[[FloatArray, FloatArray], FloatArray]
    """``local(origin, values)``: the tangents (n, dim) that lead from ``origin`` to ``values``."""
    local_jacobian: Callable[[FloatArray], FloatArray]
    """``d local(origin, retract(values, d)) / d d`` (n, dim, dim) at tangents ``local(origin, values)``."""
    to_parameters: Callable[[FloatArray], dict[str, FloatArray]]
    """Plain arrays for first-order methods, by suffix of their name."""
    from_parameters: Callable[[Mapping[str, Array]], Array]
    """Values from such arrays, NumPy or torch, differentiable."""
    parameter_columns: Mapping[str, slice]
    """Tangent columns that freeze each of these arrays."""


def vector_space(dim: int) -> Manifold:
    """Return R^dim: values (n, dim) that are moved by addition."""
    return Manifold(
        name=f"R{dim}",
        dim=dim,
        shape=(dim,),
        retract=np.add,
        local=lambda origin, values: values - origin,
        local_jacobian=lambda tangents: np.broadcast_to(np.eye(dim), (len(tangents), dim, dim)),
        to_parameters=lambda values: {"": values},
        from_parameters=lambda parameters: parameters[""],
        parameter_columns={"": slice(0, dim)},
    )


def _se3_parameters(values: FloatArray) -> dict[str, FloatArray]:
    return {".rotation": se3.so3_log(values[:, :3, :3]), ".center": values[:, :3, 3]}


def _se3_from_parameters(parameters: Mapping[str, Array]) -> Array:
    return se3.from_rotation_vector(parameters[".rotation"], parameters[".center"])


SE3 = Manifold(
    name="SE3",
    dim=6,
    shape=(4, 4),
    retract=se3.retract,
    local=lambda origin, values: se3.se3_log(se3.inverse(origin) @ values),
    local_jacobian=se3.inverse_right_jacobian,
    to_parameters=_se3_parameters,
    from_parameters=_se3_from_parameters,
    parameter_columns={".rotation": slice(0, 3), ".center": slice(3, 6)},
)
"""Rigid transforms (n, 4, 4); tangents are body-frame twists (omega [rad], v [m]), rotation first, as GTSAM's."""

_REGISTERED: dict[str, VariableType] = {}


@dataclass(frozen=True, eq=False)
class VariableType:
    """A kind of variable.

    Declaring a type again with the same name, key character and dimension (as a notebook does) replaces it; states and
    factors made with the earlier declaration are then refused.

    Raises:
        SolverError: On construction, if another type has the name or the key character, or that is no ASCII letter.
    """

    name: str
    symbol: str
    """Key character: one ASCII letter, as ``gtsam.Symbol`` has it."""
    manifold: Manifold
    index: tuple[str, ...] = ("frame",)
    """What the one or two numbers of a key are called; of two, the second is a frame."""
    label: str = ""
    """Words for messages; the name when empty."""
    to_gtsam: Callable[[FloatArray], Any] = lambda value: value
    """One value as ``gtsam.Values`` takes it."""
    from_gtsam: Callable[[gtsam.Values, int], FloatArray] = lambda values, key: values.atVector(key)
    """Read one value from a ``gtsam.Values``."""
    gtsam_columns: tuple[int, ...] = field(default=())
    """Where the tangent's entries stand in GTSAM's tangent; all in order when empty."""
    gtsam_dim: int = 0
    """Dimension of GTSAM's tangent; that of the manifold when 0."""

    def __post_init__(self) -> None:
        if not (len(self.symbol) == 1 and self.symbol.isascii() and self.symbol.isalpha()):
            raise SolverError(
                f"variable type '{self.name}': the key character '{self.symbol}' must be one letter, a to z or A to Z"
            )
        if len(self.index) not in (1, 2):
            raise SolverError(f"variable type '{self.name}': needs one or two index names, got {self.index}")
        for other in _REGISTERED.values():
            again = (other.name, other.symbol) == (self.name, self.symbol) and other.dim == self.dim
            if (other.name == self.name or other.symbol == self.symbol) and not again:
                raise SolverError(
                    f"variable type '{self.name}' ({self.symbol}): the name or the key character is that of "
                    f"'{other.name}' ({other.symbol}); every type needs its own"
                )
        _REGISTERED[self.name] = self

    @property
    def dim(self) -> int:
        """Dimension of the tangent space."""
        return self.manifold.dim

    def __str__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        return f"VariableType({self.name!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return variable_type, (self.name,)

    def __copy__(self) -> VariableType:
        return self

    def __deepcopy__(self, memo: Any) -> VariableType:
        return self

    def key(self, *numbers: int) -> int:
        """Return the GTSAM key of one variable; its numbers are those that ``index`` names."""
        return int(self.keys(np.array([numbers], dtype=np.int64))[0])

    def keys(self, numbers: IntArray) -> list[int]:
        """Return the GTSAM keys of variables with the given numbers (n, len(index)).

        Raises:
            ValueError: If a number is negative or too large for a key.
        """
        numbers = np.asarray(numbers, dtype=np.int64)
        if numbers.size == 0:
            return []
        numbers = numbers.reshape(len(numbers), -1)
        if numbers.shape[1] != len(self.index):
            raise ValueError(f"{self.name} has the numbers {self.index}, got {numbers.shape[1]} of them")
        index, wrong = numbers[:, 0], (numbers < 0).any(axis=1)
        if numbers.shape[1] == 2:
            first, frame = numbers.T
            late = frame >= _FRAMES
            end = np.where(late, (MAX_INDEX - _LATE) // _LATE_FRAMES, _LATE // _FRAMES)
            wrong |= (first >= end) | (frame >= _LATE_FRAMES)
            index = np.where(late, _LATE + first * _LATE_FRAMES + frame, first * _FRAMES + frame)
        else:
            wrong |= index > MAX_INDEX
        if wrong.any():
            raise ValueError(f"{self.describe(*numbers[wrong][0].tolist())} is outside of what a key can hold")
        prefix = ord(self.symbol) << INDEX_BITS
        return [prefix | i for i in index.tolist()]

    def numbers(self, index: int) -> tuple[int, ...]:
        """Return the numbers that are packed into the lower bits of a key."""
        if len(self.index) == 1:
            return (index,)
        return divmod(index - _LATE, _LATE_FRAMES) if index >= _LATE else divmod(index, _FRAMES)

    def describe(self, *numbers: int) -> str:
        """Return words for one variable: "dynamic point, track 17, frame 3"."""
        parts = [f"{name} {number}" for name, number in zip(self.index, numbers, strict=True) if name]
        return ", ".join([self.label or self.name.replace("_", " "), *parts])


def variable_type(name: str) -> VariableType:
    """Return a declared type by its name.

    Raises:
        SolverError: If there is none.
    """
    if name not in _REGISTERED:
        raise SolverError(f"there is no variable type '{name}'; declared are {', '.join(_REGISTERED)}")
    return _REGISTERED[name]


def variable_types() -> tuple[VariableType, ...]:
    """Return every declared type, in the order of declaration."""
    return tuple(_REGISTERED.values())


def locate(key: int) -> tuple[VariableType, tuple[int, ...]] | None:
    """Return the type and the numbers of a key; None for keys of other programs."""
    symbol = chr(key >> INDEX_BITS)
    for variable in _REGISTERED.values():
        if variable.symbol == symbol:
            return variable, variable.numbers(key & MAX_INDEX)
    return None


def describe(key: int) -> str:
    """Return words for a key: "camera pose, frame 3"."""
    found = locate(key)
    return f"unknown variable {key}" if found is None else found[0].describe(*found[1])


def format_key(key: int) -> str:
    """Return a short unique symbol for a key, for GTSAM's printing and its graph files: "x3", "p17_3"."""
    found = locate(key)
    return str(key) if found is None else found[0].symbol + "_".join(map(str, found[1]))
