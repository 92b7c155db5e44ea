"""The joint energy: what it holds, where it ends, and that it neither rises nor collapses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from stage_samples import K, camera_path, observe, static_observations, static_points

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, LOG_SCALE, POSE
from uni4d_fg.frontend.track_model import TrackLabel
from uni4d_fg.geometry import se3
from uni4d_fg.optim import backend
from uni4d_fg.optim.block import BlockObjective
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.stages.acceleration import AccelerationPrior
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.joint import MovingCues, joint_problem, joint_state, mesh_of, solve_joint
from uni4d_fg.slam.stages.observations import observations_of
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise, StaticScene, unknown_covariances

FRAMES, LANDMARKS, SIDE = 7, 60, 4
FREE, HELD = Freedom(poses=True, intrinsics=True), Freedom(poses=True, intrinsics=False)
TIGHT = SolverConfig(max_iterations=60, relative_decrease=1e-13, gradient_tolerance=1e-9)


@dataclasses.dataclass(frozen=True)
class Sample:
    """A scene with its truth, at a start that is off."""

    poses: np.ndarray
    landmarks: np.ndarray
    points: np.ndarray
    static: StaticScene
    motion: DynamicScene
    moving: MovingCues


def sample(noise_px: float = 0.0, seed: int = 0) -> Sample:
    """Sixty landmarks and a patch at constant velocity; the start is off by centimeters, but in its first frame."""
    rng = np.random.default_rng(seed)
    poses, landmarks = camera_path(FRAMES), static_points(rng, LANDMARKS)
    x, y = (grid.ravel() for grid in np.meshgrid(*2 * [np.linspace(-0.3, 0.3, SIDE)]))
    first = np.stack([x, y, np.full(len(x), 3.0)], axis=1)
    points = first[:, None] + np.arange(FRAMES)[:, None] * np.array([0.03, 0.0, 0.015])
    still, dynamic = observe(landmarks, poses), observe(points, poses, TrackLabel.DYNAMIC, instance=1)

    def noisy(observations):  # type: ignore[no-untyped-def]
        return dataclasses.replace(
            observations, uv=observations.uv + rng.normal(scale=noise_px or 1e-12, size=observations.uv.shape)
        )

    off = rng.normal(scale=0.004, size=(FRAMES, 6))
    off[0] = 0.0
    static = StaticScene(
        Cameras(se3.retract(poses, off), K.copy(), np.zeros(FRAMES)),
        landmarks + rng.normal(scale=0.02, size=landmarks.shape),
        np.arange(LANDMARKS),
        noisy(static_observations(still)),
        StaticNoise(noise_px or 0.5, 0.02),
        np.zeros(LANDMARKS, np.float32),
        *unknown_covariances(FRAMES),
    )
    start = points + rng.normal(scale=0.02, size=points.shape)
    count = len(points)
    motion = DynamicScene(start, np.ones((count, FRAMES), bool), np.arange(count), np.ones(count, np.int64))
    moving = MovingCues(noisy(observations_of(dynamic, TrackLabel.DYNAMIC)), StaticNoise(noise_px or 0.5, 0.02))
    return Sample(poses, landmarks, points, static, motion, moving)


def configured(*changes: str) -> Config:
    """Every observation is kept; landmarks are not refined."""
    keep = ["bundle_adjustment.max_reprojection_px=100", "bundle_adjustment.structure=keep"]
    config = load_config("default", [*keep, *changes])
    return config.model_copy(update={"joint": config.joint.model_copy(update={"solver": TIGHT})})


CONFIG = configured()


def problem_of(data: Sample, config: Config = CONFIG, freedom: Freedom = FREE) -> tuple[Problem, State]:
    mesh = mesh_of(data.motion, config)
    state = joint_state(data.static, data.motion, mesh)
    return joint_problem(state, data.static, mesh, data.moving, config, K[None], freedom), state


def test_it_holds_the_terms_of_both_stages_and_everything_but_the_gauge_is_free() -> None:
    data = sample()
    prior = AccelerationPrior(np.arange(FRAMES, dtype=np.float64), 1.0, 1.0)
    problem, state = problem_of(dataclasses.replace(data, static=dataclasses.replace(data.static, acceleration=prior)))
    names = {batch.name for batch in problem.batches}
    assert names >= {"static_reprojection", "dynamic_reprojection", "depth_prior", "arap", "smoothness"}
    assert names >= {"camera_angular_acceleration", "camera_linear_acceleration"}
    assert all(POSE in [s.variable for s in b.slots] for b in problem.batches if b.name == "dynamic_reprojection")
    free = {variable.name: int(mask.sum()) for variable, mask in problem.free.items()}
    points = SIDE * SIDE * FRAMES
    assert free == {"pose": 6 * (FRAMES - 1), "intrinsics": 2, "landmark": 3 * LANDMARKS, "dynamic_point": 3 * points}
    assert not problem.is_free(LOG_SCALE)
    graph, values = to_gtsam(problem, state)
    assert graph.error(values) == pytest.approx(problem.energy(state), rel=1e-9)


def test_from_exact_cues_it_finds_the_truth() -> None:
    data, config = sample(), configured("bundle_adjustment.trim_sigmas=null")
    static, motion = solve_joint(data.static, data.motion, data.moving, config, K, FREE)
    assert np.abs(data.static.cameras.world_T_cam[:, :3, 3] - data.poses[:, :3, 3]).max() > 3e-3
    error = se3.se3_log(se3.inverse(data.poses) @ static.cameras.world_T_cam)
    assert np.abs(error[:, :3]).max() < 2e-4  # rad
    assert np.abs(error[:, 3:]).max() < 5e-4  # m
    assert np.abs(static.landmarks - data.landmarks).max() < 3e-3
    assert np.linalg.norm(motion.points - data.points, axis=2).max() < 3e-3
    np.testing.assert_allclose(static.cameras.intrinsics, K, rtol=1e-3)
    np.testing.assert_array_equal(static.cameras.world_T_cam[0], data.poses[0])
    np.testing.assert_array_equal(motion.track, data.motion.track)


def test_the_energy_never_rises_and_its_gradient_is_zero_at_the_end() -> None:
    data = sample(noise_px=0.5)
    ends: list[tuple[Stage, State]] = []
    energies: list[float] = []

    def run(stage: Stage, state: State, hooks: Hooks | None) -> tuple[State, SolveSummary]:
        energies.append(stage.problem.energy(state))
        state, summary = run_stage(stage, state, hooks)
        ends.append((stage, state))
        return state, summary

    hooks = Hooks(on_iteration=lambda name, number, energy: energies.append(energy))
    static, _ = solve_joint(data.static, data.motion, data.moving, CONFIG, K, FREE, hooks, run)
    assert len(energies) > 4
    assert (np.diff(energies) < 0).all()
    (stage, end), summary = ends[-1], static.solves[0]
    assert summary.final_energy == pytest.approx(stage.problem.energy(end), rel=1e-12)
    before = BlockObjective(stage.problem, problem_of(data)[1], TIGHT).linearize(problem_of(data)[1])
    after = BlockObjective(stage.problem, end, TIGHT).linearize(end)
    scaled = np.abs(after.gradient) / np.sqrt(after.diagonal)
    assert scaled.max() < 1e-4 * (np.abs(before.gradient) / np.sqrt(before.diagonal)).max()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_moving_points_do_not_collapse(seed: int) -> None:
    data = sample(noise_px=0.2, seed=seed)
    static, motion = solve_joint(data.static, data.motion, data.moving, CONFIG, K, HELD)
    distance = np.linalg.norm(motion.points - static.cameras.world_T_cam[None, :, :3, 3], axis=2)
    true = np.linalg.norm(data.points - data.poses[None, :, :3, 3], axis=2)
    assert np.abs(distance / true - 1.0).max() < 0.01
    spread = [np.linalg.norm(np.diff(points, axis=0), axis=2).mean() for points in (motion.points, data.points)]
    assert spread[0] == pytest.approx(spread[1], rel=0.05)
    assert np.linalg.norm(static.cameras.world_T_cam[:, :3, 3] - data.poses[:, :3, 3], axis=1).max() < 0.01


def test_as_after_stage_2_landmarks_are_refined_with_frozen_cameras() -> None:
    data, config = sample(noise_px=0.5), load_config("default", ["bundle_adjustment.max_reprojection_px=100"])
    static, _ = solve_joint(data.static, data.motion, data.moving, config, K, HELD)
    assert [solve.name for solve in static.solves] == ["joint", "joint_structure", "joint_structure"]
    np.testing.assert_array_equal(static.cameras.intrinsics, K)


def test_a_cancelled_solve_ends_at_once() -> None:
    data = sample()
    static, motion = solve_joint(
        data.static, data.motion, data.moving, CONFIG, K, FREE, Hooks(should_stop=lambda: True)
    )
    assert [solve.termination.name for solve in static.solves] == ["CANCELLED"]
    np.testing.assert_array_equal(motion.points, data.motion.points)


def test_it_works_with_the_energy_of_the_paper() -> None:
    data = sample(noise_px=0.5)
    config = load_config("paper", ["bundle_adjustment.max_reprojection_px=100"])
    static, _ = solve_joint(data.static, data.motion, data.moving, config, K, HELD)
    assert static.solves[0].final_energy < static.solves[0].initial_energy
    assert "depth_prior" not in static.solves[0].final_energies


def test_the_sparse_solver_ends_where_the_dense_ones_do(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state = problem_of(sample(noise_px=0.5))
    dense, summary = run_stage(Stage("joint", problem, TIGHT), state)
    monkeypatch.setattr(backend, "MOST_DENSE_COLUMNS", 100)
    monkeypatch.setattr("uni4d_fg.optim.block._EXACT_COLUMNS", 100)
    monkeypatch.setattr("uni4d_fg.optim.block_preconditioner._MOST_CORE", 200)
    sparse, found = run_stage(Stage("joint", problem, TIGHT), state)
    assert found.notes["solved_by"][0]["by"] == "NumPy sparse blocks, conjugate gradients"
    assert "entries are free beside the eliminated points" in found.notes["solved_by"][0]["why"]
    assert found.final_energy == pytest.approx(summary.final_energy, rel=1e-7)
    np.testing.assert_allclose(sparse[DYNAMIC_POINT], dense[DYNAMIC_POINT], atol=1e-4)
