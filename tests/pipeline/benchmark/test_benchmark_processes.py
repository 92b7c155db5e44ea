"""Where an experiment runs: on an install without extras, and in worker processes beside each other."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmark_scenes import synthesize

pytest.importorskip("open3d")

PLAIN = [
    "--set",
    "output.clouds=false",
    "--set",
    "output.pictures=false",
    "--protocol",
    "sim3",
    "--quiet",
    "--no-pictures",
]
EXTRAS = (
    "torch", "distributed", "dask", "onnxruntime", "viser", "rerun", "pygltflib", "pooch", "requests", "imageio_ffmpeg"
)  # fmt: skip
ABSENT = f"""
import json, sys
from importlib.machinery import PathFinder

find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *more: None if name.partition(".")[0] in {EXTRAS!r} else find(name, *more)

from uni4d_fg.cli.main import run

print([run(words) for words in json.loads(sys.argv[1])])
"""
"""Exit codes of commands on an install on which no package of an extra is found."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two videos of Sintel."""
    folder = tmp_path_factory.mktemp("sintel")
    synthesize(folder, "sintel", "alley_2", "ambush_4")
    return folder


def test_benchmark_and_ablate_need_no_extra(root: Path, tmp_path: Path) -> None:
    grid = tmp_path / "grid.yaml"
    grid.write_text("rows: {a: {preset: fast, set: [output.clouds=false, output.pictures=false]}}\n")
    one = ["--root", root, "--video", "alley_2"]
    commands = [
        ["benchmark", "sintel", *one, "--video", "ambush_4", "--out", tmp_path / "b", "--config", "fast", *PLAIN],
        ["ablate", "sintel", grid, *one, "--out", tmp_path / "a", "--protocol", "sim3", "--quiet"],
        ["benchmark", "sintel", *one, "--out", tmp_path / "c", "--set", "solver=adam", *PLAIN],
        ["compare", root / "cues" / "alley_2", "--out", tmp_path / "d", "--quiet"],
    ]
    words = json.dumps([[str(word) for word in command] for command in commands])
    done = subprocess.run(
        [sys.executable, "-c", ABSENT, words], capture_output=True, text=True, check=False, timeout=120
    )
    # What needs an extra names it: a video that Adam was to solve has failed, and a comparison does not begin.
    assert done.stdout.splitlines()[-1] == "[0, 0, 3, 7]", done.stderr
    assert done.stderr.count("pip install 'uni4d-fg[adam]'") == 2
    told = json.loads((tmp_path / "b" / "benchmark.json").read_text())
    assert "torch threads" not in told["machine"]
    assert told["failed"] == {"fast": {}}
    rows = {row["method"]: row for row in csv.DictReader((tmp_path / "b" / "tables" / "poses-sim3.csv").open())}
    assert float(rows["fast"]["ATE"]) < 0.02
    assert rows["fast"]["videos"] == "2"
    stages = (tmp_path / "a" / "tables" / "stages-sim3.csv").read_text()
    assert "a, after bundle adjustment" in stages
