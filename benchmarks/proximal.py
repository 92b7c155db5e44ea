"""Moving points of the paper's stage 3: the bare energy, its proximal term at several weights, and Adam.

    python benchmarks/proximal.py [--scenes 12x1500 30x2000] [--seeds 0] [--weights 0 0.1 1 10] [--sequence FOLDER ...]

Every variant starts from the same stages 1 and 2 of `--config paper`. Errors are of the points in the camera of their
frame against the scene's true ones, so that no alignment enters; of a sequence without true points, the median of
|log z - log truth| at their pixels. One thread each, Adam's too.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from scenes import SCENES, scene

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.assemble import as_sequence
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.optim.adam.runner import AdamRunner
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import run_stage
from uni4d_fg.optim.threads import thread_limit
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.compare.comparison import stage_arrays
from uni4d_fg.pipeline.steps import nonrigid_step
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder

QUIET = ["output.clouds=false", "output.pictures=false"]


def errors(sequence: Sequence, arrays: dict[str, np.ndarray], labelled: object, poses: np.ndarray) -> dict[str, float]:
    """Return RMSE and median of the points, mm, where they are known, and the median error of log depth."""
    truth, points, track = sequence.ground_truth, arrays["points"], arrays["track"]
    square, log_z = [], []
    for t in range(sequence.num_frames):
        here = world_to_camera(poses[t], points[:, t])
        seen = arrays["observed"][:, t] & np.isfinite(here).all(axis=1)
        if truth.track_points is not None and truth.world_T_cam is not None:
            there = world_to_camera(truth.world_T_cam[t], truth.track_points[track, t])
            seen &= np.isfinite(there).all(axis=1)
            square.append(((here - there)[seen] ** 2).sum(axis=1))
            z = there[seen, 2]
        else:
            u, v = np.round(labelled.tracks.uv[track[seen], t]).astype(int).T
            depth = truth.depths[t]
            z = depth[np.clip(v, 0, depth.shape[0] - 1), np.clip(u, 0, depth.shape[1] - 1)]
            z = np.where(z > 0, z, np.nan)
        log_z.append(np.log(np.maximum(here[seen, 2], 1e-3)) - np.log(z))
    found = {"log z": float(np.nanmedian(np.abs(np.concatenate(log_z))))}
    if square:
        all_of_them = np.concatenate(square)
        found |= {"rmse": 1e3 * float(np.sqrt(all_of_them.mean())), "median": 1e3 * float(np.median(all_of_them**0.5))}
    return found


def compare(name: str, sequence: Sequence, weights: list[float], folder: Path) -> None:
    config = load_config("paper", QUIET)
    reconstruct(sequence, folder, config)
    labelled = load_labels(RunFolder(folder).labels)
    start = stage_arrays(folder, "bundle_adjustment")
    variants = {f"LM, weight {weight:g}": (run_stage, weight) for weight in weights}
    for label, (runner, weight) in {**variants, "Adam": (AdamRunner(config.adam), 1.0)}.items():
        own = load_config("paper", [*QUIET, f"nonrigid.proximal_weight={weight}"])
        began = time.perf_counter()
        record = nonrigid_step(labelled, start, own, Hooks(), runner)
        seconds = time.perf_counter() - began
        found = errors(sequence, record.arrays, labelled, start["world_T_cam"])
        said = ", ".join(f"{what} {value:.4g}" for what, value in found.items())
        print(f"{name:12s} {label:16s} {seconds:7.2f} s  {said}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=["12x1500", "30x2000"])
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--weights", nargs="*", type=float, default=[0.0, 0.1, 1.0, 10.0])
    parser.add_argument("--sequence", nargs="*", type=Path, default=[])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, thread_limit(1):
        for name in arguments.scenes:
            for seed in arguments.seeds:
                compare(f"{name} {seed}", scene(name, seed), arguments.weights, Path(folder) / f"{name}-{seed}")
        for path in arguments.sequence:
            compare(path.name, as_sequence(open_video(path)), arguments.weights, Path(folder) / path.name)


if __name__ == "__main__":
    main()
