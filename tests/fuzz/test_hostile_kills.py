"""Processes killed at random moments, then resumed: the result is that of an undisturbed run, byte by byte.

Stored records of stages hold the seconds that they took; of them the arrays are compared.
"""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hostile import TINY_SCENE, state_of

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.stream import stream_sequence

pytest.importorskip("open3d")

PROGRAMS = Path(__file__).parents[1] / "pipeline"
ENTRY = [sys.executable, "-m", "uni4d_fg"]
QUIET = ["output.clouds=false", "output.pictures=false"]


def draws() -> np.random.Generator:
    return np.random.default_rng(int(os.environ.get("UNI4D_FG_SEED", "0")))


def scene(frames: int) -> Sequence:
    return make_synthetic_sequence(SyntheticSceneConfig(**{**TINY_SCENE, "num_frames": frames}))


def assert_same(found: Path, wanted: Path) -> None:
    """Assert that two runs hold the same files, but for the seconds that they took."""
    here, there = state_of(found), state_of(wanted)
    assert set(here) == set(there)
    for name, data in here.items():
        if name == "summary.json" or data == there[name]:
            continue
        assert name.startswith("stages/"), name
        with np.load(found / name) as mine, np.load(wanted / name) as theirs:
            assert set(mine) == set(theirs)
            for key in set(mine) - {"summary"}:
                np.testing.assert_array_equal(mine[key], theirs[key], err_msg=f"{name}: {key}")


def killed_and_resumed(tmp_path: Path, sequence: Sequence, config: Config, writes: int, polls: int) -> None:
    rng = draws()
    reconstruct(sequence, tmp_path / "whole", config)
    work = tmp_path / "work.pickle"
    work.write_bytes(pickle.dumps((sequence, config)))
    cases = [f"write:{n}" for n in rng.choice(np.arange(1, writes), 12, replace=False)]
    cases += [f"poll:{n}" for n in rng.choice(np.arange(1, polls), 12, replace=False)]
    cases += [f"seconds:{s:.2f}" for s in rng.uniform(0.02, 1.0, 8)]
    command = [sys.executable, str(PROGRAMS / "pipeline_killed.py"), str(work), str(tmp_path), *cases]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said.count(f" {signal.SIGKILL.value}\n") > 20, said
    for case in cases:
        run = tmp_path / case.replace(":", "-")
        reconstruct(sequence, run, config, resume=True)
        assert_same(run, tmp_path / "whole")


@pytest.mark.slow
def test_batch(tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, scene(6), load_config("fast", QUIET), 15, 50)


@pytest.mark.slow
def test_windows(tmp_path: Path) -> None:
    config = load_config("fast", [*QUIET, "windows.frames=9", "windows.overlap=3"])
    killed_and_resumed(tmp_path, scene(14), config, 20, 80)


@pytest.mark.slow
def test_stream(tmp_path: Path) -> None:
    rng, sequence = draws(), scene(20)
    config = load_config("default", [*QUIET, "incremental.window=6", "incremental.checkpoint_interval=3",
                                     "incremental.nonrigid_lag=3", "incremental.nonrigid_window=6"])  # fmt: skip
    stream_sequence(sequence, tmp_path / "whole", config)
    work = tmp_path / "work.pickle"
    work.write_bytes(pickle.dumps((sequence, config)))
    for case in range(4):
        moments = [f"write:{n}" for n in rng.integers(1, 5, 3)] + [f"frame:{n}" for n in rng.integers(1, 9, 3)]
        command = [sys.executable, str(PROGRAMS / "stream_killed.py"), str(work), str(tmp_path / str(case)), *moments]
        said = subprocess.run(command, input="go\n" * len(moments), capture_output=True, text=True, check=True).stdout
        assert said.count(str(signal.SIGKILL.value)) >= 4, said
        stream_sequence(sequence, tmp_path / str(case), config, resume=True)
        found, wanted = state_of(tmp_path / str(case)), state_of(tmp_path / "whole")
        assert found["reconstruction.npz"] == wanted["reconstruction.npz"]
        assert found["trajectory.tum"] == wanted["trajectory.tum"]


def killed_verb(words: list[str], seconds: float) -> int:
    process = subprocess.Popen([*ENTRY, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(seconds)
    process.kill()
    return process.wait()


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["cues", "export"])
def test_verbs(tmp_path: Path, sequence_folder: Path, run_folder: Path, verb: str) -> None:
    if verb == "cues":
        words = ["cues", str(sequence_folder), "--masks", "motion", "--quiet", "--out"]
    else:
        words = ["export", str(run_folder), "--to", "colmap", "--to", "ply", "--quiet", "--overwrite", "--out"]
    began = time.monotonic()
    assert subprocess.run([*ENTRY, *words, str(tmp_path / "whole")], check=False, capture_output=True).returncode == 0
    took = time.monotonic() - began
    for case, part in enumerate(draws().uniform(0.3, 1.0, 8)):
        out = tmp_path / str(case)
        killed_verb([*words, str(out)], part * took)
        if out.exists() and verb == "cues":
            shutil.rmtree(out)  # it had ended
        assert subprocess.run([*ENTRY, *words, str(out)], check=False, capture_output=True).returncode == 0
        found, wanted = state_of(out), state_of(tmp_path / "whole")
        found = {name: data for name, data in found.items() if not name.startswith(".tmp-")}
        assert set(found) == set(wanted)
        assert all(found[name] == wanted[name] for name in found if not name.endswith("export.json"))
