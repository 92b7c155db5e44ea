"""Odometry as GTSAM's own factors in bundle adjustment, the C++ solver still at work."""

import tempfile

import gtsam
import numpy as np

import uni4d_fg as fg
from uni4d_fg.config.synthetic import SyntheticSceneConfig

POSE = fg.variables.POSE
scene = fg.make_synthetic_sequence(SyntheticSceneConfig(num_frames=12, width=200, height=150, focal=188.0))
truth = [gtsam.Pose3(pose) for pose in scene.ground_truth.world_T_cam]
sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1e-3, 1e-3], 3))
odometry = [
    gtsam.BetweenFactorPose3(POSE.key(t), POSE.key(t + 1), truth[t].between(truth[t + 1]), sigmas) for t in range(11)
]


def join(stage, state):
    """Add the odometry to bundle adjustment."""
    return fg.Addition(odometry) if stage.finds_cameras else None


with tempfile.TemporaryDirectory() as folder:
    result = fg.reconstruct(scene, folder, "fast", ["output.clouds=false"], additions=[join])
    solved = fg.stage_graphs(folder)["bundle_adjustment"]
steps = [
    np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    for poses in (result.world_T_cam, scene.ground_truth.world_T_cam)
]
print("energy of the odometry:", round(solved.problem.energies(solved.final_state)["BetweenFactorPose3"], 3))
print(f"length of the path: {steps[0]:.4f} m, true {steps[1]:.4f} m")
