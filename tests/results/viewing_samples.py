"""A small finished run, made once per session, and a browser to look at it with."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from uni4d_fg.cli import main
from uni4d_fg.cli.runs import stored_input
from uni4d_fg.results.run import Run

NUM_FRAMES = 8
_SCENE = ["--frames", str(NUM_FRAMES), "--width", "128", "--height", "96", "--set", "focal=120", "--set",
          "grid_columns=20", "--set", "grid_rows=15"]  # fmt: skip


_made: list[Path] = []


def made_run(folder: Path) -> Path:
    """Make a scene and reconstruct it with one changed field; the run has clouds and no pictures."""
    pytest.importorskip("open3d")
    assert main.run(["synthesize", str(folder / "room"), "--quiet", *_SCENE]) == 0
    words = ["reconstruct", str(folder / "room"), "--out", str(folder / "run"), "--config", "fast", "--quiet"]
    assert main.run([*words, "--set", "output.clouds=true", "--set", "fusion.static_stride=3"]) == 0
    return folder / "run"


def copied(run: Path, folder: Path) -> Path:
    """Copy a run so that a test may change it."""
    return Path(shutil.copytree(run, folder / "copy"))


def opened(run: Path) -> Run:
    """Open a run with the sequence it was made from."""
    return Run(run, lambda: stored_input(run).read())


def free_port() -> int:
    """Return a port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def browser_page(**context: Any) -> Iterator[Any]:
    """Open a page in headless chromium with software WebGL; the test is skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on this machine: apt-get install chromium")
    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=flags)
        try:
            yield browser.new_context(**context).new_page()
        finally:
            browser.close()


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small finished run; not to be changed."""
    # Two test folders have this fixture; the run is made once for both.
    if not _made:
        _made.append(made_run(tmp_path_factory.mktemp("viewing")))
    return _made[0]
