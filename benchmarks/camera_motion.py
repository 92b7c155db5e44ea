"""How strong the prior on the camera's motion should be: fixed weights against the one estimated from the sequence.

    python benchmarks/camera_motion.py [--rates 10 15 30] [--seeds 0 1 2] [--frames 30]
    python benchmarks/camera_motion.py SEQ RUN [--folds 3]

The first form solves synthetic scenes and prints ATE as a part of the path. The second repeats bundle adjustment of a
recording that was reconstructed to RUN, judged by held-out tracks (see held_out.py) and by its true trajectory.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from held_out import judge

from uni4d_fg.config.cue_noise import CueNoise
from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.pipeline.steps import bundle_adjustment_step, camera_init_step
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder

OFF = ["bundle_adjustment.acceleration.linear=null", "bundle_adjustment.acceleration.angular=null"]


def relative_change(weight: float) -> list[str]:
    """Return the settings of the paper's term on the translation, with E_rot at 1."""
    path = "bundle_adjustment.camera_motion"
    return [*OFF, f"{path}.translation_weight={weight:g}", f"{path}.rotation_weight=1"]


def fixed(sigma: float) -> list[str]:
    """Return the settings of a given linear acceleration, m/s^2, its angular twin estimated."""
    return [f"bundle_adjustment.acceleration.linear={sigma:g}"]


SETTINGS: dict[str, list[str]] = {
    "none": OFF,
    **{f"relative change, weight {w:g}": relative_change(w) for w in (10, 100, 500, 2000)},
    **{f"acceleration {s:g} m/s^2": fixed(s) for s in (0.1, 0.3, 1.0)},
    "acceleration auto": [],
}


def labelled_scene(rate: float, seed: int, frames: int, noise: CueNoise) -> tuple[Sequence, LabelledTracks]:
    """Return a synthetic scene and its labels."""
    settings = SyntheticSceneConfig(num_frames=frames, frame_rate=rate, seed=seed, render_images=False, noise=noise)
    sequence, config = make_synthetic_sequence(settings), load_config()
    assert sequence.tracks is not None
    return sequence, label_tracks(sequence.tracks, sequence, config.labels, config.input)


def synthetic(rates: list[float], seeds: list[int], frames: int, noise: CueNoise) -> None:
    """Print one table: settings by scenes."""
    rows: dict[str, list[str]] = {name: [] for name in SETTINGS}
    for rate in rates:
        values: dict[str, list[tuple[float, float]]] = {name: [] for name in SETTINGS}
        for seed in seeds:
            sequence, labelled = labelled_scene(rate, seed, frames, noise)
            cameras = camera_init_step(sequence, labelled, load_config(), Hooks()).arrays
            truth = sequence.ground_truth.world_T_cam
            assert truth is not None
            path = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
            for name, settings in SETTINGS.items():
                found = bundle_adjustment_step(sequence, labelled, cameras, load_config(None, settings), Hooks())
                metrics = evaluate_trajectory(found.arrays["world_T_cam"], truth)
                values[name].append((100 * metrics.ate_m / path, metrics.rpe_rotation_deg))
        for name, of_seeds in values.items():
            ate, rotation = np.array(of_seeds).T
            each = " ".join(f"{value:.4f}" for value in ate)
            rows[name].append(f"{ate.mean():.4f} ({each}), {rotation.mean():.4f}")
    print("| prior | " + " | ".join(f"{rate:g} Hz: ATE % of path (seeds), RPE deg" for rate in rates) + " |")
    print("|---|" + "---|" * len(rates))
    for name, cells in rows.items():
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def recording(folder: Path, run: Path, folds: int, chosen: list[str]) -> None:
    """Print held-out errors and ATE of a recording."""
    sequence, labelled = read_sequence(folder), load_labels(RunFolder(run).labels)
    cameras = camera_init_step(sequence, labelled, load_config(), Hooks()).arrays
    truth = sequence.ground_truth.world_T_cam
    print("| prior | held-out error, px | ATE, mm | RPE, degrees | seconds |\n|---|---|---|---|---|")
    for name, settings in ((name, settings) for name, settings in SETTINGS.items() if name in chosen):
        config = load_config(None, settings)
        started = time.perf_counter()
        found = bundle_adjustment_step(sequence, labelled, cameras, config, Hooks())
        seconds = time.perf_counter() - started
        accuracy = "- | -"
        if truth is not None:
            metrics = evaluate_trajectory(found.arrays["world_T_cam"], truth)
            accuracy = f"{1e3 * metrics.ate_m:.2f} | {metrics.rpe_rotation_deg:.4f}"
        error = f"{judge(sequence, labelled, cameras, config, folds).error_px:.4f}" if folds else "-"
        print(f"| {name} | {error} | {accuracy} | {seconds:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path, nargs="?")
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--folds", type=int, default=3, help="parts of the image held out in turn; 0: none")
    parser.add_argument("--rates", nargs="+", type=float, default=[10.0, 15.0, 30.0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--exact", action="store_true", help="synthetic scenes without noise")
    parser.add_argument("--priors", nargs="+", default=list(SETTINGS), choices=list(SETTINGS), help="of a recording")
    arguments = parser.parse_args()
    if arguments.sequence is None:
        noise = CueNoise.none() if arguments.exact else CueNoise()
        synthetic(arguments.rates, arguments.seeds, arguments.frames, noise)
    else:
        recording(arguments.sequence, arguments.run, arguments.folds, arguments.priors)


if __name__ == "__main__":
    main()
