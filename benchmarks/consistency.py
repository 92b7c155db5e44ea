"""Whether covariances of the cameras are as large as their errors: NEES over synthetic seeds and recordings.

    python benchmarks/consistency.py [--seeds 8] [--frames 60] [--kinds batch stream windows] [--set FIELD=VALUE ...]
    python benchmarks/consistency.py --runs SEQUENCE BATCH_RUN RUN [RUN ...]

Means of NEES / 6 are 1 where covariances hold, above where they are too small. The first form makes small scenes with
noisy tracks, depth and focal length and solves each as a batch, in windows and as a stream. The second compares runs of
a recording: with its true poses, and with the batch run, by the sum of both covariances (tracks in common make that
difference smaller). With ``--truth-sigma RAD M`` the true poses err themselves. Printed as Markdown.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.pipeline.run import reconstruct
from uni4d_fg.results.evaluate.consistency import ConsistencyMetrics, evaluate_consistency
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.incremental import FrameTracks, IncrementalReconstructor
from uni4d_fg.slam.reconstruction import Reconstruction

_QUIET = ["output.pictures=false", "output.clouds=false", "bundle_adjustment.structure=keep", "shots.split=off"]
_HEAD = "| | mean NEES / 6 | by the median | rotations | positions | within 95 % | within 99 % | scale |"


def scene(seed: int, frames: int) -> Sequence:
    return make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=frames, grid_columns=24, grid_rows=18, render_images=False, objects="none", seed=seed
        )
    )


def streamed(sequence: Sequence, config: Config) -> Reconstruction:
    solver = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, config)
    tracks = sequence.tracks
    assert tracks is not None
    for t in range(sequence.num_frames):
        seen = np.flatnonzero(tracks.visible[:, t])
        solver.add_frame(
            sequence.images[t], sequence.depths[t], sequence.masks[t],
            FrameTracks(seen, tracks.uv[seen, t].astype(np.float64)), float(sequence.timestamps[t]),
        )  # fmt: skip
    return solver.finish()


def solved(kind: str, sequence: Sequence, changes: list[str]) -> Reconstruction:
    if kind == "stream":
        return streamed(sequence, load_config("default", changes))
    window = ["windows.frames=24", "windows.overlap=8"] if kind == "windows" else []
    with tempfile.TemporaryDirectory() as folder:
        reconstruct(sequence, Path(folder), load_config("default", [*_QUIET, *window, *changes]))
        return load_reconstruction(RunFolder(Path(folder)).reconstruction)


def line(name: str, found: list[ConsistencyMetrics]) -> str:
    fields = ("mean", "median", "rotation", "position")
    parts = [f"{np.mean([getattr(m, field) for m in found]):.2f}" for field in fields]
    parts += [f"{100 * np.mean([getattr(m, field) for m in found]):.0f} %" for field in ("within_95", "within_99")]
    return f"| {name} | " + " | ".join([*parts, f"{np.mean([m.scale for m in found]):.3f}"]) + " |"


def compared(
    run: Reconstruction, truth: FloatArray, covariance: FloatArray, sigma: tuple[float, float]
) -> list[ConsistencyMetrics]:
    """Return the metrics in both gauges."""
    both = [
        evaluate_consistency(run.world_T_cam, truth, covariance, with_scale=w, truth_sigma=sigma) for w in (False, True)
    ]
    return [one for one in both if one is not None]


def of_scenes(seeds: int, frames: int, kinds: list[str], changes: list[str]) -> None:
    print(_HEAD + "\n|---|" + "---|" * 7)
    for kind in kinds:
        rows = []
        for seed in range(seeds):
            sequence = scene(seed, frames)
            truth, run = sequence.ground_truth.world_T_cam, solved(kind, sequence, changes)
            assert truth is not None
            assert run.pose_covariance is not None
            rows.append(compared(run, truth, run.pose_covariance, (0.0, 0.0)))
        for name, metrics in zip(("first camera", "and scale"), zip(*rows, strict=True), strict=True):
            print(line(f"{kind}, {seeds} seeds, {name}", list(metrics)), flush=True)


def of_runs(paths: list[Path], sigma: tuple[float, float]) -> None:
    sequence, batch = read_sequence(paths[0]), load_reconstruction(RunFolder(paths[1]).reconstruction)
    print(_HEAD + "\n|---|" + "---|" * 7)
    for folder in paths[1:]:
        run = load_reconstruction(RunFolder(folder).reconstruction)
        if run.pose_covariance is None or batch.pose_covariance is None:
            raise SystemExit(f"{folder}: no covariances")
        truth = sequence.ground_truth.world_T_cam
        pairs = [] if truth is None else [("truth", truth, run.pose_covariance, sigma)]
        if folder != paths[1]:
            pairs.append(("batch", batch.world_T_cam, run.pose_covariance + batch.pose_covariance, (0.0, 0.0)))
        for name, poses, covariance, own in pairs:
            for gauge, metrics in zip(
                ("first camera", "and scale"), compared(run, poses, covariance, own), strict=True
            ):
                print(line(f"{folder.name}, from the {name}, {gauge}", [metrics]))


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--kinds", nargs="+", default=["batch", "windows", "stream"])
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="FIELD=VALUE")
    parser.add_argument("--runs", type=Path, nargs="+", help="sequence, batch run, and other runs")
    parser.add_argument("--truth-sigma", type=float, nargs=2, default=(0.0, 0.0), metavar=("RAD", "M"))
    arguments = parser.parse_args()
    if arguments.runs:
        of_runs(arguments.runs, tuple(arguments.truth_sigma))
    else:
        of_scenes(arguments.seeds, arguments.frames, arguments.kinds, arguments.changes)


if __name__ == "__main__":
    main()
