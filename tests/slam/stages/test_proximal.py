"""The proximal term of the paper's stage 3: what it costs, what it holds, and who goes without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stage_samples import K, camera_path, observe, static_observations, static_points

from uni4d_fg.config.load import load_config
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.config.stages import NonRigidConfig
from uni4d_fg.errors import ConfigError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.geometry.camera import camera_to_world, world_to_camera
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage
from uni4d_fg.slam.stages.energy import PaperEnergy
from uni4d_fg.slam.stages.proximal import LiftNoise, lift_noise, proximal_term
from uni4d_fg.slam.stages.scene import Cameras

FRAMES, TRACKS = 8, 60


def weighed(weight: float) -> NonRigidConfig:
    return NonRigidConfig(proximal_weight=weight)


@pytest.fixture
def cameras() -> Cameras:
    return Cameras(camera_path(FRAMES), K, np.linspace(-0.1, 0.1, FRAMES))


@pytest.mark.parametrize("normalization", ["mean", "sum"])
def test_its_value_is_the_weighed_mean_of_the_departure_in_sigmas(
    cameras: Cameras, rng: np.random.Generator, normalization: str
) -> None:
    landmarks = static_points(rng, TRACKS)
    observations = static_observations(observe(landmarks, cameras.world_T_cam))
    weight = rng.uniform(0.2, 1.0, len(observations))
    depth = observations.depth * np.exp(-cameras.log_scale[observations.frame])
    depth[::7] = np.nan  # the cue has holes
    observations = replace(observations, weight=weight, depth=depth)
    rows = np.arange(len(observations))
    local = world_to_camera(cameras.world_T_cam[observations.frame], landmarks[observations.rows()[1]])
    stretch = np.exp(rng.normal(scale=0.1, size=len(rows)))
    points = camera_to_world(cameras.world_T_cam[observations.frame], local * stretch[:, None])
    noise = LiftNoise(cameras.log_scale, 0.05)
    energy = PaperEnergy(normalization)  # type: ignore[arg-type]
    term = proximal_term(observations, rows, cameras, noise, weighed(3.0), energy)
    known = np.isfinite(depth)
    sigmas = np.abs(np.log(stretch) / 0.05)
    square = weight * np.where(sigmas <= 1.345, 0.5 * sigmas**2, 1.345 * (sigmas - 0.5 * 1.345))
    assert (sigmas > 1.345).any()
    if normalization == "mean":
        frames = [
            square[known & (observations.frame == t)].sum() / weight[known & (observations.frame == t)].sum()
            for t in range(FRAMES)
        ]
        expected = 3.0 * np.mean(frames)
    else:
        expected = 3.0 * square[known].sum()
    assert sum(Problem((term,)).energies(State({DYNAMIC_POINT: points})).values()) == pytest.approx(
        expected, rel=1e-6
    )  # the depth is float32
    at_lift = camera_to_world(cameras.world_T_cam[observations.frame], local)
    assert sum(Problem((term,)).energies(State({DYNAMIC_POINT: at_lift})).values()) < 1e-9


def test_the_noise_of_the_lift_is_measured_whatever_the_outliers(cameras: Cameras, rng: np.random.Generator) -> None:
    landmarks = static_points(rng, 400)
    observations = static_observations(observe(landmarks, cameras.world_T_cam))
    noise = rng.normal(scale=0.03, size=len(observations))
    noise[rng.random(len(noise)) < 0.05] += 1.0
    depth = observations.depth * np.exp(noise - cameras.log_scale[observations.frame])
    observations = replace(observations, depth=depth)
    of_observation = landmarks[observations.rows()[1]]
    found = lift_noise(observations, of_observation, cameras)
    assert found is not None
    assert found.sigma == pytest.approx(0.03, rel=0.1)
    np.testing.assert_allclose(found.log_scale, cameras.log_scale, atol=0.008)  # of some 300 points each, 5 % wrong
    unseen = observations.select(observations.frame != 3)
    there = lift_noise(unseen, landmarks[observations.rows()[1]][observations.frame != 3], cameras)
    assert there is not None
    assert there.log_scale[3] == 0.0
    nothing = replace(observations, depth=np.full(len(depth), np.nan))
    assert lift_noise(nothing, of_observation, cameras) is None


def test_a_stage_without_its_bounds_is_the_bare_energy(cameras: Cameras, rng: np.random.Generator) -> None:
    observations = static_observations(observe(static_points(rng, TRACKS), cameras.world_T_cam))
    noise = LiftNoise(cameras.log_scale, 0.05)
    term = proximal_term(observations, np.arange(len(observations)), cameras, noise, weighed(1.0), PaperEnergy())
    exact = SolverConfig(cg_tolerance=1e-3)
    stage = Stage("nonrigid", Problem((term,)), SolverConfig(), bounds=frozenset({term.name}), unbounded_solver=exact)
    assert stage.unbounded().problem.batches == ()
    assert stage.unbounded().solver == exact
    assert stage.unbounded().unbounded() == stage.unbounded()
    assert len(stage.problem.batches) == 1


def test_it_belongs_to_the_energy_of_the_paper() -> None:
    assert load_config("paper").nonrigid.proximal_weight == 1.0
    assert load_config("default").nonrigid.proximal_weight == 0.0
    with pytest.raises(ConfigError, match=r"contradicts nonrigid\.proximal_weight"):
        load_config("default", ["nonrigid.proximal_weight=1"])
