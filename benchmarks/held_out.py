"""How stiff the camera's motion should be, asked of the images: tracks that were held out judge the cameras.

    uni4d-fg reconstruct SEQ --out RUN
    python benchmarks/held_out.py SEQ RUN [--weights 0 100 500 2000 5000 20000] [--folds 3]

Bundle adjustment is repeated with several weights of E_cam's translation, each time without the static tracks that
start in a part of the image (every third cell of a 5 x 5 grid: neighboring tracks err alike and must not judge each
other). The tracks held out are then triangulated with the cameras frozen, and the mean of their reprojection errors
(each at most 5 px) says how well these cameras explain what they have not seen. Beside it stands ATE, where there is a
true trajectory.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optim.cluster_robust import image_cells
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.pipeline.steps import Arrays, bundle_adjustment_step, camera_init_step
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.stages.observations import observations_of

STATIC = (TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
CELLS = 5
LARGEST_ERROR_PX = 5.0


@dataclass(frozen=True)
class Judged:
    """What held-out tracks say of one weight."""

    error_px: float
    observations: int
    ate_m: float | None


def reprojection_errors(labelled: LabelledTracks, scene: Arrays) -> FloatArray:
    """Return the errors of all observations of the scene's landmarks, px."""
    seen = observations_of(labelled, *STATIC)
    seen = seen.select(np.isin(seen.track, scene["landmark_track"]))
    points = scene["landmarks"][np.searchsorted(scene["landmark_track"], seen.track)]
    x = world_to_camera(scene["world_T_cam"][seen.frame], points)
    result: FloatArray = np.linalg.norm(
        seen.uv - project(np.broadcast_to(scene["intrinsics"], (len(seen), 4)), x), axis=1
    )
    return result


def judge(sequence: Sequence, labelled: LabelledTracks, cameras: Arrays, config: Config, folds: int) -> Judged:
    """Hold out one part of the image after the other."""
    tracks = labelled.tracks
    first = np.argmax(tracks.visible, axis=1)
    start = np.nan_to_num(tracks.uv[np.arange(tracks.num_tracks), first])
    part = image_cells(start, sequence.intrinsics, CELLS) % folds
    static = np.isin(labelled.label, STATIC)
    frozen = load_config(None, ["input.poses=fixed", "input.intrinsics=fixed"])
    errors, ates = [], []
    for fold in range(folds):
        held_out = static & (part == fold)
        scene = bundle_adjustment_step(sequence, labelled.without(held_out), cameras, config, Hooks()).arrays
        kept = replace(sequence, intrinsics=scene["intrinsics"])
        judges = labelled.without(static & ~held_out)
        errors.append(reprojection_errors(judges, bundle_adjustment_step(kept, judges, scene, frozen, Hooks()).arrays))
        truth = sequence.ground_truth.world_T_cam
        if truth is not None:
            ates.append(evaluate_trajectory(scene["world_T_cam"], truth).ate_m)
    every = np.concatenate(errors)
    return Judged(float(np.minimum(every, LARGEST_ERROR_PX).mean()), len(every), float(np.mean(ates)) if ates else None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--weights", nargs="+", type=float, default=[0.0, 100.0, 500.0, 2000.0, 5000.0, 20000.0])
    parser.add_argument("--folds", type=int, default=3)
    arguments = parser.parse_args()
    sequence, labelled = read_sequence(arguments.sequence), load_labels(RunFolder(arguments.run).labels)
    cameras = camera_init_step(sequence, labelled, load_config(), Hooks()).arrays
    print("| weight | held-out error, px | observations | ATE, mm |\n|---|---|---|---|")
    for weight in arguments.weights:
        config = load_config(None, [f"bundle_adjustment.camera_motion.translation_weight={weight}"])
        found = judge(sequence, labelled, cameras, config, arguments.folds)
        ate = "-" if found.ate_m is None else f"{1e3 * found.ate_m:.2f}"
        print(f"| {weight:g} | {found.error_px:.4f} | {found.observations} | {ate} |", flush=True)


if __name__ == "__main__":
    main()
