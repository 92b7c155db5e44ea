"""Frames in, one at a time; poses out, in bounded memory."""

import numpy as np

import uni4d_fg as fg
from uni4d_fg.config.synthetic import SyntheticSceneConfig

scene = fg.make_synthetic_sequence(SyntheticSceneConfig(num_frames=16, width=200, height=150, focal=188.0))
stream = fg.IncrementalReconstructor(scene.intrinsics, scene.image_size, fg.load_config("fast"))
for frame in range(scene.num_frames):
    update = stream.add_frame(scene.images[frame], scene.depths[frame], scene.masks[frame])
    print(f"frame {frame}: {update.status.value}")
result = stream.finish()
path = [
    np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    for poses in (result.world_T_cam, scene.ground_truth.world_T_cam)
]
print(f"{len(result.landmarks)} landmarks, path of {path[0]:.3f} m, true {path[1]:.3f} m")
