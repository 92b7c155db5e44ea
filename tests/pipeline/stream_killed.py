"""Streams one pickled sequence in forked processes, one after the other, each of which kills itself with SIGKILL.

Usage: python stream_killed.py PICKLE FOLDER MOMENT [MOMENT ...], the pickle holding a sequence and a configuration,
and MOMENT ``frame:N`` (after the N-th frame of this process) or ``write:N`` (before the N-th file is moved to its
place). A process starts when a line arrives on standard input; the signal that ended it is printed, 0 if none did.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from pathlib import Path

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline.stream import stream_sequence


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def run(sequence: Sequence, config: Config, folder: Path, moment: str) -> None:
    kind, number = moment.split(":")
    left = int(number)
    sync = os.fsync

    def fsync(descriptor: int) -> None:
        nonlocal left
        left -= 1
        if left == 0:
            kill()
        sync(descriptor)

    def on_frame(_: object) -> None:
        nonlocal left
        left -= kind == "frame"
        if kind == "frame" and left == 0:
            kill()

    if kind == "write":
        os.fsync = fsync
    stream_sequence(sequence, folder, config, resume=True, on_frame=on_frame)


def main() -> None:
    with open(sys.argv[1], "rb") as stream:
        sequence, config = pickle.load(stream)
    for moment in sys.argv[3:]:
        sys.stdin.readline()
        child = os.fork()
        if child == 0:
            try:
                run(sequence, config, Path(sys.argv[2]), moment)
            finally:
                os._exit(0)
        _, status = os.waitpid(child, 0)
        print(os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0, flush=True)


if __name__ == "__main__":
    main()
