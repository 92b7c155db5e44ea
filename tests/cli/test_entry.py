"""How the process of the command line ends."""

from __future__ import annotations

import os
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


def test_opencv_threads_do_not_wait_in_loops_unless_the_user_says_so() -> None:
    ask = (
        "import os, sys; sys.argv = ['uni4d-fg', '--version']\n"
        "import atexit; name = 'OPENCV_THREAD_POOL_ACTIVE_WAIT_'\n"
        "atexit.register(lambda: print(os.environ[name + 'MAIN'], os.environ[name + 'WORKER']))\n"
        "from uni4d_fg.cli.entry import main\nmain()"
    )
    own = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV_THREAD_POOL")}
    for given, expected in (({}, "0 0"), ({"OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN": "500"}, "500 0")):
        done = subprocess.run([sys.executable, "-c", ask], env=own | given, capture_output=True, text=True, check=False)
        assert done.stdout.splitlines()[-1] == expected
