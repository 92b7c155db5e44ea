"""What each term of the non-rigid stage contributes, on the synthetic scene with default noise.

    python benchmarks/ablation.py [--seeds 3]

Runs the pipeline once per seed and preset, then repeats the non-rigid stage with one term switched off at a
time. Prints a Markdown table of means over the seeds. Point errors are RMSE in meters over the observed
points, after the Sim(3) alignment of the cameras; the first row is the raw depth cue lifted with the
estimated cameras, where every run starts.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import CueNoise, SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.track_model import TrackLabel
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.stages.lifting import lift
from uni4d_fg.slam.stages.observations import observations_of
from uni4d_fg.slam.stages.scene import Cameras

QUIET = ["output.clouds=false", "output.pictures=false"]
VARIANTS: dict[str, tuple[str, list[str]]] = {
    "`default`": ("default", []),
    "without E_NR": ("default", ["nonrigid.reprojection=false"]),
    "without ARAP": ("default", ["nonrigid.arap_weight=0"]),
    "without smoothness": ("default", ["nonrigid.smoothness_weight=0"]),
    "without the depth prior": ("default", ["nonrigid.depth_prior=false"]),
    "one depth scale per frame": ("default", ["nonrigid.local_scale_neighbors=0"]),
    "`paper`": ("paper", []),
}
COLUMNS = ("ATE, m", "points, m", "hidden points, m", "AbsRel moving", "AbsRel static")


def raw_lift_error(run_dir: Path, sequence: Sequence) -> float:
    """Return the RMSE of the lifted raw cue at the dynamic observations, m."""
    folder = RunFolder(run_dir)
    result, labelled = load_reconstruction(folder.reconstruction), load_labels(folder.labels)
    truth = sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.track_points is not None
    observations = observations_of(labelled, TrackLabel.DYNAMIC)
    cameras = Cameras(result.world_T_cam, result.intrinsics, np.zeros(result.num_frames))
    points = lift(observations, cameras)
    aligned = align_trajectories(result.world_T_cam, truth.world_T_cam).apply(points)
    error = np.linalg.norm(aligned - truth.track_points[observations.track, observations.frame], axis=1)
    return float(np.sqrt(np.nanmean(error**2)))


def figures(run_dir: Path, sequence: Sequence) -> list[float]:
    """Return one run's figures in the order of the columns."""
    report = evaluate_run(run_dir, sequence)
    assert report.trajectory is not None
    assert report.depth is not None
    assert report.dynamic_points is not None
    rmse = {metrics.protocol: metrics.rmse_m for metrics in report.dynamic_points if "Sim(3)" in metrics.protocol}
    observed, hidden = ([v for k, v in rmse.items() if word in k] for word in ("observed", "bridged"))
    regions = report.depth.metrics["scale"].regions
    values = [report.trajectory.ate_m, *observed[:1], *(hidden[:1] or [None])]
    values += [regions["dynamic"].abs_rel, regions["static"].abs_rel]
    return [float("nan") if value is None else value for value in values]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="noise seeds to average over")
    seeds = parser.parse_args().seeds
    rows: dict[str, list[list[float]]] = {}
    raw: list[float] = []
    for seed in range(seeds):
        sequence = make_synthetic_sequence(SyntheticSceneConfig(render_images=False, seed=seed, noise=CueNoise()))
        with tempfile.TemporaryDirectory() as root:
            for name, (preset, overrides) in VARIANTS.items():
                run_dir = Path(root) / preset
                reconstruct(sequence, run_dir, load_config(preset, [*overrides, *QUIET]), resume=True)
                rows.setdefault(name, []).append(figures(run_dir, sequence))
                if name == "`default`":
                    raw.append(raw_lift_error(run_dir, sequence))
    print(f"| mean of {seeds} seeds | {' | '.join(COLUMNS)} |")
    print("|---|" + "---|" * len(COLUMNS))
    print(f"| raw cue, lifted | | {np.mean(raw):.4f} | | | |")
    for name, values in rows.items():
        print(f"| {name} | " + " | ".join(f"{value:.4f}" for value in np.mean(values, axis=0)) + " |")


if __name__ == "__main__":
    main()
