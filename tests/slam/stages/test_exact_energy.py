"""The exact scorer and the loss of Adam equal sums written out in numpy; neither sees a rigid motion of the world."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from stage_samples import K, camera_path, hide, observe, shift, static_observations, static_points

from uni4d_fg.config.adam import AdamConfig, AdamScheduleConfig
from uni4d_fg.config.solver import KernelConfig, SolverConfig
from uni4d_fg.config.stages import BundleAdjustmentConfig, CameraInitConfig, CameraMotionConfig, NonRigidConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, POSE
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, project, world_to_camera
from uni4d_fg.optim.adam.runner import AdamRunner
from uni4d_fg.optim.stage import Stage
from uni4d_fg.pipeline.steps import paper_energy
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, bundle_adjustment_problem
from uni4d_fg.slam.stages.camera_init import PairSource, window_stage
from uni4d_fg.slam.stages.energy import Normalization, PaperEnergy
from uni4d_fg.slam.stages.nonrigid import PointMesh, build_mesh, nonrigid_problem
from uni4d_fg.slam.stages.observations import Observations, observations_of
from uni4d_fg.slam.stages.proximal import LiftNoise, proximal_term
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise, StaticScene, unknown_covariances

FRAMES, TRACKS = 6, 15
MOTION = se3.se3_exp(np.array([0.4, -0.3, 0.7, 1.0, -2.0, 0.5]))
NORMALIZATIONS: list[Normalization] = ["mean", "sum"]
NOISE = StaticNoise(0.5, 0.02)
NORM = KernelConfig(kind="norm", threshold=0.1)
PAPER_NONRIGID = NonRigidConfig(
    depth_prior=False, smoothness_order=1, smoothness_weight=10.0, arap_weight=100.0, bridge_gaps=False,
    reprojection_kernel=NORM, smoothness_kernel=NORM, arap_kernel=NORM,
)  # fmt: skip


@pytest.fixture
def poses(rng: np.random.Generator) -> np.ndarray:
    return se3.retract(camera_path(FRAMES), rng.normal(scale=0.02, size=(FRAMES, 6)))


@pytest.fixture
def static(rng: np.random.Generator, poses: np.ndarray) -> tuple[np.ndarray, Observations]:
    """Landmarks and disturbed observations of unequal weight, some missing."""
    landmarks = static_points(rng, TRACKS)
    labelled = shift(observe(landmarks, poses), rng.normal(size=(TRACKS, FRAMES, 2)))
    observations = static_observations(hide(labelled, rng.random((TRACKS, FRAMES)) < 0.3))
    return landmarks, replace(observations, weight=rng.uniform(0.2, 1.0, len(observations)))


def moved(points: np.ndarray) -> np.ndarray:
    return np.asarray(camera_to_world(MOTION, points))


def reprojection(
    points: np.ndarray, observations: Observations, poses: np.ndarray, normalization: Normalization
) -> float:
    """Sum, or mean over frames of weighted means, of the pixel distances; ``points`` (N, 3), one per observation."""
    x = world_to_camera(poses[observations.frame], points)
    norms = np.linalg.norm(observations.uv - project(K, x), axis=1)
    if normalization == "sum":
        return float(np.sum(observations.weight * norms))
    means = []
    for t in range(len(poses)):
        mine = observations.frame == t
        means.append(np.average(norms[mine], weights=observations.weight[mine]))
    return float(np.mean(means))


def relative_change(a: np.ndarray, b: np.ndarray, floor: float) -> float:
    size = 0.5 * (np.sqrt(a @ a + floor**2) + np.sqrt(b @ b + floor**2))
    return float(np.linalg.norm(a - b) / size)


def camera_motion(poses: np.ndarray, normalization: Normalization) -> tuple[float, float]:
    """E_rot and E_trans."""
    floor = CameraMotionConfig()
    rotation, translation = [], []
    for t in range(1, len(poses) - 1):
        turns = [se3.so3_log(poses[t + i - 1, :3, :3].T @ poses[t + i, :3, :3]) for i in range(2)]
        steps = [poses[t + i, :3, 3] - poses[t + i - 1, :3, 3] for i in range(2)]
        rotation.append(relative_change(turns[0], turns[1], floor.rotation_floor_rad))
        translation.append(relative_change(steps[0], steps[1], floor.translation_floor_m))
    reduce = np.mean if normalization == "mean" else np.sum
    return float(reduce(rotation)), float(reduce(translation))


def static_energy(
    world_T_cam: np.ndarray, landmarks: np.ndarray, observations: Observations, normalization: Normalization
) -> dict[str, float]:
    scene = StaticScene(
        Cameras(world_T_cam, K, np.zeros(len(world_T_cam))), landmarks, observations.rows()[0], observations, NOISE,
        np.zeros(len(landmarks), np.float32), *unknown_covariances(len(world_T_cam)),
    )  # fmt: skip
    return paper_energy(scene, normalization)


@pytest.mark.parametrize("normalization", NORMALIZATIONS)
def test_the_static_energy_written_out(
    static: tuple[np.ndarray, Observations], poses: np.ndarray, normalization: Normalization
) -> None:
    landmarks, observations = static
    _, row = observations.rows()
    energy = static_energy(poses, landmarks, observations, normalization)
    assert energy["static_reprojection"] == pytest.approx(
        reprojection(landmarks[row], observations, poses, normalization), rel=1e-12
    )
    rotation, translation = camera_motion(poses, normalization)
    assert energy["camera_rotation"] == pytest.approx(rotation, rel=1e-9)
    assert energy["camera_translation"] == pytest.approx(translation, rel=1e-9)
    assert set(energy) == {"static_reprojection", "camera_rotation", "camera_translation"}


@pytest.mark.parametrize("normalization", NORMALIZATIONS)
def test_the_static_energy_does_not_see_a_rigid_motion(
    static: tuple[np.ndarray, Observations], poses: np.ndarray, normalization: Normalization
) -> None:
    landmarks, observations = static
    here = static_energy(poses, landmarks, observations, normalization)
    there = static_energy(MOTION @ poses, moved(landmarks), observations, normalization)
    assert there == pytest.approx(here, rel=1e-9)


def test_the_static_energy_of_the_exact_scene_is_zero_but_for_rounding(rng: np.random.Generator) -> None:
    landmarks, straight = static_points(rng, TRACKS), np.tile(np.eye(4), (FRAMES, 1, 1))
    straight[:, 0, 3] = 0.1 * np.arange(FRAMES)
    energy = static_energy(straight, landmarks, static_observations(observe(landmarks, straight)), "mean")
    assert energy["static_reprojection"] < 1e-4
    assert energy["camera_rotation"] + energy["camera_translation"] < 1e-12


@pytest.fixture
def dynamic(rng: np.random.Generator, poses: np.ndarray) -> tuple[State, PointMesh, Observations, np.ndarray, Cameras]:
    walk = static_points(rng, TRACKS)[:, None] + np.cumsum(rng.normal(scale=0.05, size=(TRACKS, FRAMES, 3)), axis=1)
    labelled = shift(observe(walk, poses, TrackLabel.DYNAMIC, 1), rng.normal(size=(TRACKS, FRAMES, 2)))
    labelled = hide(labelled, rng.random((TRACKS, FRAMES)) < 0.2)
    observations = observations_of(labelled, TrackLabel.DYNAMIC)
    observations = replace(observations, weight=rng.uniform(0.2, 1.0, len(observations)))
    cameras = Cameras(poses, K, np.zeros(FRAMES))
    mesh, observations, rows, state = build_mesh(observations, labelled.instance, FRAMES, cameras, PAPER_NONRIGID, {})
    disturbed = state[DYNAMIC_POINT] + rng.normal(scale=0.02, size=state[DYNAMIC_POINT].shape)
    return state.replace({DYNAMIC_POINT: disturbed}), mesh, observations, rows, cameras


def point_motion(state: State, mesh: PointMesh, normalization: Normalization) -> tuple[float, float]:
    """E_smooth and E_arap with their weights."""
    points = np.full((*mesh.row.shape, 3), np.nan)
    points[mesh.row >= 0] = state[DYNAMIC_POINT]
    steps = np.linalg.norm(np.diff(points, axis=1), axis=2)
    steps = steps[np.isfinite(steps)]
    changes = []
    for first, second in mesh.pairs:
        distance = np.sqrt(np.sum((points[first] - points[second]) ** 2, axis=1) + 1e-8)
        changes += [abs(step) for step in np.diff(distance) if np.isfinite(step)]
    reduce = np.mean if normalization == "mean" else np.sum
    return 10.0 * float(reduce(steps)), 100.0 * float(reduce(changes))


def dynamic_energy(
    state: State,
    mesh: PointMesh,
    observations: Observations,
    rows: np.ndarray,
    cameras: Cameras,
    normalization: Normalization,
) -> dict[str, float]:
    problem = nonrigid_problem(
        state, mesh, observations, rows, cameras, NOISE, PAPER_NONRIGID, PaperEnergy(normalization)
    )
    return problem.energies(state, exact=True)


@pytest.mark.parametrize("normalization", NORMALIZATIONS)
def test_the_dynamic_energy_written_out(
    dynamic: tuple[State, PointMesh, Observations, np.ndarray, Cameras], normalization: Normalization
) -> None:
    state, mesh, observations, rows, cameras = dynamic
    energy = dynamic_energy(state, mesh, observations, rows, cameras, normalization)
    assert energy["dynamic_reprojection"] == pytest.approx(
        reprojection(state[DYNAMIC_POINT][rows], observations, cameras.world_T_cam, normalization), rel=1e-12
    )
    smoothness, arap = point_motion(state, mesh, normalization)
    assert energy["smoothness"] == pytest.approx(smoothness, rel=1e-12)
    assert energy["arap"] == pytest.approx(arap, rel=1e-9)
    assert set(energy) == {"dynamic_reprojection", "smoothness", "arap"}


@pytest.mark.parametrize("normalization", NORMALIZATIONS)
def test_the_dynamic_energy_does_not_see_a_rigid_motion(
    dynamic: tuple[State, PointMesh, Observations, np.ndarray, Cameras], normalization: Normalization
) -> None:
    state, mesh, observations, rows, cameras = dynamic
    here = dynamic_energy(state, mesh, observations, rows, cameras, normalization)
    there = dynamic_energy(
        state.replace({DYNAMIC_POINT: moved(state[DYNAMIC_POINT])}), mesh, observations, rows,
        replace(cameras, world_T_cam=MOTION @ cameras.world_T_cam), normalization,
    )  # fmt: skip
    assert there == pytest.approx(here, rel=1e-9)


def depth_reprojection_sum(
    labelled: LabelledTracks, poses: np.ndarray, frames: list[int], normalization: Normalization
) -> float:
    """Stage 1: every ordered pair of frames, every track with depth in the first and seen in the second."""
    camera = np.array([[K[0], 0.0, K[2]], [0.0, K[1], K[3]], [0.0, 0.0, 1.0]])
    pairs = []
    for i, j in itertools.permutations(frames, 2):
        norms, weights = [], []
        for k in range(labelled.tracks.num_tracks):
            if labelled.weight[k, i] > 0 and labelled.weight[k, j] > 0 and np.isfinite(labelled.depth[k, i]):
                pixel = np.append(labelled.tracks.uv[k, i].astype(np.float64), 1.0)
                lifted = poses[i] @ np.append(np.linalg.solve(camera, pixel) * float(labelled.depth[k, i]), 1.0)
                seen = camera @ (np.linalg.inv(poses[j]) @ lifted)[:3]
                norms.append(np.linalg.norm(labelled.tracks.uv[k, j] - seen[:2] / seen[2]))
                weights.append(np.sqrt(float(labelled.weight[k, i]) * float(labelled.weight[k, j])))
        pairs.append(
            np.sum(np.multiply(norms, weights)) if normalization == "sum" else np.average(norms, None, weights)
        )
    return float(np.sum(pairs) if normalization == "sum" else np.mean(pairs))


@pytest.mark.parametrize("normalization", NORMALIZATIONS)
def test_the_loss_of_adam_in_stage_1_is_the_formula_of_the_paper(
    poses: np.ndarray, rng: np.random.Generator, normalization: Normalization
) -> None:
    labelled = shift(observe(static_points(rng, TRACKS), poses), rng.normal(size=(TRACKS, FRAMES, 2)))
    labelled = hide(labelled, rng.random((TRACKS, FRAMES)) < 0.2)
    unequal = rng.uniform(0.2, 1.0, labelled.weight.shape).astype(np.float32)
    wrong = rng.uniform(0.9, 1.1, labelled.depth.shape).astype(np.float32)
    labelled = replace(labelled, weight=labelled.weight * unequal, depth=labelled.depth * wrong)
    config = CameraInitConfig(kernel=NORM, camera_motion=CameraMotionConfig(), max_tracks_per_pair=0)
    frames = [1, 2, 3, 4, 5]
    state = State({POSE: poses, INTRINSICS: K[None]})
    stage = window_stage(
        np.array(frames), state, PairSource(labelled, 0), config, free_intrinsics=False,
        energy=PaperEnergy(normalization),
    )  # fmt: skip
    # As in the authors' program, the newest frame begins where the one before it is.
    start = np.concatenate([poses[:-1], poses[-2:-1]])
    expected = depth_reprojection_sum(labelled, start, frames, normalization) + sum(
        camera_motion(start[frames], normalization)
    )
    assert first_loss(stage, state) == pytest.approx(expected, rel=1e-8)
    assert expected > 1.0


def first_loss(stage: Stage, state: State) -> float:
    """What Adam minimizes, before its first step."""
    once = AdamScheduleConfig(max_iterations=1)
    config = AdamConfig(precision="float64", camera_init=once, bundle_adjustment=once, nonrigid=once)
    _, summary = AdamRunner(config)(stage, state)
    return summary.iterations[0].energy


@pytest.mark.parametrize("normalization", NORMALIZATIONS)
def test_the_loss_of_adam_in_stage_2_is_the_formula_of_the_paper(
    static: tuple[np.ndarray, Observations], poses: np.ndarray, normalization: Normalization
) -> None:
    landmarks, observations = static
    tracks, row = observations.rows()
    state = Cameras(poses, K, np.zeros(FRAMES)).state(landmarks, tracks)
    config = BundleAdjustmentConfig(depth_prior=False, camera_motion=CameraMotionConfig(), reprojection_kernel=NORM)
    problem = bundle_adjustment_problem(
        state, observations, StaticNoise(1.0, 1.0), config, state[INTRINSICS],
        Freedom(poses=True, intrinsics=False), PaperEnergy(normalization),
    )  # fmt: skip
    expected = reprojection(landmarks[row], observations, poses, normalization) + sum(
        camera_motion(poses, normalization)
    )
    assert first_loss(Stage("bundle_adjustment", problem, SolverConfig()), state) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("normalization", NORMALIZATIONS)
def test_the_loss_of_adam_in_stage_3_is_the_formula_of_the_paper(
    dynamic: tuple[State, PointMesh, Observations, np.ndarray, Cameras], normalization: Normalization
) -> None:
    state, mesh, observations, rows, cameras = dynamic
    energy = PaperEnergy(normalization)
    problem = nonrigid_problem(state, mesh, observations, rows, cameras, NOISE, PAPER_NONRIGID, energy)
    lift_noise = LiftNoise(cameras.log_scale, 0.02)
    bound = proximal_term(observations, rows, cameras, lift_noise, NonRigidConfig(proximal_weight=1.0), energy)
    stage = Stage("nonrigid", problem.add(bound), SolverConfig(), bounds=frozenset({bound.name}))
    seen = reprojection(state[DYNAMIC_POINT][rows], observations, cameras.world_T_cam, normalization)
    expected = seen + sum(point_motion(state, mesh, normalization))
    assert first_loss(stage, state) == pytest.approx(expected, rel=1e-8)
    assert sum(stage.problem.energies(state, exact=True).values()) > 1.0001 * expected
