"""A solved problem in a file: batches, free entries and both states as plain arrays, nothing pickled.

Batches are stored by the name of their factor type and read back through the declarations; GTSAM's own factors are
stored as GTSAM writes them. Arrays are kept in single precision where nothing is lost by it: pixels mostly are.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

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
    are counted and left out.

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
                "type": batch.factor_type.name,
                "term": batch.term,
                "kernel": [batch.kernel.kind, batch.kernel.threshold],
            }
        )
        arrays |= {f"rows_{i}_{j}": slot.rows.astype(np.int32) for j, slot in enumerate(batch.slots)}
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
            slots = tuple(
                Slot(variable, arrays[f"rows_{i}_{j}"].astype(np.int64))
                for j, variable in enumerate(declared.variables)
            )
            data = {name: arrays[f"data_{i}_{name}"].astype(np.float64) for name in declared.data}
            sigma, weight = (arrays[f"{name}_{i}"].astype(np.float64) for name in ("sigma", "weight"))
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
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: not a solved stage of this version ({error}); make the run again") from error
    problem = Problem(tuple(batches), free, None if eliminated is None else variable_type(eliminated))
    return StageGraph(header["kind"], problem, initial, final)


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
    """Return an array in single precision if that is exact."""
    single = np.asarray(array, dtype=np.float32)
    return single if (single == array).all() else np.asarray(array)
