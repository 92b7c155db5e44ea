"""What focal lengths that are a standard deviation off make of depth, against the depth that is then found."""

from __future__ import annotations

import numpy as np
import pytest
import stage_samples
from stage_samples import observe, static_observations

from uni4d_fg.config import Config
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, adjust_bundle, without_camera_motion, without_depth_prior
from uni4d_fg.slam.stages.scene import Cameras

FRAMES = 12


def arc(turn_deg: float, side_m: float) -> np.ndarray:
    """Poses (T, 4, 4) that move sideways and turn as evenly."""
    t = np.linspace(0.0, 1.0, FRAMES)
    poses = np.stack([se3.se3_exp(np.array([[0.0, np.radians(turn_deg) * share, 0, 0, 0, 0]]))[0] for share in t])
    poses[:, 0, 3], poses[:, 1, 3] = side_m * t, 0.1 * side_m * np.sin(5 * t)
    return poses


@pytest.mark.parametrize(
    ("turn_deg", "focal_sigma", "least", "most"), [(0.0, 0.02, 0.0, 0.001), (25.0, 0.005, 0.02, 0.2)]
)
def test_it_is_the_error_of_depth_that_such_focal_lengths_make(
    turn_deg: float, focal_sigma: float, least: float, most: float, rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Sideways motion leaves focal length and scale of depth to each other; a turn bends depth tens of times as far."""
    true_k = np.array([900.0, 900.0, 250.0, 150.0])
    monkeypatch.setattr(stage_samples, "K", true_k)
    poses = arc(turn_deg, 0.3)
    points = rng.uniform([-1.5, -1.0, 7.0], [4.0, 1.0, 20.0], size=(400, 3))
    observations = static_observations(observe(points, poses))
    config = without_camera_motion(without_depth_prior(Config().bundle_adjustment))
    patient = config.solver.model_copy(update={"relative_decrease": 1e-9, "max_iterations": 300})
    config = config.model_copy(update={"solver": patient, "structure": "keep"})
    longer = true_k * np.array([np.exp(focal_sigma)] * 2 + [1.0, 1.0])
    held = Freedom(poses=True, intrinsics=False)
    right, wrong = (
        adjust_bundle(
            observations, Cameras(poses, k, np.zeros(FRAMES)), k, config, held, focal_sigma=focal_sigma
        ) for k in (true_k, longer)
    )  # fmt: skip
    found = np.full((len(points), 3), np.nan)
    found[wrong.landmark_track] = wrong.landmarks
    z = [world_to_camera(p[observations.frame], x[observations.track])[:, 2]
         for p, x in ((wrong.cameras.world_T_cam, found), (poses, points))]  # fmt: skip
    off = np.log(z[0] / z[1])
    true_error = np.nanmean(np.abs(off - np.nanmedian(off)))
    assert least <= true_error <= most
    assert right.focal_depth_error == pytest.approx(true_error, rel=0.1, abs=1e-3)
    free, start = Freedom(poses=True, intrinsics=True), Cameras(poses, true_k, np.zeros(FRAMES))
    assert adjust_bundle(observations, start, true_k, config, free, focal_sigma=focal_sigma).focal_depth_error == 0
