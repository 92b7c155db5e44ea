"""A video to cameras, points and motion: give a video file or a folder of images, or take a synthetic scene."""

import sys
import tempfile
from pathlib import Path

import numpy as np

import uni4d_fg as fg
from uni4d_fg.config.synthetic import SyntheticSceneConfig

if len(sys.argv) > 1:
    source, run = sys.argv[1], Path("runs/example")
else:
    source = fg.make_synthetic_sequence(SyntheticSceneConfig(num_frames=12, width=200, height=150, focal=188.0))
    run = Path(tempfile.mkdtemp())
result = fg.reconstruct(source, run, "fast", overwrite=True)
print(
    f"{len(result.world_T_cam)} cameras, {len(result.landmarks)} landmarks, {len(result.dynamic_points)} trajectories"
)
print("focal lengths, px:", np.round(result.intrinsics[:2], 1))
if len(sys.argv) == 1:
    print(f"ATE {1e3 * fg.evaluate_run(run, source).trajectory.ate_m:.2f} mm")
print(f"results: {run}; look at them with: uni4d-fg view {run}")
