"""What the joint energy changes after stages 1 to 3, on the synthetic scene with default noise.

    python benchmarks/joint_energy.py [--seeds 3] [--static-tracks 1.0 0.03]

A row is the mean over the seeds: the joint energy, errors after the cameras' Sim(3) alignment (points: RMSE of the
observed moving points), the focal length's error, iterations, seconds. "Stages" is where the joint solve starts. The
other rows have the sigma of temporal smoothness in the joint solve multiplied, or leave the term out.
``--static-tracks`` keeps only a part of the static tracks: with few of them, moving points have more of a say.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.pipeline.joint import joint_step
from uni4d_fg.pipeline.steps import Arrays, bundle_adjustment_step, camera_init_step, nonrigid_step

VARIANTS = {"joint": 1.0, "joint, smoothness 10 x looser": 10.0, "joint, without smoothness": 0.0}


def thinned(labelled: LabelledTracks, fraction: float) -> LabelledTracks:
    """Return the tracks with evenly spread static ones taken out."""
    static = np.flatnonzero(labelled.label != int(TrackLabel.DYNAMIC))
    kept = static[:: max(1, round(1.0 / fraction))]
    weight = labelled.weight.copy()
    weight[np.setdiff1d(static, kept)] = 0.0
    return replace(labelled, weight=weight)


def errors(sequence: Sequence, scene: Arrays, motion: Arrays) -> list[float]:
    """Return the ATE, m, the RMSE of moving points, m, and the error of the focal length, px."""
    truth = sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.track_points is not None
    assert truth.intrinsics is not None
    poses = scene["world_T_cam"]
    aligned = align_trajectories(poses, truth.world_T_cam)
    path = aligned.apply(poses[:, :3, 3]) - truth.world_T_cam[:, :3, 3]
    points = (aligned.apply(motion["points"]) - truth.track_points[motion["track"]])[motion["observed"]]
    focal = float(np.abs(scene["intrinsics"][:2] - truth.intrinsics[:2]).mean())
    return [float(np.sqrt(np.mean(np.sum(path**2, -1)))), float(np.sqrt(np.nanmean(np.sum(points**2, -1)))), focal]


def rows(seed: int, fraction: float) -> Iterator[tuple[str, list[float]]]:
    """Yield the figures of the stages and of every variant."""
    sequence = make_synthetic_sequence(SyntheticSceneConfig(seed=seed, render_images=False))
    config = load_config()
    assert sequence.tracks is not None
    labelled = thinned(label_tracks(sequence.tracks, sequence, config.labels, config.input), fraction)
    cameras = camera_init_step(sequence, labelled, config, Hooks()).arrays
    scene = bundle_adjustment_step(sequence, labelled, cameras, config, Hooks()).arrays
    motion = nonrigid_step(labelled, scene, config, Hooks()).arrays
    nan = float("nan")
    yield "stages", [nan, nan, *errors(sequence, scene, motion), nan, nan]
    for name, factor in VARIANTS.items():
        change = {"smoothness_sigma_m": factor * config.nonrigid.smoothness_sigma_m} if factor else {}
        change |= {} if factor else {"smoothness_weight": 0.0}
        changed = config.model_copy(update={"nonrigid": config.nonrigid.model_copy(update=change)})
        began = time.perf_counter()
        record = joint_step(sequence, labelled, scene, motion, changed, Hooks())
        seconds, solve = time.perf_counter() - began, record.summary["solves"][-1]
        energies = [solve["initial_energy"], solve["final_energy"]]
        found = errors(sequence, record.arrays, record.arrays)
        yield name, [*energies, *found, solve["num_iterations"], seconds]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--static-tracks", type=float, nargs="+", default=[1.0, 0.03])
    arguments = parser.parse_args()
    for fraction in arguments.static_tracks:
        print(f"\n{100 * fraction:.0f} % of the static tracks\n")
        print("| | energy, start -> end | ATE, mm | moving points, m | focal length, px | iterations | s |")
        print("|---|---|---|---|---|---|---|", flush=True)
        table: dict[str, list[list[float]]] = {}
        for seed in range(arguments.seeds):
            for name, figures in rows(seed, fraction):
                table.setdefault(name, []).append(figures)
        for name, figures in table.items():
            start, end, ate, points, focal, iterations, seconds = np.mean(figures, axis=0)
            work = "| | |" if np.isnan(start) else f"| {iterations:.0f} | {seconds:.1f} |"
            energy = "" if np.isnan(start) else f"{start:,.0f} -> {end:,.0f}"
            print(f"| {name} | {energy} | {1e3 * ate:.2f} | {points:.4f} | {focal:.2f} {work}", flush=True)


if __name__ == "__main__":
    main()
