"""Inertial measurements on synthetic scenes: metric scale from a cue of unknown scale, and a blackout bridged.

    python benchmarks/imu.py [--seeds 0 1 2 ...] [--speed 0.84] [--frames 40] [--blackout 15 10] [--cue 1.7]

Every seed draws the noise of all cues and of the IMU anew. The scene is the default one (320 x 240 px at 15 Hz, tracks
with 0.5 px noise and 2 % outliers, depth with 4 % flicker, focal length 5 % off), its depth cue divided by an unknown
factor, and nothing is seen in the frames of the blackout: no track survives it. The IMU (200 Hz, the noise of EuRoC's,
biases of 0.05 m/s^2 and 0.005 rad/s per axis that walk) is 7 cm from the camera. Both reconstructions are whole runs;
the one without the IMU bridges the blackout by constant velocity.

Columns: error of the scale, of a similarity that aligns all camera centers to the truth; root mean square error of the
camera centers in the blackout and of those after it, cm, after an alignment on the frames before it (a rigid one with
the IMU, a similarity without it); the ratio of the two in the blackout; seconds of both runs. The program fails if a
scale is off by more than 1 % or a ratio is above a fifth.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.measurements.imu import NOISE_PRESETS, ImuSamples
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.synthetic.blackout import black_out
from uni4d_fg.frontend.synthetic.imu import simulate_imu
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import align_points
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder

BODY_T_CAM = se3.se3_exp(np.array([0.02, -0.01, 1.56, 0.05, 0.04, 0.03]))
MAX_SCALE_ERROR, MAX_RATIO = 0.01, 0.2
CHANGES = ("output.clouds=false", "output.pictures=false")


def make(seed: int, arguments: argparse.Namespace) -> tuple[Sequence, ImuSamples]:
    """Return a sequence with a blackout and a cue of unknown scale, and its IMU."""
    scene = make_synthetic_sequence(
        SyntheticSceneConfig(seed=seed, num_frames=arguments.frames, camera_speed=arguments.speed, render_images=False)
    )
    truth = scene.ground_truth.world_T_cam
    assert truth is not None
    imu = simulate_imu(scene.timestamps, truth, seed=seed, noise=NOISE_PRESETS["euroc"], body_T_cam=BODY_T_CAM)
    depths = ArrayFrames(np.stack(list(scene.depths)) / np.float32(arguments.cue))
    return black_out(replace(scene, depths=depths), *arguments.blackout), imu.samples


def solve(sequence: Sequence, imu: ImuSamples | None, changes: list[str]) -> np.ndarray:
    """Return the camera centers (T, 3) of a whole run."""
    with tempfile.TemporaryDirectory() as folder:
        reconstruct(sequence, Path(folder), load_config(overrides=[*CHANGES, *changes]), imu=imu)
        return load_reconstruction(RunFolder(Path(folder)).reconstruction).world_T_cam[:, :3, 3]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--speed", type=float, default=0.84, help="of the camera, m/s")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--blackout", type=int, nargs=2, default=[15, 10], metavar=("FIRST", "COUNT"))
    parser.add_argument("--cue", type=float, default=1.7, help="the depth cue times this is metric")
    parser.add_argument("--set", action="append", default=[], dest="changes", help="change of the configuration")
    arguments = parser.parse_args()
    first, count = arguments.blackout
    parts = {"blackout": slice(first, first + count), "after": slice(first + count, None)}
    print("| seed | scale, % | blackout, cm (IMU, without) | after, cm (IMU, without) | ratio | s |\n|" + "---|" * 6)
    failed, worst = 0, np.zeros(2)
    for seed in arguments.seeds:
        sequence, imu = make(seed, arguments)
        assert sequence.ground_truth.world_T_cam is not None
        truth, before = sequence.ground_truth.world_T_cam[:, :3, 3], slice(0, first)
        began = time.perf_counter()
        found = {True: solve(sequence, imu, arguments.changes), False: solve(sequence, None, arguments.changes)}
        seconds = time.perf_counter() - began
        errors = {}
        for with_imu, centers in found.items():
            moved = align_points(centers[before], truth[before], with_scale=not with_imu).apply(centers)
            distance = np.linalg.norm(moved - truth, axis=1)
            errors[with_imu] = {name: float(np.sqrt(np.mean(distance[part] ** 2))) for name, part in parts.items()}
        scale = 1.0 / align_points(found[True], truth, with_scale=True).scale - 1.0
        ratio = errors[True]["blackout"] / errors[False]["blackout"]
        worst = np.maximum(worst, [abs(scale), ratio])
        failed += abs(scale) > MAX_SCALE_ERROR or ratio > MAX_RATIO
        columns = [f"{100 * errors[True][name]:.2f}, {100 * errors[False][name]:.1f}" for name in parts]
        print(f"| {seed} | {100 * scale:+.2f} | {' | '.join(columns)} | {ratio:.3f} | {seconds:.0f} |", flush=True)
    print(f"\nlargest: scale {100 * worst[0]:.2f} %, ratio {worst[1]:.3f}; above a limit: {failed}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
