"""The search for rigid bodies: the start, the fit, the evidence, and the default synthetic scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from stage_samples import K, camera_path

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.rigid_objects import RigidObjectsConfig
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors import State
from uni4d_fg.factors.variable import describe, format_key
from uni4d_fg.factors.variable_types import OBJECT_POINT, OBJECT_POSE
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, project, world_to_camera
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.results.evaluate.rigid_objects import object_motion_errors
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.rigid_fit import (
    BodyObservations,
    assumed_smoothness,
    body_state,
    data_residuals,
    fit_rigid_body,
    measured_smoothness,
    pose_covariance,
    rigid_body_problem,
)
from uni4d_fg.slam.stages.rigid_objects import (
    body_velocity,
    choose_held_out,
    clustered_mean,
    find_rigid_objects,
)
from uni4d_fg.slam.stages.rigid_start import align, central_frame, fill_poses, start_rigid_body
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise

T, N = 10, 40
CONFIG = RigidObjectsConfig()


def object_path(count: int = T) -> FloatArray:
    """Poses (T, 4, 4) of an object some 2.5 m away that turns by 4 degrees and moves by 5 cm per frame."""
    t, zero = np.arange(count, dtype=float), np.zeros(count)
    steps = se3.se3_exp(np.stack([0.02 * t, 0.07 * t, 0.01 * t, zero, zero, zero], axis=1))
    steps[:, :3, 3] = np.stack([-0.2 + 0.05 * t, 0.1 * np.sin(0.3 * t), 2.5 + 0.02 * t], axis=1)
    return steps


def observe(
    poses: FloatArray, shape: FloatArray, seed: int, noise_px: float = 0.0, bend_m: float = 0.0
) -> tuple[DynamicScene, Observations, Cameras]:
    """Trajectories of a body, bending along its x axis if asked, with noisy pixels and 2 % depth."""
    rng = np.random.default_rng(seed)
    count, cameras = len(poses), camera_path(len(poses))
    moving = np.repeat(shape[:, None], count, axis=1)
    moving[:, :, 1] += bend_m * (shape[:, :1] / 0.3) ** 2 * np.sin(0.9 * np.arange(count))
    points = camera_to_world(np.broadcast_to(poses, (len(shape), count, 4, 4)), moving)
    x = world_to_camera(np.broadcast_to(cameras, (len(shape), count, 4, 4)), points)
    uv = project(K, x) + noise_px * rng.normal(size=(len(shape), count, 2))
    depth = x[..., 2] * np.exp((0.02 if noise_px else 0.0) * rng.normal(size=x.shape[:2]))
    seen = rng.random((len(shape), count)) < 0.9
    track, frame = np.nonzero(seen)
    observations = Observations(track + 100, frame, uv[track, frame], depth[track, frame], np.ones(len(track)))
    frozen = Cameras(cameras, K, np.zeros(count))
    names = np.arange(len(shape)) + 100
    wobble = points + (0.01 if noise_px else 0.0) * rng.normal(size=points.shape)
    return DynamicScene(wobble, seen, names, np.full(len(shape), 5)), observations, frozen


def noise_of(noise_px: float) -> StaticNoise:
    return StaticNoise(max(noise_px, 0.1), 0.02)


GIVEN = (noise_of(0.5), np.arange(T) / 15.0, 0.004)
"""Noise, times and smoothness for a search."""


def body_shape(seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-0.3, 0.3, size=(N, 3))


def test_alignment_is_exact_and_bears_a_quarter_of_outliers(rng: np.random.Generator) -> None:
    motion = se3.se3_exp(rng.normal(size=6))
    source = rng.normal(size=(40, 3))
    target = source @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(align(source, target), motion, atol=1e-12)
    target = target + 0.002 * rng.normal(size=target.shape)
    target[:10] += rng.normal(scale=1.0, size=(10, 3))
    found = align(source, target)
    assert np.abs(found - motion).max() < 0.005


def test_alignment_of_a_mirrored_plane_is_a_rotation(rng: np.random.Generator) -> None:
    flat = np.concatenate([rng.normal(size=(20, 2)), np.zeros((20, 1))], axis=1)
    found = align(flat, flat * np.array([-1.0, 1.0, 1.0]))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_the_start_chains_over_frames_that_share_no_trajectory() -> None:
    poses, shape = object_path(), body_shape()
    points = camera_to_world(np.broadcast_to(poses, (N, T, 4, 4)), shape[:, None])
    seen = np.zeros((N, T), dtype=bool)
    for k in range(N):
        first = (k % 5) * 2 - 1
        seen[k, max(first, 0) : first + 4] = True
    assert not (seen[:, 0] & seen[:, 6]).any()
    body = start_rigid_body(points, seen, 3)
    assert body is not None
    assert body.reference == central_frame(seen)
    again = camera_to_world(np.broadcast_to(body.world_T_object, (N, T, 4, 4)), body.points[:, None])
    np.testing.assert_allclose(again, points, atol=1e-9)
    np.testing.assert_allclose(body.world_T_object[body.reference, :3, :3], np.eye(3), atol=1e-12)


def test_the_start_tells_when_there_is_none() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3, 3))
    seen = np.zeros((5, 3), dtype=bool)
    seen[:2, 0] = seen[2:4, 1] = seen[4, 2] = True
    assert start_rigid_body(points, seen, 3) is None


def test_missing_poses_lie_on_the_screw_between_their_neighbors() -> None:
    step = se3.se3_exp(np.array([0.1, 0.2, -0.1, 0.3, 0.0, 0.1]))
    poses = [np.eye(4)]
    for _ in range(5):
        poses.append(poses[-1] @ step)
    known = np.array([False, True, False, False, True, False])
    filled = fill_poses(np.where(known[:, None, None], poses, np.nan), known)
    np.testing.assert_allclose(filled[1:5], poses[1:5], atol=1e-12)
    np.testing.assert_array_equal(filled[0], poses[1])
    np.testing.assert_array_equal(filled[5], poses[4])


def rigid_data(seed: int, noise_px: float) -> tuple[BodyObservations, DynamicScene, FloatArray]:
    poses = object_path()
    motion, seen, cameras = observe(poses, body_shape(seed), seed, noise_px)
    row = seen.track - 100
    sigmas = np.repeat([0.02, 0.004], 3)
    return BodyObservations(5, motion.track, 0, seen, row, cameras, noise_of(noise_px), sigmas), motion, poses


def test_the_fit_recovers_an_exact_body_from_a_wrong_start() -> None:
    data, motion, poses = rigid_data(0, 0.0)
    data = replace(data, smoothness=np.full(6, 1e3))
    rng = np.random.default_rng(1)
    body = start_rigid_body(motion.points, motion.observed, 3)
    assert body is not None
    moved = se3.retract(body.world_T_object, rng.normal(scale=0.02, size=(T, 6)))
    moved[body.reference] = body.world_T_object[body.reference]
    wrong = replace(body, world_T_object=moved, points=body.points + rng.normal(scale=0.02, size=(N, 3)))
    tight = SolverConfig(relative_decrease=1e-12)
    found, summary = fit_rigid_body(wrong, data, CONFIG.model_copy(update={"solver": tight}))
    assert summary.name == "rigid_object[instance 5]"
    assert summary.num_variables == N + T - 1
    pixel, depth = data_residuals(found, data)
    assert np.abs(pixel).max() < 1e-4
    assert np.abs(depth).max() < 1e-5
    errors = object_motion_errors(
        found.world_T_object, poses, data.cameras.world_T_cam, data.cameras.world_T_cam, found.reference
    )
    assert errors.rotation_deg.max() < 1e-3
    assert errors.distance.max() < 1e-5


def test_covariances_tell_the_errors_of_the_rotation() -> None:
    ratios = []
    for seed in range(6):
        data, motion, poses = rigid_data(seed, 0.5)
        body = start_rigid_body(motion.points, motion.observed, 3)
        assert body is not None
        found, _ = fit_rigid_body(body, data, CONFIG)
        covariance = pose_covariance(found, data, CONFIG)
        np.testing.assert_array_equal(covariance[found.reference], 0.0)
        s = found.reference
        relative = se3.inverse(found.world_T_object[s]) @ found.world_T_object
        to_true = se3.inverse(poses[s]) @ found.world_T_object[s]
        true = se3.inverse(to_true) @ se3.inverse(poses[s]) @ poses @ to_true
        error = se3.so3_log(np.swapaxes(relative[:, :3, :3], 1, 2) @ true[:, :3, :3])
        for t in np.setdiff1d(np.arange(T), [s]).tolist():
            ratios.append(error[t] @ np.linalg.solve(covariance[t, :3, :3], error[t]) / 3.0)
    assert 0.4 < np.mean(ratios) < 2.0


def test_measured_smoothness_follows_the_motion() -> None:
    data, motion, _ = rigid_data(0, 0.5)
    body = start_rigid_body(motion.points, motion.observed, 3)
    assert body is not None
    steady = measured_smoothness(fit_rigid_body(body, data, CONFIG)[0], data, data.smoothness, CONFIG)
    shaken = object_path() @ se3.se3_exp(np.random.default_rng(4).normal(scale=[0.05] * 3 + [0.02] * 3, size=(T, 6)))
    motion, seen, cameras = observe(shaken, body_shape(), 0, 0.5)
    rough = replace(data, seen=seen, row=seen.track - 100, cameras=cameras, smoothness=np.repeat([0.1, 0.05], 3))
    body = start_rigid_body(motion.points, motion.observed, 3)
    assert body is not None
    found = measured_smoothness(fit_rigid_body(body, rough, CONFIG)[0], rough, rough.smoothness, CONFIG)
    # Second differences of white noise of sigma s have the sigma sqrt(6) s.
    assert 0.06 < found[0] < 0.25
    assert 0.02 < found[3] < 0.12
    assert steady[0] < 0.01
    assert assumed_smoothness(body, 0.004)[3] == 0.004


def test_velocity_of_a_screw_motion_is_its_twist() -> None:
    twist = np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.3])
    seconds = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
    poses = se3.se3_exp(seconds[:, None] * twist)
    np.testing.assert_allclose(body_velocity(poses, seconds), np.tile(twist, (5, 1)), atol=1e-12)


def test_clustered_errors_are_those_of_the_means_of_groups() -> None:
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(50), 20)
    alike = rng.normal(size=50)[group]
    mean, spread = clustered_mean(alike, (group, np.arange(1000)))
    means = alike[::20]
    assert mean == pytest.approx(means.mean())
    assert spread == pytest.approx(means.std(ddof=1) / np.sqrt(50), rel=1e-9)
    assert np.isnan(clustered_mean(alike, (np.zeros(1000, dtype=np.int64),))[1])


def test_held_out_observations_are_never_the_ends_of_a_track() -> None:
    _, seen, _ = observe(object_path(), body_shape(), 3)
    held_out = choose_held_out(seen, CONFIG)
    for track in np.unique(seen.track):
        mine = np.flatnonzero(seen.track == track)
        assert not held_out[mine[[0, -1]]].any()
    assert 0.1 < held_out.mean() < 0.25


@pytest.mark.parametrize(("bend_m", "rigid"), [(0.0, True), (0.1, False)])
def test_a_bending_body_is_not_taken_for_rigid(bend_m: float, rigid: bool) -> None:
    motion, seen, cameras = observe(object_path(), body_shape(), 2, 0.5, bend_m)
    free_points = motion.points.copy()

    def free(observations: Observations) -> DynamicScene:
        # What a smoother would give: points off by some 0.8 px across the ray.
        noise = np.random.default_rng(9).normal(scale=0.01, size=free_points.shape)
        return replace(motion, points=free_points + noise)

    found, evidence = find_rigid_objects(motion, seen, seen, cameras, *GIVEN, CONFIG, free)
    assert evidence[5].is_rigid == rigid
    assert len(found) == rigid
    if rigid:
        assert evidence[5].num_members == N
        assert evidence[5].advantage > 0.3
        # Of 2 x 360 numbers 174 go into the poses and points, and what is left is that much smaller.
        assert evidence[5].sigma_px == pytest.approx(0.5 * np.sqrt(1.0 - 174 / 720), rel=0.1)
        assert found[0].observed.all()
        assert np.isfinite(found[0].covariance).all()


def test_frames_without_the_object_have_no_pose_and_too_few_tracks_are_not_tested() -> None:
    motion, seen, cameras = observe(object_path(), body_shape(), 2, 0.5)
    seen = seen.select((seen.frame >= 2) & (seen.frame != 5))
    motion = replace(motion, observed=motion.observed & np.isin(np.arange(T), seen.frame))
    noisy = replace(motion, points=motion.points + np.random.default_rng(9).normal(scale=0.02, size=(N, T, 3)))
    found, _ = find_rigid_objects(motion, seen, seen, cameras, *GIVEN, CONFIG, lambda _: noisy)
    (body,) = found
    assert np.isnan(body.world_T_object[:2]).all()
    assert np.isfinite(body.world_T_object[2:]).all()
    assert body.observed.tolist() == [t >= 2 and t != 5 for t in range(T)]
    few = CONFIG.model_copy(update={"min_tracks": N + 1})
    nothing = find_rigid_objects(motion, seen, seen, cameras, *GIVEN, few, lambda _: noisy)
    assert nothing == ([], {})


def test_a_graph_of_gtsam_has_the_same_energy_and_keeps_the_end() -> None:
    data, motion, _ = rigid_data(0, 0.5)
    body = start_rigid_body(motion.points, motion.observed, 3)
    assert body is not None
    tight = CONFIG.model_copy(update={"solver": SolverConfig(relative_decrease=1e-13, max_iterations=200)})
    body, summary = fit_rigid_body(body, data, tight)
    state = body_state(body, data)
    problem = rigid_body_problem(state, data, body.reference, CONFIG)
    assert sum(summary.final_energies.values()) == pytest.approx(problem.energy(state), rel=1e-9)
    graph, values = to_gtsam(problem, state)
    assert graph.error(values) == pytest.approx(problem.energy(state), rel=1e-9)
    assert values.exists(OBJECT_POSE.key(5, 3))
    assert format_key(OBJECT_POSE.key(5, 3)) == "o5_3"
    assert describe(OBJECT_POINT.key(107)) == "object point, track 107"
    again = State.from_values(values)
    np.testing.assert_allclose(again[OBJECT_POSE], state[OBJECT_POSE], atol=1e-12)


def test_a_default_synthetic_scene(load_benchmark: Callable[[str], Any]) -> None:
    pytest.importorskip("open3d")
    benchmark = load_benchmark("rigid_objects")
    sequence = make_synthetic_sequence(SyntheticSceneConfig(seed=3, num_frames=16, render_images=False))
    found, summary, cameras = benchmark.search(sequence)
    assert found["object_instance"].tolist() == [1]
    rigid, other = summary["instances"]
    assert (rigid["instance"], rigid["is_rigid"], other["instance"], other["is_rigid"]) == (1, True, 2, False)
    assert rigid["num_members"] > 0.95 * rigid["num_tracks"]
    assert rigid["advantage"] > 5.0 * rigid["standard_error"]
    report = benchmark.scores(found, cameras, sequence)
    assert report.without_truth == report.not_found == ()
    (errors,) = report.objects
    assert errors.frames > 10
    assert errors.rotation_max_deg < 0.5
    assert errors.distance_max < 0.01
