"""An energy term and a variable of one's own in bundle adjustment: positions measured on a map by an antenna."""

import tempfile

import numpy as np

import uni4d_fg as fg
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.factors.variable_types import pose_variable

MAP = pose_variable("map_T_world", "m", ("map",))


@fg.factor(MAP, fg.variables.POSE, data={"xyz": 3}, dim=3)
def antenna(map_T_world, world_T_cam, *, xyz):
    """Return where the camera is on the map, minus where the antenna says it is, m."""
    center = world_T_cam[..., :3, 3]
    return (map_T_world[..., :3, :3] @ center[..., None])[..., 0] + map_T_world[..., :3, 3] - xyz


scene = fg.make_synthetic_sequence(SyntheticSceneConfig(num_frames=12, width=200, height=150, focal=188.0))
true_centers = scene.ground_truth.world_T_cam[:, :3, 3]
measured = true_centers + np.random.default_rng(0).normal(scale=0.002, size=true_centers.shape)


def measurements(stage, state):
    """Join bundle adjustment; the map's pose starts at the identity."""
    if not stage.finds_cameras:
        return None
    return fg.Addition([antenna(0, np.arange(12), xyz=measured, sigma=0.002)], {MAP: np.eye(4)[None]})


length = np.linalg.norm(np.diff(true_centers, axis=0), axis=1).sum()
with tempfile.TemporaryDirectory() as folder:
    for name, additions in (("alone", []), ("with antenna", [measurements])):
        found = fg.reconstruct(scene, f"{folder}/{name}", "fast", ["output.clouds=false"], additions=additions)
        path = np.linalg.norm(np.diff(found.world_T_cam[:, :3, 3], axis=0), axis=1).sum()
        print(f"{name}: length of the path {100 * abs(path / length - 1.0):.2f} % off")
