"""A solved problem in a file: batches, free entries and both states as plain arrays, nothing pickled.

Batches are stored by the name of their factor type and read back through the declarations; GTSAM's own factors are
stored as GTSAM writes them. Arrays are kept as small as they can be without a loss: one row where all are equal, row
numbers in the smallest integers that hold them, single precision where it is exact (pixels mostly are).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import IntArray
from uni4d_fg.errors import InputError
from uni4d_fg.factors import terms as _declared  # noqa: F401 - declares the factor types that a file may name
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.factor_type import factor_types
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import variable_type
from uni4d_fg.files import load_npz, save_npz
from uni4d_fg.optim.native_factors import native_batches
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage_graph import StageGraph


def save_stage_graph(path: Path, stage: StageGraph) -> None:
    """Write a solved stage.

    Factors that exist as Python functions alone (a user's ``gtsam.CustomFactor``, priors that marginalization left)
    are counted and left out, see :attr:`StageGraph.left_out`.

    Raises:
        OutputError: If the file cannot be written.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    header: dict[str, Any] = {"kind": stage.kind, "batches": [], "native": [], "left_out": {}}
    eliminated = stage.problem.eliminated
    header["eliminated"] = None if eliminated is None else eliminated.name
    for i, batch in enumerate(stage.problem.batches):
        if not batch.factor_type.listed:
            _store_native(header, batch, stage.final_state)
            continue
        header["batches"].append(
            {
                "place": i,
                "count": len(batch),
                "type": batch.factor_type.name,
                "term": batch.term,
                "kernel": [batch.kernel.kind, batch.kernel.threshold],
            }
        )
        arrays |= {f"rows_{i}_{j}": _shrunk_rows(slot.rows) for j, slot in enumerate(batch.slots)}
        arrays |= {f"data_{i}_{name}": _shrunk(array) for name, array in batch.data.items()}
        arrays |= {f"sigma_{i}": _shrunk(batch.sigma), f"weight_{i}": _shrunk(batch.weight)}
    header["variables"] = [variable.name for variable in stage.final_state.arrays]
    for variable in stage.final_state.arrays:
        arrays[f"final_{variable}"] = stage.final_state[variable]
        arrays[f"initial_{variable}"] = stage.initial_state[variable]
        arrays[f"index_{variable}"] = stage.final_state.numbers(variable)
        if variable in stage.problem.free:
            arrays[f"free_{variable}"] = stage.problem.free[variable]
    save_npz(path, header=np.array(json.dumps(header)), **arrays)


def load_stage_graph(path: Path) -> StageGraph:
    """Read a solved stage.

    Raises:
        InputError: If the file is not there, damaged, or names a factor or variable type that is not declared.
    """
    arrays = load_npz(path, {"header": None})
    try:
        header = json.loads(str(arrays["header"]))
        known = {declared.name: declared for declared in factor_types()}
        variables = [variable_type(name) for name in header["variables"]]
        index = {v: arrays[f"index_{v}"] for v in variables}
        initial, final = (State({v: arrays[f"{end}_{v}"] for v in variables}, index) for end in ("initial", "final"))
        batches = []
        for entry in header["batches"]:
            if entry["type"] not in known:
                raise InputError(
                    f"{path}: has factors of type '{entry['type']}', which is not declared; import its module first"
                )
            declared, i = known[entry["type"]], entry["place"]
            count = int(entry["count"])
            slots = tuple(
                Slot(variable, _all_rows(arrays[f"rows_{i}_{j}"], count).astype(np.int64))
                for j, variable in enumerate(declared.variables)
            )
            data = {name: _all_rows(arrays[f"data_{i}_{name}"], count).astype(np.float64) for name in declared.data}
            sigma, weight = (_all_rows(arrays[f"{n}_{i}"], count).astype(np.float64) for n in ("sigma", "weight"))
            kernel = Kernel(*entry["kernel"])
            batches.append(
                FactorBatch.create(declared, slots, data, sigma=sigma, weight=weight, kernel=kernel, term=entry["term"])
            )
        graph = gtsam.NonlinearFactorGraph()
        for text in header["native"]:
            graph.deserialize(text)
            batches += native_batches([graph.at(i) for i in range(graph.size())], final)
        free = {v: arrays[f"free_{v}"] for v in variables if f"free_{v}" in arrays}
        eliminated = header["eliminated"]
        left_out = {str(name): int(count) for name, count in header["left_out"].items()}
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: not a solved stage of this version ({error}); make the run again") from error
    problem = Problem(tuple(batches), free, None if eliminated is None else variable_type(eliminated))
    return StageGraph(header["kind"], problem, initial, final, left_out)


def _store_native(header: dict[str, Any], batch: FactorBatch, state: State) -> None:
    from uni4d_fg.optim.gtsam_graph import gtsam_factors

    try:
        graph = gtsam.NonlinearFactorGraph()
        for item in gtsam_factors(batch, state):
            if isinstance(item, gtsam.CustomFactor):
                raise RuntimeError("a custom factor has no text")
            graph.push_back(item)
        header["native"].append(graph.serialize())
    except RuntimeError:
        header["left_out"][batch.name] = header["left_out"].get(batch.name, 0) + len(batch)


def _shrunk(array: npt.NDArray[np.float64]) -> npt.NDArray[Any]:
    """Return an array in single precision if that is exact, and one row of it if all are equal."""
    if len(array) > 1 and (array == array[:1]).all():
        array = array[:1]
    single = np.asarray(array, dtype=np.float32)
    return single if (single == array).all() else np.asarray(array)


def _shrunk_rows(rows: IntArray) -> npt.NDArray[Any]:
    """Return row numbers (n,) in the smallest integers that hold them, and one if all are equal."""
    if len(rows) > 1 and (rows == rows[0]).all():
        rows = rows[:1]
    return rows.astype(np.min_scalar_type(int(rows.max(initial=0))))


def _all_rows(array: npt.NDArray[Any], count: int) -> npt.NDArray[Any]:
    """Undo the shrinking of equal rows."""
    return np.broadcast_to(array, (count, *array.shape[1:]))
