"""What the surroundings of a process can be like: no output, no folder, odd names, early Ctrl-C, no memory."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from hostile import judged_verb

from uni4d_fg import optional
from uni4d_fg.cli.failures import known_error
from uni4d_fg.errors import Cancelled, InputError, OutputError

ENTRY = [sys.executable, "-m", "uni4d_fg"]


def run(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "timeout": 60, **options}
    return subprocess.run([*ENTRY, *map(str, words)], text=True, errors="replace", check=False, **options)


def test_a_full_standard_output() -> None:
    with open("/dev/full", "w") as full:
        done = run("config", stdout=full)
    assert done.returncode == OutputError.exit_code
    assert "standard output cannot be written (No space left on device)" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_reader_that_goes_away() -> None:
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m uni4d_fg config --all | head -n 1"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("closed", ["2>&-", ">&-", ">&- 2>&-", "<&-"])
def test_closed_streams(closed: str) -> None:
    command = f"{sys.executable} -m uni4d_fg config --set nosuch=1 {closed}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_a_working_directory_that_is_gone(tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    command = f"cd {tmp_path}/gone && rmdir {tmp_path}/gone && {sys.executable} -m uni4d_fg validate seq"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 3, done.stderr
    assert "working directory no longer exists" in done.stderr


def test_names_that_are_not_utf8(tmp_path: Path, sequence_folder: Path) -> None:
    name = os.fsdecode(b"caf\xe9")
    (tmp_path / name).symlink_to(sequence_folder)
    done = run("validate", tmp_path / name)
    assert done.returncode == 0, done.stderr
    assert run("validate", tmp_path / (name + "2")).returncode == 3


@pytest.mark.parametrize("seconds", [0.1, 0.25, 0.5, 0.8])
def test_ctrl_c_while_it_loads(seconds: float) -> None:
    process = subprocess.Popen([*ENTRY, "doctor"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    # The interpreter itself must have started: what it does before is not ours.
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    if seconds > 0.2:
        assert "Traceback" not in err
        assert process.returncode in (0, 130)


def test_little_memory_is_not_taken_for_a_missing_library(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> object:
        raise ImportError(f"lib{name}.so.1: failed to map segment from shared object")

    monkeypatch.setattr(optional.importlib, "import_module", fail)
    for load in (optional.import_open3d, optional.import_torch, optional.import_viser):
        with pytest.raises(MemoryError) as raised:
            load()
        found = known_error(raised.value)
        assert isinstance(found, InputError)
        assert "not enough memory" in str(found)


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (KeyboardInterrupt(), Cancelled),
        (MemoryError(), InputError),
        (BrokenPipeError(32, "Broken pipe"), OutputError),
        (PermissionError(13, "Permission denied", "/root/x"), InputError),
        (OSError(28, "No space left", "/x"), OutputError),
        (OSError(36, "File name too long", "x" * 300), InputError),
        (OSError(40, "Too many levels", "loop"), InputError),
        (OSError(24, "Too many open files", "x"), OutputError),
        (FileNotFoundError(2, "No such file"), InputError),
        ("\udcff".encode, InputError),
        (ZeroDivisionError(), type(None)),
    ],
)
def test_failures_of_the_system_are_known(error: Any, kind: type) -> None:
    if callable(error):
        try:
            error()
        except UnicodeEncodeError as raised:
            error = raised
    found = known_error(error)
    assert isinstance(found, kind)
    assert found is None or len(str(found)) < 300


def test_unreadable_folders(sequence_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path | str) -> Any:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "listdir", refuse)
    for verb in ("validate", "track"):
        code, out, err = judged_verb(verb, sequence_folder)
        assert code == 3
        assert "check its permissions" in out + err


def test_links_that_lead_in_a_circle_and_unknown_users(tmp_path: Path, sequence_folder: Path) -> None:
    (tmp_path / "loop.mp4").symlink_to(tmp_path / "loop.mp4")
    for verb in ("validate", "reconstruct", "stream", "track"):
        code, out, err = judged_verb(verb, tmp_path / "loop.mp4")
        assert code == 3
        assert "leads in a circle" in out + err
    for option in ("--masks", "--depth", "--depth-model", "--mask-model"):
        code, _, err = judged_verb(
            "reconstruct", sequence_folder, option, "~nosuchuser/x.yaml", "--out", tmp_path / "run"
        )
        assert code in (2, 3)
        assert "no such user" in err
    assert judged_verb("validate", tmp_path / ("x" * 300))[0] == 3


def test_compare_says_at_once_that_a_sequence_is_missing(sequence_folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    began = time.process_time()  # which a busy machine does not lengthen
    assert judged_verb("compare", sequence_folder, tmp_path / "nosuch", "--out", tmp_path / "out")[0] == 3
    assert time.process_time() - began < 15
    assert not (tmp_path / "out").exists()


def test_unfinished_cues_of_something_else(tmp_path: Path, sequence_folder: Path) -> None:
    (tmp_path / "out-unfinished").mkdir()
    (tmp_path / "out-unfinished" / "thesis.txt").write_text("mine")
    code, _, err = judged_verb("cues", sequence_folder / "rgb", "--out", tmp_path / "out")
    assert code == 6
    assert "holds something else" in err
    assert (tmp_path / "out-unfinished" / "thesis.txt").read_text() == "mine"
