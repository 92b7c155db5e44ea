"""A small scene whose depth cue is too large, and files that other sensors would have made of its camera."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import gtsam
import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.trajectory_files import write_tum
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.geometry.trajectory import Trajectory

CUE_TIMES = 1.3
PRECISE = ("measurements.odometry_sigma_m=0.001", "measurements.odometry_sigma_rad=0.001")


@functools.cache
def scene(num_frames: int = 12, times: float = CUE_TIMES) -> Sequence:
    """A synthetic sequence whose depth cue is ``times`` what it should be."""
    made = make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=num_frames, height=120, width=160, focal=150.0, margin_px=3.0, grid_columns=16, grid_rows=12,
            render_images=False,
        )
    )  # fmt: skip
    return dataclasses.replace(made, depths=ArrayFrames(np.stack(list(made.depths)) * np.float32(times)))


def settings(*overrides: str) -> Config:
    return load_config("default", ["output.clouds=false", "output.pictures=false", *PRECISE, *overrides])


def truth(sequence: Sequence) -> np.ndarray:
    poses = sequence.ground_truth.world_T_cam
    assert poses is not None
    return poses


def write_odometry(path: Path, sequence: Sequence) -> Path:
    """True odometry in a world of its own."""
    elsewhere = se3.se3_exp(np.array([0.2, -0.4, 0.1, 3.0, 4.0, 5.0]))
    write_tum(path, Trajectory(sequence.timestamps, elsewhere @ truth(sequence)))
    return path


def write_gps(path: Path, sequence: Sequence, sigma: float = 0.001) -> Path:
    """Noisy positions on a map."""
    map_T_world = se3.se3_exp(np.array([0.5, -1.4, 0.3, 30.0, -40.0, 5.0]))
    centers = (map_T_world @ truth(sequence))[:, :3, 3]
    noisy = centers + np.random.default_rng(3).normal(scale=sigma, size=centers.shape)
    rows = np.concatenate([sequence.timestamps[:, None], noisy, np.full((len(noisy), 1), sigma)], axis=1)
    np.savetxt(path, rows, delimiter=",", header="timestamp,x,y,z,sigma", comments="", fmt="%.9f")
    return path


def write_edges(path: Path, sequence: Sequence, pairs: list[tuple[int, int]], sigma: float = 1e-3) -> Path:
    """True relative poses."""
    graph, values, poses = gtsam.NonlinearFactorGraph(), gtsam.Values(), truth(sequence)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
    for i, j in pairs:
        graph.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(se3.inverse(poses[i]) @ poses[j]), noise))
    gtsam.writeG2o(graph, values, str(path))
    return path


def scale_error(world_T_cam: np.ndarray, sequence: Sequence) -> float:
    """Relative error of the scale of a path."""
    return abs(1.0 / align_trajectories(world_T_cam, truth(sequence)).scale - 1.0)
