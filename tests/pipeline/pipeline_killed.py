"""Runs one pickled sequence several times in forked processes, each killed with SIGKILL at a given moment.

Usage: python pipeline_killed.py PICKLE FOLDER CASE [CASE ...], the pickle holding a sequence and a configuration.

A case is MOMENT:VALUE and runs into FOLDER/MOMENT-VALUE:
    write:N      killed after the N-th file has been written under its temporary name, before it is moved
    poll:N       killed when the pipeline asks for the N-th time whether it shall stop
    seconds:X    killed from outside after X seconds
One line "MOMENT-VALUE SIGNAL" is printed per case; SIGNAL is 0 if the run ended before its moment.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from pathlib import Path

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline import reconstruct


def kill_at_write(count: int) -> None:
    sync, done = os.fsync, 0

    def fsync(descriptor: int) -> None:
        nonlocal done
        done += 1
        if done == count:
            os.kill(os.getpid(), signal.SIGKILL)
        sync(descriptor)

    os.fsync = fsync


def run(sequence: Sequence, config: Config, folder: Path, moment: str, value: float) -> None:
    polls = 0

    def should_stop() -> bool:
        nonlocal polls
        polls += 1
        if moment == "poll" and polls == value:
            os.kill(os.getpid(), signal.SIGKILL)
        return False

    if moment == "write":
        kill_at_write(int(value))
    reconstruct(sequence, folder, config, should_stop=should_stop)


def run_and_kill(sequence: Sequence, config: Config, folder: Path, moment: str, value: float) -> int:
    """Return the number of the signal that ended the run, 0 if it ended by itself."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            run(sequence, config, folder, moment, value)
            status = 0
        finally:
            os._exit(status)
    if moment == "seconds":
        time.sleep(value)
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) != 0:
        raise RuntimeError(f"the run into {folder} failed")
    return os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0


if __name__ == "__main__":
    with open(sys.argv[1], "rb") as stream:
        loaded: tuple[Sequence, Config] = pickle.load(stream)
    for case in sys.argv[3:]:
        kind, number = case.split(":")
        name = f"{kind}-{number}"
        print(name, run_and_kill(*loaded, Path(sys.argv[2]) / name, kind, float(number)), flush=True)
