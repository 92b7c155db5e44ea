"""Shared fixtures: where the real sequences are, and seeded random numbers; and how parallel workers share the cores.

NumPy, torch and this package are imported inside the fixtures: BLAS and OpenMP decide when they are loaded how many
threads they start, and that is after :func:`share_cores`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import pytest

if TYPE_CHECKING:
    import numpy as np


def share_cores() -> None:
    """Give each worker of pytest-xdist cores of its own, so that the threads of two do not wait for each other."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is None:
        return
    number, count = int(worker.removeprefix("gw")), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else list(range(os.cpu_count() or 1))
    own = cores[number % len(cores) :: count]
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, own)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, str(len(own)))


share_cores()
# How long one example takes says how busy the machine is.
hypothesis.settings.register_profile("no deadline", deadline=None)
hypothesis.settings.load_profile("no deadline")


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real sequences; the test is skipped where it is not given."""
    root = os.environ.get("UNI4D_FG_DATA")
    if not root or not Path(root).is_dir():
        pytest.skip("set UNI4D_FG_DATA to the folder of the real sequences to run this test")
    return Path(root).resolve()


@pytest.fixture
def load_benchmark(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    """Import a module of the benchmarks, which finds those beside it."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module


@pytest.fixture
def rng() -> np.random.Generator:
    import numpy as np

    return np.random.default_rng(7)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """The command line in this process: exit code, standard output and standard error of its words."""
    from uni4d_fg.cli import main

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
