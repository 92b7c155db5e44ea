"""Recordings and synthetic scenes through a camera that zooms: what is found, and what it costs the cameras.

    UNI4D_FG_DATA=... python benchmarks/zoom.py [--clips kitchen kitchen_dog synthetic forward] [--last 1 1.6]

A clip is cropped about its principal point and enlarged, from 1 to the given zoom. Columns: whether a zoom was taken,
zoom found from the first frame to the last, error of the focal length in the worst frame (against that of the run
without zoom for recordings, 530 px, and the truth of synthetic scenes), absolute trajectory error, rotation error per
frame, seconds of the search.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from scenes import scene

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "slam" / "lens"))
from zooming import ramp, zoom_sequence

RECORDED_FOCAL = 530.0
"""What the run of kitchen without zoom finds, px: the recordings' own calibration is wrong."""


def clip(name: str, last: float) -> tuple[Sequence, np.ndarray]:
    """Return a clip that zooms from 1 to ``last``, and its true focal lengths (T,) px."""
    if name == "synthetic":
        sequence = scene("30x2000")
    elif name == "forward":
        sequence = make_synthetic_sequence(SyntheticSceneConfig(path="forward", render_images=False))
    else:
        sequence = read_sequence(Path(os.environ["UNI4D_FG_DATA"]) / name)
    known = sequence.ground_truth.intrinsics
    focal = RECORDED_FOCAL if name.startswith("kitchen") or known is None else float(known[0])
    ratio = ramp(sequence.num_frames, last)
    return sequence if last == 1.0 else zoom_sequence(sequence, ratio), focal * ratio


def main() -> None:
    """Print one row per clip and zoom."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="+", default=["kitchen", "kitchen_dog", "synthetic", "forward"])
    parser.add_argument("--last", nargs="+", type=float, default=[1.0, 1.6])
    options = parser.parse_args()
    config = load_config("default", ["output.clouds=false", "output.pictures=false"])
    print("| clip, zoom | taken | zoom found | focal length, worst frame | ATE, mm | rotation, deg | search, s |")
    print("|---|---|---|---|---|---|---|")
    for name in options.clips:
        for last in options.last:
            sequence, true = clip(name, last)
            with tempfile.TemporaryDirectory() as folder:
                summary = reconstruct(sequence, Path(folder), config)
                result = load_reconstruction(RunFolder(Path(folder)).reconstruction)
                path = evaluate_run(Path(folder), sequence).to_dict()["trajectory"]
            focal = result.frame_intrinsics[:, 0]
            worst = 100.0 * float(np.abs(focal / true - 1.0).max())
            print(
                f"| {name}, {last:g} | {'no' if result.zoom is None else 'yes'} | {focal[-1] / focal[0]:.3f} "
                f"| {worst:.1f} % | {1e3 * path['ate_m']:.2f} | {path['rpe_rotation_deg']:.4f} "
                f"| {summary.stages['lens']['seconds']:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
