"""Streams one pickled sequence in a process that kills itself with SIGKILL.

Usage: python stream_killed.py PICKLE FOLDER MOMENT, the pickle holding a sequence and a configuration, and MOMENT
``frame:N`` (after the N-th frame of this process) or ``write:N`` (before the N-th file is moved to its place).
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from pathlib import Path

from uni4d_fg.incremental.stream import stream_sequence


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def main() -> None:
    with open(sys.argv[1], "rb") as stream:
        sequence, config = pickle.load(stream)
    kind, number = sys.argv[3].split(":")
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
    stream_sequence(sequence, Path(sys.argv[2]), config, resume=True, on_frame=on_frame)


if __name__ == "__main__":
    main()
