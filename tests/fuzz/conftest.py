"""How many hostile cases are tried: a few hundred in the fast suite, ``UNI4D_FG_FUZZ=10`` tries ten times as many."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hostile import TINY_SCENE

# Small samples of the formats that are read, which other tests write.
sys.path += [str(Path(__file__).parents[1] / folder) for folder in ("frontend/datasets", "pipeline/benchmark")]

EFFORT = float(os.environ.get("UNI4D_FG_FUZZ", "1"))
hypothesis.settings.register_profile(
    "hostile",
    deadline=None,
    max_examples=max(1, round(40 * EFFORT)),
    derandomize=EFFORT <= 1,  # the same few in the fast suite, others every time by hand
    database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
)


@pytest.fixture(scope="session")
def sequence_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sequence in the native layout, not to be changed."""
    from uni4d_fg.config.synthetic import SyntheticSceneConfig
    from uni4d_fg.frontend.sequence.write import write_native
    from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence

    pytest.importorskip("open3d")
    folder = tmp_path_factory.mktemp("hostile") / "room"
    write_native(make_synthetic_sequence(SyntheticSceneConfig(**TINY_SCENE)), folder)
    return folder


@pytest.fixture(scope="session")
def run_folder(sequence_folder: Path) -> Path:
    """A finished run of it, not to be changed."""
    from uni4d_fg.cli import main

    run = sequence_folder.parent / "run"
    words = ["reconstruct", sequence_folder, "--out", run, "--config", "fast", "--quiet", "--set", "output.clouds=true"]
    assert main.run([str(word) for word in words]) == 0
    return run


@pytest.fixture(scope="session")
def video_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short video."""
    import cv2

    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (64, 48))
    for seed in range(6):
        writer.write(np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8))
    writer.release()
    return path
