"""Loop closing in windows: what it gains where a walk comes back, and that it closes nothing where none does.

    python benchmarks/loops.py [--frames 1000] [--laps 1.04] [--worlds room ...] [--seeds 1] [--window 100]

Synthetic walks of 160 x 120 px with tracks of 30 frames (`frontend/synthetic/circuit.py`). Cameras are solved in
windows once; their join is timed with closing and without. A pair of frames counts as wrong if the relative pose that
was believed is off by more than 10 cm or 3 degrees. Printed as Markdown.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic.circuit import circuit
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.optim.added_factors import with_additions
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.pipeline.store import StageStore
from uni4d_fg.pipeline.windowed import WindowedRun, scene_step
from uni4d_fg.progress import SilentReporter
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.loops.closing import LoopClosing
from uni4d_fg.slam.loops.links import Link
from uni4d_fg.slam.windows.plan import windows_of


def is_wrong(one: Link, truth: FloatArray) -> bool:
    """Tell whether the relative pose of a link is that of two other places."""
    real = se3.inverse(truth[one.first]) @ truth[one.second]
    twist = se3.se3_log((se3.inverse(one.first_T_second) @ real)[None])[0]
    return bool(np.linalg.norm(twist[:3]) > np.radians(3.0) or np.linalg.norm(twist[3:]) > 0.1)


def compared(sequence: Sequence, window: int, changes: list[str]) -> str:
    """Solve a walk with and without closing; return a row."""
    truth = sequence.ground_truth.world_T_cam
    assert sequence.tracks is not None
    assert truth is not None
    config = load_config(None, [f"windows.frames={window}", "windows.overlap=10", *changes])
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    closing = LoopClosing(sequence, PINHOLE, config.loops)
    ate, seconds = [], []
    with tempfile.TemporaryDirectory() as folder:
        for sources in ((), (closing,)):
            began = time.process_time()
            parts = WindowedRun(
                sequence, labelled, windows_of(config, sequence.num_frames), config, StageStore(Path(folder)), True,
                with_additions(stage_runner(config), sources), SilentReporter(), lambda: False,
            )  # fmt: skip
            found = scene_step(parts, "", Hooks())
            seconds.append(time.process_time() - began)
            ate.append(evaluate_trajectory(found.arrays["world_T_cam"], truth).ate_m)
    links = closing.links or []
    wrong = sum(is_wrong(one, truth) for one in links)
    return (
        f"{1e3 * ate[0]:.1f} mm | {1e3 * ate[1]:.1f} mm | {len(closing.loops())} | {len(links)} | {wrong} | "
        f"{len(closing.let_go)} | {closing.seconds:.1f} s of {seconds[0]:.1f} s |"
    )


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--laps", type=float, default=1.04)
    parser.add_argument("--worlds", nargs="+", default=["room"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--window", type=int, default=100)
    parser.add_argument("--set", nargs="*", default=[], help="changes of the configuration")
    arguments = parser.parse_args()
    print("| world | seed | ATE without | ATE with | loops | pairs | of them wrong | let go | time of the search |")
    print("|---|---|---|---|---|---|---|---|---|")
    for world in arguments.worlds:
        for seed in arguments.seeds:
            sequence = circuit(arguments.frames, arguments.laps, world=world, seed=seed)
            print(f"| {world} | {seed} | {compared(sequence, arguments.window, arguments.set)}", flush=True)


if __name__ == "__main__":
    main()
