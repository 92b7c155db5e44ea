"""How well runs in windows, or frame by frame, agree with one graph over the whole video.

    python benchmarks/agreement.py SEQUENCE BATCH_RUN RUN [RUN ...]

Poses are relative to the first camera, as in the runs. A frame agrees where the twist between the two poses lies within
3 standard deviations by the run's own covariance: in every component, or jointly (the squared Mahalanobis distance of
six dimensions below 20.06, which holds the same 99.73 %). Runs with tracks of their own err apart from the batch: there
the difference spreads by the sum of both covariances, which is printed too. Printed as Markdown.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import se3_log
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.slam.reconstruction import Reconstruction

_JOINT_LIMIT = 20.06


def agreement(run: Reconstruction, batch: Reconstruction) -> dict[str, float]:
    """Return how far the poses of a run lie from those of the batch, by the run's covariance."""
    if run.pose_covariance is None:
        raise SystemExit("the run has no covariances")
    twist = se3_log(se3.inverse(batch.world_T_cam) @ run.world_T_cam)[1:]
    covariance = run.pose_covariance[1:]
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    within = np.abs(twist) < 3.0 * sigma
    both = (
        sigma
        if batch.pose_covariance is None
        else np.sqrt(np.einsum("nii->ni", covariance + batch.pose_covariance[1:]))
    )
    distance = np.einsum("ni,nij,nj->n", twist, np.linalg.inv(covariance), twist)
    return {
        "components within 3 sigma, %": 100.0 * float(within.mean()),
        "frames, every component, %": 100.0 * float(within.all(axis=1).mean()),
        "frames, every component, by the sum of both covariances, %": 100.0
        * float((np.abs(twist) < 3.0 * both).all(axis=1).mean()),
        "frames, jointly, %": 100.0 * float((distance < _JOINT_LIMIT).mean()),
        "distance / sigma of position, median": float(
            np.median(np.linalg.norm(twist[:, 3:], axis=1) / np.linalg.norm(sigma[:, 3:], axis=1))
        ),
        "sigma of the last position, mm": 1e3 * float(np.linalg.norm(sigma[-1, 3:])),
        "distance from the batch, largest, mm": 1e3 * float(np.linalg.norm(twist[:, 3:], axis=1).max()),
    }


def main() -> None:
    """Compare every run with the batch and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("batch", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    arguments = parser.parse_args()
    truth = read_sequence(arguments.sequence).ground_truth.world_T_cam
    if truth is None:
        raise SystemExit(f"{arguments.sequence} has no true poses")
    batch = load_reconstruction(arguments.batch / "reconstruction.npz")
    reference = evaluate_trajectory(batch.world_T_cam, truth)
    print(f"batch: ATE {1e3 * reference.ate_m:.2f} mm, scale {reference.scale:.3f}, fx {batch.intrinsics[0]:.1f} px")
    columns = []
    for folder in arguments.runs:
        run = load_reconstruction(folder / "reconstruction.npz")
        score = evaluate_trajectory(run.world_T_cam, truth)
        columns.append(
            {"ATE, mm": 1e3 * score.ate_m, "ATE / batch": score.ate_m / reference.ate_m}
            | {"scale (true / found)": score.scale, "fx, px": float(run.intrinsics[0])} | agreement(run, batch)
        )  # fmt: skip
    print("| | " + " | ".join(folder.name for folder in arguments.runs) + " |")
    print("|---|" + "---|" * len(columns))
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(f"{column[name]:.4g}" for column in columns) + " |")


if __name__ == "__main__":
    main()
