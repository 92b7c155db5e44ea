"""A solved stage out to GTSAM: its optimizer, its marginals, a factor of GTSAM's own, and back."""

import tempfile

import gtsam
import numpy as np

import uni4d_fg as fg
from uni4d_fg.config.synthetic import SyntheticSceneConfig

POSE = fg.variables.POSE
scene = fg.make_synthetic_sequence(
    SyntheticSceneConfig(num_frames=8, width=200, height=150, focal=188.0, grid_columns=10, grid_rows=8)
)
with tempfile.TemporaryDirectory() as folder:
    fg.reconstruct(scene, folder, "fast", ["output.clouds=false"])
    stage = fg.stage_graphs(folder)["bundle_adjustment"]

graph, values = fg.to_gtsam(stage.problem, stage.final_state)
energy = graph.error(values)
ours = stage.problem.energy(stage.final_state)
print(f"{graph.size()} factors, {values.size()} variables, energy {energy:.6f}, ours {ours:.6f}")

marginals = gtsam.Marginals(graph, values)
sigma = np.sqrt(np.diag(marginals.marginalCovariance(POSE.key(7))))[3:]
print("sigma of the last camera's position, mm:", np.round(1e3 * sigma, 3))

step = values.atPose3(POSE.key(6)).between(values.atPose3(POSE.key(7)))
odometry = gtsam.BetweenFactorPose3(POSE.key(6), POSE.key(7), step, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3))
problem = stage.problem.add(odometry, state=stage.final_state)
state, summary = fg.solve(problem, stage.final_state)
print(f"with odometry: {summary.termination.value}; {[part['by'] for part in summary.notes['solved_by']]}")
print("back from GTSAM:", np.abs(stage.final_state.with_values(values)[POSE] - stage.final_state[POSE]).max())
