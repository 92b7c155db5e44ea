"""Tables of the declared variable types and factor types, as Markdown."""

from __future__ import annotations

import importlib
import pkgutil
import re
from pathlib import Path

import uni4d_fg.factors
from uni4d_fg.factors import variable_types
from uni4d_fg.factors.factor_type import FactorType, factor_types
from uni4d_fg.factors.variable import VariableType

_KERNEL_NAME = re.compile(r'kName = "(\w+)"')


def variables_table() -> str:
    """Return one row per variable type of the package: its key, the shape of a value, the dimension of a step."""
    lines = ["| variable type | key | one value | tangent | in `uni4d_fg.variables` |", "|---|---|---|---|---|"]
    for name, variable in vars(variable_types).items():
        if isinstance(variable, VariableType):
            shape = " x ".join(map(str, variable.manifold.shape))
            key = f"`{variable.symbol}({', '.join(variable.index)})`"
            lines.append(f"| `{variable}` | {key} | {shape} | {variable.manifold.name}, {variable.dim} | `{name}` |")
    return "\n".join(lines) + "\n"


def factors_table(headers: Path) -> str:
    """Return one row per factor type of the package.

    Args:
        headers: Folder of the C++ kernels, ``cpp_factors/include/uni4d_fg/factors``; a header names what it computes.
    """
    # Declares every factor type of the package, whatever was imported before.
    for module_info in pkgutil.iter_modules(uni4d_fg.factors.__path__, "uni4d_fg.factors."):
        importlib.import_module(module_info.name)
    kernels = {name for path in headers.glob("*.hpp") for name in _KERNEL_NAME.findall(path.read_text("utf-8"))}
    lines = [
        "| factor type | reads | data of one row | residual | Jacobian | C++ kernel | GTSAM's own | declared in |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind in sorted(factor_types(), key=lambda kind: kind.residual.__module__):
        module = kind.residual.__module__
        if module.startswith("uni4d_fg.factors."):
            lines.append(_factor_row(kind, module, has_kernel=kind.name in kernels))
    return "\n".join(lines) + "\n"


def _factor_row(kind: FactorType, module: str, *, has_kernel: bool) -> str:
    reads = " ".join(variable.symbol for variable in kind.variables)
    data = ", ".join(f"{name} {_shape(shape)}".strip() for name, shape in kind.data.items())
    cells = (
        f"`{kind.name}`",
        f"`{reads}`",
        data or "-",
        str(kind.dim),
        "analytic" if kind.is_analytic else "differences",
        "yes" if has_kernel else "no",
        "yes" if kind.native is not None else "no",
        f"`{module.rpartition('.')[2]}.py`",
    )
    return f"| {' | '.join(cells)} |"


def _shape(shape: tuple[int, ...]) -> str:
    return f"({' x '.join(map(str, shape))})" if shape else ""
