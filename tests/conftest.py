"""Shared fixtures: where the real sequences are, and seeded random numbers."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.cli import main


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real sequences; the test is skipped where it is not given."""
    root = os.environ.get("UNI4D_FG_DATA")
    if not root or not Path(root).is_dir():
        pytest.skip("set UNI4D_FG_DATA to the folder of the real sequences to run this test")
    return Path(root)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """The command line in this process: exit code, standard output and standard error of its words."""

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main.run([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return code, out, err

    return run


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("-m"):
        return
    skip = pytest.mark.skip(reason="slow: run with -m slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)
