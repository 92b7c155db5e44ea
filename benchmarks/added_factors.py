"""What a user's own factors cost in bundle adjustment with the C++ solver.

    python benchmarks/added_factors.py [--scene 60x8000] [--repeats 5]

Stage 2 of a synthetic scene, alone and with (a) a position prior per frame whose Jacobian is left to differences,
(b) a pose variable of its own with a factor per frame, (c) a ``gtsam.BetweenFactorPose3`` per pair of frames: in turns,
in one process. Times are of the processor (all threads), per iteration.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import median

import gtsam
import numpy as np
from scenes import SCENES, scene

from uni4d_fg.config.load import load_config
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import POSE, pose_variable
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.optim.added_factors import Addition, FactorSource, with_additions
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.optim.stage import Stage
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver

MAP = pose_variable("benchmark_map", "U", ("map",))


@factor(POSE, data={"xyz": 3}, dim=3)
def benchmark_position(world_T_cam, *, xyz):  # type: ignore[no-untyped-def]
    return world_T_cam[..., :3, 3] - xyz


@factor(MAP, POSE, data={"xyz": 3}, dim=3)
def benchmark_antenna(map_T_world, world_T_cam, *, xyz):  # type: ignore[no-untyped-def]
    center = world_T_cam[..., :3, 3]
    return (map_T_world[..., :3, :3] @ center[..., None])[..., 0] + map_T_world[..., :3, 3] - xyz


def sources(world_T_cam: np.ndarray) -> dict[str, list[FactorSource]]:
    """Return what joins, by name, from true poses (T, 4, 4) of which the first is the world."""
    centers, frames = world_T_cam[:, :3, 3], np.arange(len(world_T_cam))
    poses = [gtsam.Pose3(pose) for pose in world_T_cam]
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    between = [
        gtsam.BetweenFactorPose3(POSE.key(t), POSE.key(t + 1), poses[t].between(poses[t + 1]), noise)
        for t in range(len(poses) - 1)
    ]

    def only(addition: Addition) -> FactorSource:
        return lambda stage, state: addition if stage.kind == "bundle_adjustment" else None

    prior = only(Addition([benchmark_position(frames, xyz=centers, sigma=2e-3)]))
    own = only(Addition([benchmark_antenna(0, frames, xyz=centers, sigma=2e-3)], {MAP: np.eye(4)[None]}))
    native = only(Addition(between))
    return {"alone": [], "prior": [prior], "own variable": [own], "between": [native], "all": [prior, own, native]}


def main() -> None:
    """Print the time per iteration of each, and its ratio to the stage alone."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", choices=list(SCENES), default="60x8000")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    sequence = scene(options.scene)
    # As many iterations for all: what is added changes how soon a solve ends.
    config = load_config(
        "default",
        ["bundle_adjustment.solver.relative_decrease=1e-15", "bundle_adjustment.solver.max_iterations=8",
         "bundle_adjustment.structure=keep", "bundle_adjustment.covariance_cells=0"],
    )  # fmt: skip
    truth = sequence.ground_truth.world_T_cam
    assert sequence.tracks is not None
    assert truth is not None
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    run = stage_runner(config)
    start = StaticSceneSolver(config, run).initialize(labelled, sequence.intrinsics, free_intrinsics=True).cameras
    freedom = Freedom(poses=True, intrinsics=True)
    seconds: dict[str, list[float]] = {}
    for _ in range(options.repeats):
        for name, added in sources(np.linalg.inv(truth[0]) @ truth).items():
            spent = [0.0, 0]

            def timed(stage: Stage, state: State, hooks=None):  # type: ignore[no-untyped-def]
                began = time.process_time()
                solved, summary = run(stage, state, hooks)
                if stage.kind == "bundle_adjustment":
                    spent[0] += time.process_time() - began  # noqa: B023
                    spent[1] += len(summary.iterations)  # noqa: B023
                return solved, summary

            solver = StaticSceneSolver(config, with_additions(timed, added))
            solver.adjust(labelled, start, sequence.intrinsics, freedom)
            seconds.setdefault(name, []).append(spent[0] / spent[1])
    observations = int((labelled.weight > 0).sum())
    print(f"{options.scene}: {sequence.num_frames} frames, {observations} observations, {Path(__file__).name}")
    for name, values in seconds.items():
        ratio = median(value / alone for value, alone in zip(values, seconds["alone"], strict=True))
        print(f"{name:14s} {1e3 * median(values):8.1f} ms per iteration, {ratio:.3f} of the stage alone")


if __name__ == "__main__":
    main()
