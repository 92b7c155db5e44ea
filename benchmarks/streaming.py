"""Memory, time per frame and drift of incremental solving on an endless synthetic stream.

    python benchmarks/streaming.py [--frames 1000 3000] [--new-tracks 400] [--set FIELD=VALUE ...]

Every run is a process of its own. Frames (640 x 480, 400 new tracks every 10 frames, each at most 50 frames old; with
700 about 2,000 are alive) are made one by one and forgotten; results are handed to a counter that keeps the poses only.
Time is the processor time of ``add_frame`` alone, with tracks given, so that other work on the machine does not count;
the time of its parts is that of a clock. Memory is the resident size after each frame. Printed as Markdown.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.synthetic.hall import HallConfig, given_intrinsics, hall_frames, hall_poses
from uni4d_fg.slam.incremental import FinishedFrame, FrameTracks, IncrementalReconstructor, Landmarks


class Poses:
    """Results of which the poses are kept."""

    def __init__(self) -> None:
        self.poses: list[np.ndarray] = []

    def add(self, frames: tuple[FinishedFrame, ...], landmarks: tuple[Landmarks, ...]) -> None:
        """Keep the poses."""
        self.poses += [frame.world_T_cam for frame in frames]

    def frames(self) -> tuple[FinishedFrame, ...]:
        """Return nothing: nothing else is kept."""
        return ()

    def landmarks(self) -> tuple[Landmarks, ...]:
        """Return nothing."""
        return ()


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def measure(hall: HallConfig, overrides: list[str]) -> dict[str, float | dict[str, float]]:
    """Run one stream and return its figures."""
    results = Poses()
    solver = IncrementalReconstructor(
        given_intrinsics(hall), (hall.height, hall.width), load_config("default", overrides), results
    )
    seconds, memory, live = [], [], []
    parts: dict[str, float] = {}
    status: dict[str, int] = {}
    for frame in hall_frames(hall):
        began = time.process_time()
        update = solver.add_frame(frame.image, frame.depth, frame.mask, FrameTracks(frame.track, frame.uv))
        seconds.append(time.process_time() - began)
        memory.append(resident_mb())
        live.append(len(frame.track))
        status[update.status.value] = status.get(update.status.value, 0) + 1
        for part, value in update.seconds.items():
            parts[part] = parts.get(part, 0.0) + value / hall.num_frames
    solver.flush()
    truth = hall_poses(hall)
    found = np.stack(results.poses)
    first = truth[0]
    expected = np.linalg.inv(first) @ truth
    path = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    last = float(np.linalg.norm(found[-1, :3, 3] - expected[-1, :3, 3]))
    worst = float(np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1).max())
    return {
        "frames": hall.num_frames,
        "live tracks": float(np.mean(live)),
        "keyframes": status.get("keyframe", 0),
        "bridged": status.get("bridged", 0),
        "frames per second of processor time": len(seconds) / sum(seconds),
        "CPU ms per frame, 100-200": 1e3 * float(np.mean(seconds[100:200])),
        "CPU ms per frame, last 100": 1e3 * float(np.mean(seconds[-100:])),
        "MB, frame 100": memory[min(100, len(memory) - 1)],
        "MB, last 100 (largest)": max(memory[-100:]),
        "MB, frames 90-110 (largest)": max(memory[90:110] or [float("nan")]),
        "MB, peak": max(memory),
        "path, m": path,
        "end error, % of path": 100 * last / path,
        "largest error, % of path": 100 * worst / path,
        "focal length": float(solver.intrinsics[0]),
        "ms per part": {name: 1e3 * value for name, value in parts.items()},
    }


def main() -> None:
    """Measure every length in its own process and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 3000])
    parser.add_argument("--new-tracks", type=int, default=400, help="tracks started every 10 frames")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="FIELD=VALUE")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one is not None:
        hall = HallConfig(num_frames=arguments.one, new_tracks=arguments.new_tracks)
        print(json.dumps(measure(hall, arguments.overrides)))
        return
    columns = []
    for frames in arguments.frames:
        command = [sys.executable, __file__, "--one", str(frames), "--new-tracks", str(arguments.new_tracks)]
        command += [f"--set={change}" for change in arguments.overrides]
        columns.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    print("| | " + " | ".join(f"{column['frames']} frames" for column in columns) + " |")
    print("|---|" + "---|" * len(columns))
    for name in columns[0]:
        if name == "ms per part":
            for part in columns[0][name]:
                print(f"| ms per frame: {part} | " + " | ".join(f"{c[name].get(part, 0):.1f}" for c in columns) + " |")
        else:
            print(f"| {name} | " + " | ".join(f"{column[name]:.4g}" for column in columns) + " |")


if __name__ == "__main__":
    main()
