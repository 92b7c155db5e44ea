from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.cli.main import run as command_line
from uni4d_fg.config.load import load_config
from uni4d_fg.errors import Cancelled, ConfigError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.pipeline.compare.comparison import Budget, Comparison, compare_sequence
from uni4d_fg.pipeline.compare.report import draw_comparison, write_report
from uni4d_fg.pipeline.compare.solvers import solver_variants
from uni4d_fg.pipeline.compare.stored_results import ResultStore

SHORT = [
    "output.clouds=false",
    "output.pictures=false",
    "adam.camera_init.max_iterations=15",
    "adam.bundle_adjustment.max_iterations=30",
    "adam.nonrigid.max_iterations=30",
]
BUDGET = Budget(repeats=1, seconds=1.0)


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return make_synthetic_sequence(
        SyntheticSceneConfig(num_frames=8, height=120, width=160, focal=150, grid_columns=14, grid_rows=10)
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("comparison")


def compared(sequence: Sequence, folder: Path, preset: str, resume: bool = False) -> Comparison:
    config = load_config(preset, SHORT)
    return compare_sequence(sequence, preset, config, solver_variants([]), folder / preset, BUDGET, resume=resume)


@pytest.fixture(scope="module", params=["default", pytest.param("paper", marks=pytest.mark.slow)])
def comparison(request: pytest.FixtureRequest, sequence: Sequence, folder: Path) -> Comparison:
    return compared(sequence, folder, request.param)


def test_every_stage_is_compared_from_both_starts(comparison: Comparison) -> None:
    stage_2 = ["bundle_adjustment", "structure"] if comparison.preset == "default" else ["bundle_adjustment"]
    expected = [("camera_init", "common")]
    expected += [(kind, start) for start in ("lm", "adam") for kind in [*stage_2, "nonrigid"]]
    assert [(c.kind, c.start) for c in comparison.benchmarks] == expected
    assert comparison.benchmarks[0].tasks == 7
    for benchmark in comparison.benchmarks:
        starts = [p.curve[0][1] for p in benchmark.performances.values()]
        assert starts[0] == pytest.approx(starts[1], rel=1e-12)
        terms = [set(p.energy) for p in benchmark.performances.values()]
        assert terms[0] == terms[1]


def test_levenberg_marquardt_ends_below_an_unfinished_descent(comparison: Comparison) -> None:
    for benchmark in comparison.benchmarks:
        assert benchmark.energy_ratio("lm", "adam") <= 1.0 + 1e-3, benchmark.kind
        assert benchmark.performances["adam"].iterations <= 30 * benchmark.tasks
    whole = {name: sum(energy.values()) for name, energy in comparison.camera_init_energy.items()}
    assert whole["lm"] < whole["adam"]


def test_accuracy_and_times_of_the_whole_runs(comparison: Comparison) -> None:
    for run in comparison.runs.values():
        assert 0.0 < run.accuracy["ATE, m"] < 0.2
        assert 0.0 < run.accuracy["static AbsRel"] < 0.1
        assert run.optimization_seconds > 0.0
    if comparison.preset == "default":
        # Not the points' own error: so short a path hardly determines the rotation that aligns them.
        assert comparison.runs["lm"].accuracy["moving AbsRel"] < 0.03


def test_resuming_takes_over_what_is_finished(comparison: Comparison, sequence: Sequence, folder: Path) -> None:
    again = compared(sequence, folder, comparison.preset, resume=True)
    assert again == comparison


def test_the_report_is_strict_json_and_has_its_pictures(
    comparison: Comparison, sequence: Sequence, folder: Path, tmp_path: Path
) -> None:
    write_report(tmp_path, [comparison], {"processor": "x"}, "uni4d-fg compare")
    found = json.loads((tmp_path / "comparison.json").read_text(), parse_constant=lambda text: pytest.fail(text))
    part = found["comparisons"][0]
    assert part["preset"] == comparison.preset
    assert {r["stage"] for r in part["ratios"]} == {"1", "2", "3", "1-3"}
    assert f"## {comparison.sequence}, `{comparison.preset}`" in (tmp_path / "comparison.md").read_text()
    for path in draw_comparison(tmp_path, sequence, comparison, folder / comparison.preset):
        assert path.stat().st_size > 5000


def test_stopping_keeps_finished_parts(sequence: Sequence, tmp_path: Path) -> None:
    config = load_config("default", SHORT)

    def adam_runs() -> bool:
        return (tmp_path / "parts" / "run-lm.json").exists()

    with pytest.raises(Cancelled):
        compare_sequence(sequence, "default", config, solver_variants([]), tmp_path, BUDGET, should_stop=adam_runs)
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["run-lm.json"]


def test_parts_are_trusted_by_key(tmp_path: Path) -> None:
    made: list[int] = []

    def make() -> list[float]:
        made.append(1)
        return [float(len(made))]

    assert ResultStore(tmp_path, True).get("p", "a", list[float], make) == [1.0]
    assert ResultStore(tmp_path, True).get("p", "a", list[float], make) == [1.0]
    assert ResultStore(tmp_path, True).get("p", "b", list[float], make) == [2.0]
    assert ResultStore(tmp_path, False).get("p", "b", list[float], make) == [3.0]
    (tmp_path / "p.json").write_text("{")
    assert ResultStore(tmp_path, True).get("p", "b", list[float], make) == [4.0]


@pytest.mark.parametrize("text", ["tuned", "tuned:", ":adam.precision=float64", "lm:adam.precision=float64", "a b:x=1"])
def test_malformed_variants(text: str) -> None:
    with pytest.raises(ConfigError, match="variant"):
        solver_variants([text])


def test_a_variant_changes_only_its_fields() -> None:
    shared = load_config("default", [])
    variant = solver_variants(["f64:adam.precision=float64,adam.keep_best=true"])[-1].config(shared)
    assert (variant.solver, variant.adam.precision, variant.adam.keep_best) == ("adam", "float64", True)
    assert variant.model_copy(update={"solver": shared.solver, "adam": shared.adam}) == shared


def test_the_command(tmp_path: Path) -> None:
    scene, out = tmp_path / "scene", tmp_path / "out"
    assert command_line(["synthesize", str(scene), "-q", "--frames", "6", "--width", "160", "--height", "120",
                         "--set", "grid_columns=12", "--set", "grid_rows=9"]) == 0  # fmt: skip
    words = ["compare", str(scene), "--out", str(out), "--repeats", "1", "--budget", "1", "-q", "--config", "default"]
    for change in SHORT:
        words += ["--set", change]
    assert command_line(words) == 0
    found = json.loads((out / "comparison.json").read_text())
    assert found["machine"]["cores"]
    assert np.isfinite(found["comparisons"][0]["runs"]["lm"]["accuracy"]["ATE, m"])
    assert command_line(words) == 6  # the folder is not empty
    assert command_line([*words, "--resume"]) == 0


def test_bad_input_of_the_command_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line(["compare", str(tmp_path / "none"), "--out", str(tmp_path / "o"), "-q"]) == 3
    assert command_line(["compare", str(tmp_path), "--variant", "x", "--out", str(tmp_path / "o")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 2
    assert "Traceback" not in err
