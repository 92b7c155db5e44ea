"""What hostile input is made of, and how what becomes of it is judged."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from uni4d_fg.cli import main
from uni4d_fg.errors import Uni4dFgError

TINY_SCENE: dict[str, Any] = {
    "num_frames": 6,
    "height": 60,
    "width": 80,
    "focal": 75.0,
    "margin_px": 3.0,
    "grid_columns": 14,
    "grid_rows": 10,
    "query_interval": 4,
}

SECONDS = 20
"""A case that computes longer hangs, and so does one that waits for ten times as long: the machine may be busy."""
MEGABYTES = 1024
"""One case may take so much at its peak, and all together may leave so much behind."""

KNOWN_CODES = {0, 1, 2, 3, 4, 5, 6, 7, 130}


def _resident(field: str) -> float:
    """Return VmRSS, what the process holds, or VmHWM, its peak since :func:`_forget_peak`, in MB; 0 where unknown."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(field)), 0.0)


def _forget_peak() -> bool:
    """Let the peak count from here; tells whether the system does that."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


_start_megabytes = _resident("VmRSS")


class Hung(BaseException):
    """A case did not end; not an Exception, so that nothing takes it for one of its own."""


@contextlib.contextmanager
def watched() -> Iterator[None]:
    """Fail if the block takes too long or too much memory."""

    def ring(number: int, _: object) -> None:
        raise Hung(f"did not end within {SECONDS} s" if number == signal.SIGPROF else f"waited {10 * SECONDS} s")

    held, has_peak = _resident("VmRSS"), _forget_peak()
    before = {number: signal.signal(number, ring) for number in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.alarm(10 * SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        for number, handler in before.items():
            signal.signal(number, handler)
    peak, left = _resident("VmHWM") - held, _resident("VmRSS") - _start_megabytes
    assert not has_peak or peak < MEGABYTES, f"took {peak:.0f} MB"
    assert left < MEGABYTES, f"{left:.0f} MB more than at the start are still held"


def judged(action: Any, *arguments: Any, **named: Any) -> Any:
    """Call a function: it returns, or raises one clear error of the package. The error is returned then."""
    with watched():
        try:
            return action(*arguments, **named)
        except Uni4dFgError as error:
            assert_clear(str(error))
            return error


def judged_verb(*words: object) -> tuple[int, str, str]:
    """Run a command line in this process; judge its exit code and what it says."""
    out, err = io.StringIO(), io.StringIO()
    with watched(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.run([str(word) for word in words])
    said = err.getvalue()
    assert code in KNOWN_CODES, (code, said[-2000:])
    assert "Traceback" not in said
    assert "please report this" not in said
    if code not in (0, 2, 3):  # validate says what it finds on standard output
        assert said.strip()
    return code, out.getvalue(), said


def assert_clear(message: str) -> None:
    """Assert that a message is one that a user can do something with."""
    assert message.strip()
    assert "Traceback" not in message
    assert len(message) < 4000
    assert not re.search(r"\bobject at 0x[0-9a-f]+", message)


def state_of(folder: Path) -> dict[str, bytes]:
    """The files in a folder, to see that none was harmed."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


SCALARS: st.SearchStrategy[Any] = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 300),
    st.sampled_from([2**31, 2**40, 2**63, 2**64, -(2**63), 10**30]),
    st.floats(allow_nan=False),
    st.text(max_size=8),
    st.sampled_from(
        ["../../etc/passwd", "/dev/zero", "~nosuchuser/x", "x" * 300, "\x00", "<script>", "\udcff", "1e999"]
    ),
)

JSON = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=8,
)


@st.composite
def changed_json(draw: st.DrawFn, value: Any) -> Any:
    """A JSON value with one to three of its parts replaced, removed, doubled or given another type."""
    value = json.loads(json.dumps(value))
    for _ in range(draw(st.integers(1, 3))):
        places = list(_places(value))
        if not places:
            return draw(JSON)
        holder, key = draw(st.sampled_from(places))
        kind = draw(st.sampled_from(["replace", "remove", "nest", "add", "null"]))
        if kind == "remove":
            del holder[key]
        elif kind == "nest":
            holder[key] = [holder[key]]
        elif kind == "add" and isinstance(holder, dict):
            holder[draw(st.text(max_size=6))] = draw(JSON)
        else:
            holder[key] = None if kind == "null" else draw(JSON)
    return value


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield value, key
        yield from _places(item)


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes with some flipped, cut, doubled, inserted or replaced."""
    changed = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        if not changed:
            break
        # Headers are where most is decided.
        end = draw(st.sampled_from([min(len(changed), 128), len(changed)]))
        place = draw(st.integers(0, end - 1))
        kind = draw(st.sampled_from(["flip", "set", "cut", "insert", "double", "long"]))
        if kind == "flip":
            changed[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "set":
            changed[place] = draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]))
        elif kind == "cut":
            del changed[place:]
        elif kind == "insert":
            changed[place:place] = draw(st.binary(max_size=9))
        elif kind == "double":
            changed[place:place] = changed[place : place + 32]
        else:
            changed[place : place + 4] = b"\xff\xff\xff\x7f"
    return bytes(changed)


@st.composite
def changed_array(draw: st.DrawFn, array: np.ndarray) -> np.ndarray:
    """An array of other values, another type or another shape."""
    kind = draw(st.sampled_from(["value", "all", "type", "cut", "flat", "empty", "more"]))
    value = draw(st.sampled_from([np.nan, np.inf, -1.0, 0.0, 1e300, 1e-300, 2.0**40]))
    with np.errstate(all="ignore"):
        if kind == "value" and array.size:
            array = array.copy()
            array.reshape(-1)[draw(st.integers(0, array.size - 1))] = np.asarray(value).astype(array.dtype)
        elif kind == "all":
            array = np.full_like(array, np.asarray(value).astype(array.dtype))
        elif kind == "type":
            array = array.astype(draw(st.sampled_from(["i8", "f2", "u1", "c16", "?", "U3"])))
        elif kind == "cut" and array.ndim:
            array = array[:-1]
        elif kind == "flat":
            array = array.reshape(-1)
        elif kind == "more":
            array = array[None]
        else:
            array = array[:0] if array.ndim else np.zeros((0,), array.dtype)
    return array


def special_files(folder: Path) -> list[Path]:
    """What is there in place of a file, none of which may be opened as one."""
    pipe, loop, nowhere, plug = (folder / name for name in ("pipe", "loop", "nowhere", "plug"))
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    nowhere.symlink_to(folder / "absent")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(plug))
    return [pipe, loop, nowhere, plug, Path("/dev/zero"), Path("/dev/null"), folder]
