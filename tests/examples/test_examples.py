"""The programs in ``examples/`` are short, run, and print what they claim."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples"
PROGRAMS = sorted(path.name for path in FOLDER.glob("*.py"))


def run(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr("sys.argv", [name])
    runpy.run_path(str(FOLDER / name))
    return capsys.readouterr().out


@pytest.mark.parametrize("name", PROGRAMS)
def test_an_example_fits_a_page(name: str) -> None:
    assert len((FOLDER / name).read_text().splitlines()) <= 40


def test_odometry_holds_the_length_of_the_path(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("odometry.py", capsys, monkeypatch)
    found, true = (float(number) for number in re.findall(r"([\d.]+) m", out))
    assert found == pytest.approx(true, rel=5e-3)


def test_a_stage_goes_to_gtsam_and_back(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    out = run("gtsam_round_trip.py", capsys, monkeypatch)
    energies = re.search(r"energy ([\d.]+), ours ([\d.]+)", out)
    assert energies is not None
    assert float(energies[1]) == pytest.approx(float(energies[2]), rel=1e-9)
    assert "back from GTSAM: 0.0" in out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["frame_by_frame.py", "own_factor.py", "video.py"])
def test_other_examples_run(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(run(name, capsys, monkeypatch).splitlines()) > 1
