"""How the process of the command line ends."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import atexit, gc, sys
atexit.register(lambda: print("frozen:", gc.get_freeze_count() > 10_000))
sys.argv = ["uni4d-fg", {word!r}]
from uni4d_fg.cli.entry import main
main()
"""


@pytest.mark.parametrize(("word", "code"), [("--version", 0), ("no-such-verb", 2)])
def test_nothing_is_searched_for_cycles_any_more(word: str, code: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(word=word)], capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[-1] == "frozen: True"
    assert done.returncode == code
