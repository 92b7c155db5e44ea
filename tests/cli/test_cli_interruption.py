"""Ctrl-C in a real process, and progress reports."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console
from rich.progress import Progress, TextColumn

from uni4d_fg.cli import main
from uni4d_fg.cli.interruption import Interruption
from uni4d_fg.cli.progress import LineReporter, RichReporter, progress_reporter
from uni4d_fg.errors import Cancelled
from uni4d_fg.progress import SilentReporter

pytest.importorskip("open3d")


def test_the_first_press_sets_the_flag_and_the_second_aborts() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(Cancelled, match="aborted"), Interruption() as stop:  # noqa: PT012
        assert not stop()
        os.kill(os.getpid(), signal.SIGINT)
        assert stop()
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupted_run_ends_cleanly_and_resumes(tmp_path: Path) -> None:
    scene, run = tmp_path / "scene", tmp_path / "run"
    size = ["--frames", "6", "--width", "96", "--height", "72", "--set", "grid_columns=12", "--set", "grid_rows=9"]
    assert main.run(["synthesize", str(scene), "--quiet", *size]) == 0
    # A slow tracker gives the signal time to arrive in the middle of a stage.
    (scene / "tracks.npz").unlink()
    (scene / "ground_truth.npz").unlink()
    program = (
        "import sys, time\n"
        "from uni4d_fg.cli import main\n"
        "from uni4d_fg.frontend.tracks import lucas_kanade\n"
        "move = lucas_kanade.FollowedPoints.move\n"
        "def slow_move(*args, **options):\n"
        "    print('moving', flush=True)\n"
        "    time.sleep(0.5)\n"
        "    return move(*args, **options)\n"
        "lucas_kanade.FollowedPoints.move = slow_move\n"
        "sys.argv[0] = 'uni4d-fg'\n"
        "sys.exit(main.run(sys.argv[1:]))\n"
    )
    words = ["reconstruct", str(scene), "--out", str(run), "--config", "fast"]
    process = subprocess.Popen(
        [sys.executable, "-c", program, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "moving\n"
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "press Ctrl-C again" in err
    assert f"uni4d-fg reconstruct {scene} --out {run} --config fast --resume" in err
    assert "Traceback" not in err
    assert not (run / "summary.json").exists()
    assert main.run([*words, "--resume", "--quiet"]) == 0
    assert (run / "summary.json").exists()


def test_line_reporter_prints_one_line_per_task(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = LineReporter()
    reporter.advance(1)
    reporter.end()
    reporter.begin("first", 3)
    reporter.advance(2, "half")
    reporter.begin("second", None)
    reporter.end("all well")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == ["first", "second"]
    assert lines[1].endswith("s, all well")


def test_rich_reporter_ends_every_task() -> None:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=100)
    with Progress(TextColumn("{task.description} {task.fields[text]}", markup=False), console=console) as progress:
        reporter = RichReporter(progress)
        reporter.advance(3)
        reporter.end()
        reporter.begin("camera [init]", 4)
        reporter.advance(2, "window [3]")
        reporter.begin("fusion", None)
        reporter.advance(5)
        reporter.end("done")
        assert [task.finished for task in progress.tasks] == [True, True]
    assert "camera [init]" in stream.getvalue()


def test_quiet_is_silent_and_a_pipe_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with progress_reporter(quiet=True) as reporter:
        assert isinstance(reporter, SilentReporter)
    with progress_reporter(quiet=False) as reporter:
        assert isinstance(reporter, LineReporter)
