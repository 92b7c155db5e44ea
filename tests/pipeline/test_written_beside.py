"""Files written beside the run: in order, none after one that failed, and all of them when it ends."""

from __future__ import annotations

import threading

import pytest

from uni4d_fg.errors import OutputError
from uni4d_fg.pipeline.written_beside import WrittenBeside


def test_they_are_written_in_order_while_the_caller_goes_on() -> None:
    done: list[int] = []
    free = threading.Event()
    with WrittenBeside() as written:
        written.put(lambda: (free.wait(60), done.append(0))[1])
        for number in (1, 2, 3):
            written.put(lambda number=number: done.append(number))
        assert done == []  # the first still waits, and nothing waited for it
        free.set()
        written.wait()
        assert done == [0, 1, 2, 3]


def full() -> None:
    raise OutputError("no space left")


def test_nothing_is_written_after_what_failed_and_the_error_comes_out() -> None:
    done: list[int] = []

    def run() -> None:
        with WrittenBeside() as written:
            written.put(lambda: done.append(0))
            written.put(full)
            written.put(lambda: done.append(1))

    with pytest.raises(OutputError, match="no space left"):
        run()
    assert done == [0]


def test_the_next_hand_over_says_that_one_failed() -> None:
    written = WrittenBeside()
    written.put(full)
    with pytest.raises(OutputError, match="no space left"):
        written.wait()
    with pytest.raises(OutputError, match="no space left"):
        written.put(lambda: pytest.fail("a write was taken after one that failed"))
    written.__exit__(KeyError, KeyError(), None)  # what went wrong in the caller is not hidden


def test_an_interrupted_run_still_has_its_files() -> None:
    done: list[int] = []

    def run() -> None:
        with WrittenBeside() as written:
            written.put(lambda: done.append(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert done == [0]
