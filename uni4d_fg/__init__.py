"""Factor-graph reconstruction of moving scenes: camera poses, intrinsics, static geometry and 3D motion.

What is listed in ``__all__`` is public; the rest may change. Names are loaded when they are first used.

A wing imports only those before it: :mod:`uni4d_fg.geometry`, :mod:`uni4d_fg.config`, :mod:`uni4d_fg.factors`
(variables and energy terms), :mod:`uni4d_fg.optim` (problems and solvers), :mod:`uni4d_fg.frontend` (what comes in),
:mod:`uni4d_fg.slam` (the stages), :mod:`uni4d_fg.cues` (what a video did not bring), :mod:`uni4d_fg.results` (what
comes out), :mod:`uni4d_fg.pipeline` (whole runs), :mod:`uni4d_fg.cli`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uni4d_fg.config.load import load_config
    from uni4d_fg.factors import variable_types as variables
    from uni4d_fg.factors.factor_type import factor
    from uni4d_fg.factors.kernels import Kernel
    from uni4d_fg.factors.state import State
    from uni4d_fg.factors.variable import VariableType
    from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
    from uni4d_fg.optim.added_factors import Addition
    from uni4d_fg.optim.gtsam_graph import to_gtsam
    from uni4d_fg.optim.problem import Problem
    from uni4d_fg.optim.solve import marginals, solve
    from uni4d_fg.pipeline.api import reconstruct
    from uni4d_fg.pipeline.measurements import MeasurementFiles
    from uni4d_fg.results.evaluate.run import evaluate_run
    from uni4d_fg.results.export.run import export_run
    from uni4d_fg.results.graph_summary import stage_graphs
    from uni4d_fg.results.io import load_reconstruction
    from uni4d_fg.slam.incremental import IncrementalReconstructor

_HOMES = {
    "Addition": "uni4d_fg.optim.added_factors",
    "IncrementalReconstructor": "uni4d_fg.slam.incremental",
    "Kernel": "uni4d_fg.factors.kernels",
    "MeasurementFiles": "uni4d_fg.pipeline.measurements",
    "Problem": "uni4d_fg.optim.problem",
    "State": "uni4d_fg.factors.state",
    "VariableType": "uni4d_fg.factors.variable",
    "evaluate_run": "uni4d_fg.results.evaluate.run",
    "export_run": "uni4d_fg.results.export.run",
    "factor": "uni4d_fg.factors.factor_type",
    "load_config": "uni4d_fg.config.load",
    "load_reconstruction": "uni4d_fg.results.io",
    "make_synthetic_sequence": "uni4d_fg.frontend.synthetic.simulate",
    "marginals": "uni4d_fg.optim.solve",
    "reconstruct": "uni4d_fg.pipeline.api",
    "solve": "uni4d_fg.optim.solve",
    "stage_graphs": "uni4d_fg.results.graph_summary",
    "to_gtsam": "uni4d_fg.optim.gtsam_graph",
}

__all__ = [
    "Addition",
    "IncrementalReconstructor",
    "Kernel",
    "MeasurementFiles",
    "Problem",
    "State",
    "VariableType",
    "evaluate_run",
    "export_run",
    "factor",
    "load_config",
    "load_reconstruction",
    "make_synthetic_sequence",
    "marginals",
    "reconstruct",
    "solve",
    "stage_graphs",
    "to_gtsam",
    "variables",
]


def __getattr__(name: str) -> Any:
    if name == "variables":
        return import_module("uni4d_fg.factors.variable_types")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
