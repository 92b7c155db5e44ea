"""A whole run with ``solver: adam``: the folder it writes, resuming, the command line, a missing package."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uni4d_fg.cli import main
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.errors import MissingDependencyError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.trajectory_files import read_tum
from uni4d_fg.optim.summary import Termination
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder

LIMITS = [
    "adam.camera_init.max_iterations=25",
    "adam.bundle_adjustment.max_iterations=25",
    "adam.nonrigid.max_iterations=25",
]
NO_VIEWS = ["output.clouds=false", "output.pictures=false"]


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return make_synthetic_sequence(
        SyntheticSceneConfig(
            render_images=False, num_frames=6, height=60, width=80, focal=75.0, margin_px=3.0, grid_columns=14,
            grid_rows=10, query_interval=4,
        )
    )  # fmt: skip


def config(preset: str, *overrides: str) -> Config:
    return load_config(preset, ["solver=adam", *LIMITS, *NO_VIEWS, *overrides])


@pytest.mark.parametrize("preset", [pytest.param("paper", marks=pytest.mark.slow), "default"])
def test_a_run_is_complete_can_be_scored_and_is_resumed(preset: str, sequence: Sequence, tmp_path: Path) -> None:
    reconstruct(sequence, tmp_path, config(preset))
    folder = RunFolder(tmp_path)
    result = load_reconstruction(folder.reconstruction)
    assert result.world_T_cam.shape == (6, 4, 4)
    assert np.isfinite(result.world_T_cam).all()
    assert len(result.landmarks) > 20
    assert len(result.dynamic_points) > 5
    rotation = result.world_T_cam[:, :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (6, 1, 1)), atol=1e-9)
    assert read_depth(folder.depth).array.shape == (6, 60, 80)
    np.testing.assert_allclose(read_tum(folder.trajectory).world_T_cam, result.world_T_cam, atol=1e-6)
    summary = json.loads(folder.summary.read_text())
    solves = [s for stage in summary["stages"].values() for s in stage.get("solves", [])]
    assert solves
    assert all(solve["notes"]["solver"] == "adam" for solve in solves)
    ends = {Termination.MAX_ITERATIONS.value, Termination.EARLY_STOPPED.value}
    assert {solve["termination"] for solve in solves} <= ends
    assert evaluate_run(tmp_path, sequence).trajectory is not None

    again = reconstruct(sequence, tmp_path, config(preset), resume=True)
    assert all(stage["resumed"] for name, stage in again.stages.items() if name != "output")


def test_another_solver_or_schedule_is_not_resumed(sequence: Sequence, tmp_path: Path) -> None:
    reconstruct(sequence, tmp_path, config("paper"))
    changed = reconstruct(sequence, tmp_path, config("paper", "adam.nonrigid.max_iterations=24"), resume=True)
    assert changed.stages["tracks"]["resumed"]
    assert not changed.stages["camera_init"]["resumed"]
    by_lm = load_config("paper", NO_VIEWS)
    assert not reconstruct(sequence, tmp_path, by_lm, resume=True).stages["camera_init"]["resumed"]
    schedule = load_config("paper", [*NO_VIEWS, *LIMITS])
    assert reconstruct(sequence, tmp_path, schedule, resume=True).stages["camera_init"]["resumed"]


def test_the_command_line_chooses_the_solver(sequence: Sequence, tmp_path: Path) -> None:
    write_native(sequence, tmp_path / "room")
    changes = [word for change in (*LIMITS, *NO_VIEWS) for word in ("--set", change)]
    words = ["reconstruct", str(tmp_path / "room"), "--out", str(tmp_path / "run"), "--config", "paper", "--quiet"]
    assert main.run([*words, "--solver", "adam", *changes]) == 0
    assert "solver: adam" in RunFolder(tmp_path / "run").config.read_text()
    assert main.run([*words, "--solver", "newton", "--overwrite"]) == 2


def test_a_missing_torch_ends_the_run_before_it_begins(
    sequence: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.import_module

    def without_torch(name: str, package: str | None = None) -> Any:
        if name == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without_torch)
    with pytest.raises(MissingDependencyError, match="Adam solver needs torch"):
        reconstruct(sequence, tmp_path / "run", config("paper"))
    assert not (tmp_path / "run").exists()
