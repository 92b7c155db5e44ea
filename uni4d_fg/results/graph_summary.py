"""What a solved stage consists of: variables, factors, energies, degrees of freedom, the worst residuals."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np

from uni4d_fg.errors import InputError
from uni4d_fg.factors.variable import format_key
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.files import atomic_path, atomic_write_text
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.optim.problem_io import load_stage_graph
from uni4d_fg.optim.stage_graph import StageGraph
from uni4d_fg.results.run_folder import RunFolder


@dataclass(frozen=True)
class TermSummary:
    """The factors of one term."""

    factors: int
    residuals: int
    """Scalar residuals."""
    initial_energy: float
    final_energy: float


@dataclass(frozen=True)
class GraphSummary:
    """One solved stage."""

    kind: str
    variables: dict[str, tuple[int, int]]
    """Per variable type how many there are, and how many entries of theirs are free."""
    terms: dict[str, TermSummary]
    worst: list[tuple[str, float, str]]
    """Term, whitened residual norm and variables of the largest residuals."""
    left_out: dict[str, int] = field(default_factory=dict)
    """Factors that the solve had and the file does not hold, by term."""

    @property
    def degrees_of_freedom(self) -> int:
        """Residuals less free entries."""
        return sum(term.residuals for term in self.terms.values()) - sum(free for _, free in self.variables.values())

    def to_dict(self) -> dict[str, object]:
        """Return plain data for JSON."""
        return {
            "kind": self.kind,
            "variables": {name: {"count": n, "free": free} for name, (n, free) in self.variables.items()},
            "terms": {name: vars(term) for name, term in self.terms.items()},
            "degrees_of_freedom": self.degrees_of_freedom,
            "left_out": self.left_out,
            "worst": [{"term": t, "residual": r, "variables": v} for t, r, v in self.worst],
        }


def stage_graphs(run: str | Path) -> dict[str, StageGraph]:
    """Return the solved stages of a run by kind.

    Raises:
        InputError: If the run has none, or one cannot be read.
    """
    folder = RunFolder(Path(run)).graphs
    paths = sorted(folder.glob("*.graph.npz")) if folder.is_dir() else []
    if not paths:
        raise InputError(f"{run}: holds no factor graphs; give the folder of a finished run of 'reconstruct'")
    found = [load_stage_graph(path) for path in paths]
    return {stage.kind: stage for stage in found}


def summarize_graph(stage: StageGraph, worst: int = 5) -> GraphSummary:
    """Summarize a solved stage; ``worst`` residuals of each term's own are compared over all terms."""
    problem, final = stage.problem, stage.final_state
    before, after = problem.energies(stage.initial_state), problem.energies(final)
    variables = {}
    for variable in dict.fromkeys(slot.variable for batch in problem.batches for slot in batch.slots):
        mask = problem.free.get(variable)
        variables[variable.name] = (len(final[variable]), 0 if mask is None else int(mask.sum()))
    terms: dict[str, TermSummary] = {}
    largest: list[tuple[str, float, str]] = []
    for batch in problem.batches:
        old = terms.get(batch.name, TermSummary(0, 0, before[batch.name], after[batch.name]))
        count, dim = len(batch), batch.factor_type.dim
        terms[batch.name] = TermSummary(
            old.factors + count, old.residuals + count * dim, before[batch.name], after[batch.name]
        )
        size = np.sqrt(batch.squared_norm(final))
        for row in np.argsort(size)[::-1][:worst].tolist():
            largest.append((batch.name, float(size[row]), batch.describe_row(row, final)))
    largest.sort(key=lambda entry: -entry[1])
    return GraphSummary(stage.kind, variables, terms, largest[:worst], dict(stage.left_out))


def write_dot(stage: StageGraph, path: Path) -> None:
    """Write GTSAM's picture of the graph in Graphviz's language, with unique names.

    Raises:
        OutputError: If it cannot be written.
    """
    graph, values = to_gtsam(stage.problem, stage.final_state, native=False)
    atomic_write_text(path, graph.dot(values, lambda key: format_key(int(key))))


def write_g2o(stage: StageGraph, path: Path) -> None:
    """Write the poses, and relative poses of consecutive frames, as g2o reads them.

    Raises:
        InputError: If the stage has no poses.
        OutputError: If it cannot be written.
    """
    state = stage.final_state
    if POSE not in state:
        raise InputError(f"{stage.kind}: has no camera poses, which g2o is made of")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses = [gtsam.Pose3(matrix) for matrix in state[POSE]]
    frames = state.numbers(POSE)[:, 0].tolist()
    noise = gtsam.noiseModel.Unit.Create(6)
    for frame, pose in zip(frames, poses, strict=True):
        values.insert(frame, pose)
    for i in range(len(poses) - 1):
        graph.push_back(gtsam.BetweenFactorPose3(frames[i], frames[i + 1], poses[i].between(poses[i + 1]), noise))
    with atomic_path(path) as temporary:
        gtsam.writeG2o(graph, values, str(temporary))
