"""Recordings and synthetic scenes seen through a lens: what is found, and what it costs the cameras.

    UNI4D_FG_DATA=... python benchmarks/lens.py [--clips kitchen kitchen_dog synthetic] [--k1 0 -0.12 -0.25]

A recording is warped as a camera with radial distortion k1 would have seen it; its intrinsics are given as wrong as
before. Columns: camera model chosen, k1 found, error of the focal length (against that of the unwarped run for
recordings), absolute trajectory error, rotation error per frame, seconds of the search for the lens.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scenes import scene

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "slam" / "lens"))
from warping import warp_sequence

TRUE_FOCAL = {"kitchen": 530.0, "kitchen_dog": 530.0}
"""What the runs without a lens find, px: the recordings' own calibration is wrong."""


def clip(name: str, k1: float) -> Sequence:
    """Return a clip as seen through a lens."""
    if name == "synthetic":
        sequence = scene("30x2000")
        pinhole = sequence.ground_truth.intrinsics
        assert pinhole is not None
    else:
        sequence = read_sequence(Path(os.environ["UNI4D_FG_DATA"]) / name)
        focal = TRUE_FOCAL[name]
        pinhole = np.array([focal, focal, *sequence.intrinsics[2:]])
        truth = replace(sequence.ground_truth, intrinsics=pinhole)
        sequence = replace(sequence, ground_truth=truth)
    error = sequence.intrinsics[0] / pinhole[0] - 1.0
    return sequence if k1 == 0.0 else warp_sequence(sequence, pinhole, Lens("SIMPLE_RADIAL", (k1,)), error)


def main() -> None:
    """Print one row per clip and distortion."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="+", default=["kitchen", "kitchen_dog", "synthetic"])
    parser.add_argument("--k1", nargs="+", type=float, default=[0.0, -0.12, -0.25])
    options = parser.parse_args()
    config = load_config("default", ["output.clouds=false", "output.pictures=false"])
    print("| clip, k1 | model | k1 found | focal length | ATE, mm | rotation, deg | search, s |")
    print("|---|---|---|---|---|---|---|")
    for name in options.clips:
        for k1 in options.k1:
            sequence = clip(name, k1)
            with tempfile.TemporaryDirectory() as folder:
                summary = reconstruct(sequence, Path(folder), config)
                result = load_reconstruction(RunFolder(Path(folder)).reconstruction)
                path = evaluate_run(Path(folder), sequence).to_dict()["trajectory"]
            true = sequence.ground_truth.intrinsics
            assert true is not None
            found = result.lens.parameters[0] if result.lens.parameters else 0.0
            focal, seconds = 100 * (result.intrinsics[0] / true[0] - 1), summary.stages["lens"]["seconds"]
            print(
                f"| {name}, {k1:g} | {result.lens.model} | {found:.3f} | {focal:+.1f} % | {1e3 * path['ate_m']:.2f} "
                f"| {path['rpe_rotation_deg']:.4f} | {seconds:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
