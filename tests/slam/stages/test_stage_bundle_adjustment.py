"""Stage 2: gauge and scale, what is dropped and counted, and what is measured."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from stage_samples import K, camera_path, hide, observe, shift, static_observations, static_points

from uni4d_fg.config.stages import BundleAdjustmentConfig, CameraMotionConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, adjust_bundle
from uni4d_fg.slam.stages.energy import MAP, Energy, PaperEnergy
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticScene
from uni4d_fg.slam.stages.static_outliers import drop_outliers

FRAMES, TRACKS = 8, 80
POSES = camera_path(FRAMES)
WORLD = static_points(np.random.default_rng(11), TRACKS)
# The path of the samples bends on purpose: no prior on constant velocity, and iterate to the end.
CONFIG = BundleAdjustmentConfig.model_validate(
    {
        "camera_motion": {"rotation_weight": 0.0, "translation_weight": 0.0},
        "solver": {"max_iterations": 50, "relative_decrease": 1e-9},
    }
)


def changed(**fields: object) -> BundleAdjustmentConfig:
    return BundleAdjustmentConfig.model_validate(CONFIG.model_dump() | fields)


@pytest.fixture
def exact() -> LabelledTracks:
    return observe(WORLD, POSES)


@pytest.fixture
def start(rng: np.random.Generator) -> np.ndarray:
    """Starting poses off by about 1 cm and 0.3 degrees, but for the first."""
    disturbed = se3.retract(POSES, rng.normal(scale=[0.005] * 3 + [0.01] * 3, size=(FRAMES, 6)))
    disturbed[0] = POSES[0]
    return disturbed


def adjust(
    observations: Observations,
    start: np.ndarray,
    config: BundleAdjustmentConfig = CONFIG,
    *,
    intrinsics: np.ndarray = K,
    poses_free: bool = True,
    intrinsics_free: bool = False,
    energy: Energy = MAP,
    hooks: Hooks | None = None,
) -> StaticScene:
    cameras = Cameras(start, intrinsics, np.zeros(len(start)))
    return adjust_bundle(observations, cameras, intrinsics, config, Freedom(poses_free, intrinsics_free), energy, hooks)


def past_a_scene(turn: float) -> np.ndarray:
    """Poses (T, 4, 4) of a camera that goes past a scene and turns with it by so many rad in all."""
    part = np.linspace(0.0, 1.0, FRAMES)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = 0.3 * part
    poses[:, :3, :3] = se3.so3_exp(np.outer(part, [0.0, -turn, 0.0]))
    return poses


def drifting(rng: np.random.Generator, poses: np.ndarray, drift_px: float) -> Observations:
    """Observations of 150 points: noise of 0.2 px, and tracks that have drifted by so much at the end."""
    part = np.linspace(0.0, 1.0, len(poses))
    drift = rng.normal(scale=drift_px, size=(150, 1, 2)) * part[:, None]
    off = drift + rng.normal(scale=0.2, size=(150, len(poses), 2))
    return static_observations(shift(observe(static_points(rng, 150), poses), off.astype(np.float32)))


def test_exact_observations_give_the_exact_scene(exact: LabelledTracks, start: np.ndarray) -> None:
    result = adjust(static_observations(exact), start)
    np.testing.assert_allclose(result.cameras.world_T_cam, POSES, atol=1e-4)
    np.testing.assert_allclose(result.landmarks, WORLD[result.landmark_track], atol=1e-3)
    np.testing.assert_allclose(result.cameras.log_scale, 0.0, atol=1e-4)
    assert result.landmark_error.max() < 0.01
    assert result.noise.reprojection_sigma_px == CONFIG.min_reprojection_sigma_px
    assert result.noise.depth_sigma == CONFIG.min_depth_sigma


@pytest.mark.parametrize("energy", [MAP, PaperEnergy()], ids=["map", "paper"])
def test_the_first_frame_is_the_gauge_and_stays_exactly(
    exact: LabelledTracks, start: np.ndarray, rng: np.random.Generator, energy: Energy
) -> None:
    noisy = static_observations(shift(exact, rng.normal(size=exact.tracks.uv.shape)))
    moved = se3.se3_exp(np.array([0.3, -0.2, 0.1, 1.0, 2.0, -0.5])) @ start
    result = adjust(noisy, moved, changed(depth_prior=energy.is_likelihood), energy=energy)
    np.testing.assert_array_equal(result.cameras.world_T_cam[0], moved[0])
    assert np.abs(result.cameras.world_T_cam[1:] - moved[1:]).max() > 1e-4


def test_covariances_come_with_the_cameras(exact: LabelledTracks, start: np.ndarray) -> None:
    result = adjust(static_observations(exact), start, intrinsics_free=True)
    assert (result.pose_covariance[0] == 0.0).all()
    assert (np.linalg.eigvalsh(result.pose_covariance[1:]) > 0.0).all()
    assert (np.diag(result.intrinsics_covariance)[:2] > 0.0).all()
    assert (result.intrinsics_covariance[2:] == 0.0).all()
    paper = adjust(static_observations(exact), start, changed(depth_prior=False), energy=PaperEnergy())
    assert np.isnan(paper.pose_covariance).all()
    assert np.isnan(paper.intrinsics_covariance).all()


def test_the_scale_of_the_depth_cue_per_frame_is_found(exact: LabelledTracks, start: np.ndarray) -> None:
    scale = np.array([0.04, -0.05, 0.02, 0.0, -0.03, 0.05, -0.02, -0.01])
    observations = static_observations(exact)
    observations.depth[:] *= np.exp(-scale[observations.frame])
    result = adjust(observations, start, changed(depth_scale_prior_sigma=1.0))
    np.testing.assert_allclose(
        result.cameras.log_scale - result.cameras.log_scale.mean(), scale - scale.mean(), atol=2e-3
    )


def test_points_with_the_depth_of_what_is_behind_them_do_not_set_the_scale(
    exact: LabelledTracks, start: np.ndarray, rng: np.random.Generator
) -> None:
    observations = static_observations(exact)
    observations.depth[:] *= np.exp(rng.normal(scale=0.005, size=len(observations)))
    observations.depth[observations.track < TRACKS // 8] *= 1.15
    # A first solve that believes them bends this path by a hundredth: the images are exact, which no sigma allows for.
    result = adjust(observations, start, changed(first_depth_sigma=None))
    length, true_length = (
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() for poses in (result.cameras.world_T_cam, POSES)
    )
    assert abs(length / true_length - 1.0) < 0.003
    assert abs(result.cameras.log_scale.mean()) < 1e-9


def test_without_depth_prior_one_distance_holds_the_scale(exact: LabelledTracks) -> None:
    result = adjust(static_observations(exact), POSES, changed(depth_prior=False, structure="keep"))
    distance = np.linalg.norm(result.cameras.world_T_cam[:, :3, 3], axis=1)
    np.testing.assert_allclose(distance[-1], np.linalg.norm(POSES[-1, :3, 3]), rtol=1e-3)
    np.testing.assert_array_equal(result.cameras.log_scale, 0.0)


def test_a_wrong_focal_length_is_corrected_and_fixed_ones_are_kept(exact: LabelledTracks, start: np.ndarray) -> None:
    wrong = K * [1.05, 1.05, 1.0, 1.0]
    free = adjust(static_observations(exact), start, intrinsics=wrong, intrinsics_free=True)
    np.testing.assert_allclose(free.cameras.intrinsics[:2], K[:2], rtol=0.01)
    np.testing.assert_array_equal(free.cameras.intrinsics[2:], wrong[2:])
    fixed = adjust(static_observations(exact), start, intrinsics=wrong)
    np.testing.assert_array_equal(fixed.cameras.intrinsics, wrong)


def test_fixed_poses_are_kept_exactly(exact: LabelledTracks, start: np.ndarray) -> None:
    result = adjust(static_observations(exact), start, poses_free=False)
    np.testing.assert_array_equal(result.cameras.world_T_cam, start)
    assert len(result.landmarks) > 0


def test_large_errors_are_dropped_and_counted(exact: LabelledTracks) -> None:
    offset = np.zeros((TRACKS, FRAMES, 2))
    offset[:30, 5] = [40.0, -25.0]
    result = adjust(static_observations(shift(exact, offset)), POSES)
    assert result.dropped["observation with a large reprojection error"] == 30
    kept = set(zip(result.observations.track.tolist(), result.observations.frame.tolist(), strict=True))
    assert not kept & {(track, 5) for track in range(30)}
    np.testing.assert_allclose(result.cameras.world_T_cam, POSES, atol=2e-3)


def test_observations_behind_a_camera_are_dropped_and_counted(exact: LabelledTracks) -> None:
    poses, observations = POSES.copy(), static_observations(exact)
    poses[5] = poses[5] @ se3.se3_exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    arrays = {POSE: poses, INTRINSICS: K[None], LOG_SCALE: np.zeros((FRAMES, 1)), LANDMARK: WORLD}
    dropped: dict[str, int] = {}
    state, kept = drop_outliers(State(arrays, {LANDMARK: np.arange(TRACKS)}), observations, CONFIG, dropped)
    assert {reason: count for reason, count in dropped.items() if count} == {"observation behind the camera": TRACKS}
    assert len(state[LANDMARK]) == TRACKS
    assert len(kept) == TRACKS * (FRAMES - 1)
    assert 5 not in kept.frame


def test_landmarks_that_contradict_the_depth_cue_are_dropped_and_counted(exact: LabelledTracks) -> None:
    depth = exact.depth.copy()
    depth[:10] *= 2.5
    seen = static_observations(dataclasses.replace(exact, depth=depth))
    loosely = adjust(seen, POSES, changed(first_depth_sigma=None, trim_sigmas=None))
    assert loosely.dropped["landmark whose depth contradicts the cue"] == 10
    # Held closely, they stay at the depth of the cue, and are off in the images.
    closely = adjust(seen, POSES)
    assert closely.dropped["landmark that departs from the others"] == 10
    for result in (loosely, closely):
        assert result.landmark_track.min() == 10


def test_a_sound_cue_is_believed_where_tracks_that_drift_tell_another_focal_length() -> None:
    """A camera that goes past a scene and turns with it, and an exact cue.

    Cameras of a loose start depart from the cue by what the tracks are off, which then counts as noise of the cue.
    """
    rng, poses = np.random.default_rng(0), past_a_scene(turn=0.1)
    guess = K * np.array([1.1, 1.1, 1.0, 1.0])
    error: dict[float | None, list[float]] = {0.07: [], None: []}
    for _ in range(6):
        seen = drifting(rng, poses, drift_px=1.0)
        for sigma, errors in error.items():
            settings = changed(first_depth_sigma=sigma, focal_prior_fraction=0.5)
            found = adjust(seen, poses, settings, intrinsics=guess, intrinsics_free=True)
            errors.append(abs(float(np.log(found.cameras.intrinsics[0] / K[0]))))
    assert np.mean(error[0.07]) < 0.03
    assert np.mean(error[0.07]) < 0.7 * np.mean(error[None])


@pytest.mark.parametrize("seed", range(3))
def test_the_last_solve_ends_where_the_focal_length_has_its_minimum(seed: int) -> None:
    """A camera that goes past a scene: the energy is nearly flat along the focal length, which damping would hold."""
    poses = past_a_scene(turn=0.02)
    seen = drifting(np.random.default_rng(seed), poses, drift_px=0.3)
    ends: list[tuple[float, float]] = []

    def run(stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        def log_focal(start: State, **options: float) -> float:
            again = dataclasses.replace(stage, solver=stage.solver.model_copy(update=options))
            return float(np.log(run_stage(again, start)[0][INTRINSICS][0, 0]))

        end, summary = run_stage(stage, state, hooks)
        if stage.kind == "bundle_adjustment":
            minimum = log_focal(end, relative_decrease=1e-12, max_iterations=300)
            found = float(np.log(end[INTRINSICS][0, 0]))
            ends.append((abs(found - minimum), abs(log_focal(state, initial_damping=1e-4) - minimum)))
        return end, summary

    guess = K * np.array([1.1, 1.1, 1.0, 1.0])
    settings = BundleAdjustmentConfig(focal_prior_fraction=0.5)
    result = adjust_bundle(seen, Cameras(poses, guess, np.zeros(FRAMES)), guess, settings, Freedom(True, True), run=run)
    sigma = float(np.sqrt(result.intrinsics_covariance[0, 0]) / result.cameras.intrinsics[0])
    hardly_damped, damped = ends[-1]
    assert hardly_damped < 0.3 * sigma
    assert damped > 0.5 * sigma


def test_isolated_landmarks_are_dropped_and_counted(rng: np.random.Generator) -> None:
    points = static_points(rng, TRACKS)
    points[0] = [0.0, 0.0, 60.0]
    result = adjust(static_observations(observe(points, POSES)), POSES)
    assert result.dropped["landmark far from its neighbors"] >= 1
    assert 0 not in result.landmark_track
    assert len(result.landmarks) == len(result.landmark_track) == len(result.landmark_error)
    np.testing.assert_array_equal(np.unique(result.observations.track), result.landmark_track)


def test_tracks_that_are_short_or_without_depth_are_dropped_and_counted(exact: LabelledTracks) -> None:
    hidden = np.zeros((TRACKS, FRAMES), bool)
    hidden[:7, 2:] = True
    depth = exact.depth.copy()
    depth[10:15] = np.nan
    labelled = hide(dataclasses.replace(exact, depth=depth), hidden)
    result = adjust(static_observations(labelled), POSES)
    assert result.dropped["track with too few observations"] == 7
    assert result.dropped["track without depth"] == 5
    assert not set(result.landmark_track.tolist()) & {*range(7), *range(10, 15)}


def test_nothing_liftable_is_an_error(exact: LabelledTracks) -> None:
    none = dataclasses.replace(exact, depth=np.full_like(exact.depth, np.nan))
    with pytest.raises(DegenerateProblemError, match="no static track has depth in any frame and is seen in 3 frames"):
        adjust(static_observations(none), POSES)


def test_noise_is_measured(exact: LabelledTracks, rng: np.random.Generator) -> None:
    noisy = shift(exact, rng.normal(scale=0.7, size=exact.tracks.uv.shape))
    depth = (noisy.depth * np.exp(rng.normal(scale=0.04, size=noisy.depth.shape))).astype(np.float32)
    result = adjust(static_observations(dataclasses.replace(noisy, depth=depth)), POSES)
    # Residuals are smaller than the noise by what the landmarks and poses absorb of it.
    assert 0.7 * 0.7 < result.noise.reprojection_sigma_px < 0.7
    assert 0.7 * 0.04 < result.noise.depth_sigma < 1.1 * 0.04
    assert 0.6 * 0.7 < np.median(result.landmark_error) / np.sqrt(2.0 * np.log(2.0)) < 0.7


def test_the_error_of_a_landmark_is_the_median_of_its_reprojection_errors(exact: LabelledTracks) -> None:
    offset = np.zeros((TRACKS, FRAMES, 2))
    offset[3, :, 0] = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 7.0]
    config = changed(structure="keep", measure_noise=False)
    result = adjust(static_observations(shift(exact, offset)), POSES, config, poses_free=False)
    error = result.landmark_error[result.landmark_track == 3]
    assert 0.1 < error[0] < 0.5
    assert np.delete(result.landmark_error, 3).max() < 0.05


def test_relifted_landmarks_are_the_mean_of_the_lifted_depth(exact: LabelledTracks) -> None:
    depth = exact.depth.copy()
    depth[4, 3] *= 1.1
    observations = static_observations(dataclasses.replace(exact, depth=depth))
    result = adjust(observations, POSES, changed(structure="relift"), poses_free=False)
    ray = (WORLD[4] - POSES[3, :3, 3]) * 0.1
    np.testing.assert_allclose(result.landmarks[4], WORLD[4] + ray / FRAMES, atol=1e-3)


def test_no_solve_raises_its_energy(exact: LabelledTracks, start: np.ndarray, rng: np.random.Generator) -> None:
    noisy = shift(exact, rng.normal(scale=1.0, size=exact.tracks.uv.shape))
    for energy in (MAP, PaperEnergy()):
        result = adjust(static_observations(noisy), start, intrinsics_free=True, energy=energy)
        assert len(result.solves) == (4 if energy.is_likelihood else 1)
        for solve in result.solves:
            assert solve.final_energy <= solve.initial_energy


def test_stopping_skips_the_solves_that_follow(exact: LabelledTracks, start: np.ndarray) -> None:
    asked = iter(range(100))
    result = adjust(static_observations(exact), start, hooks=Hooks(should_stop=lambda: next(asked) >= 1))
    assert [solve.termination for solve in result.solves] == [Termination.CANCELLED]


def test_the_motion_prior_alone_places_a_frame_without_tracks(exact: LabelledTracks) -> None:
    config = changed(camera_motion=CameraMotionConfig(rotation_weight=1.0, translation_weight=1.0).model_dump())
    result = adjust(static_observations(hide(exact, np.arange(FRAMES) == 4)), POSES, config)
    middle = 0.5 * (result.cameras.world_T_cam[3, :3, 3] + result.cameras.world_T_cam[5, :3, 3])
    step = np.linalg.norm(result.cameras.world_T_cam[5, :3, 3] - result.cameras.world_T_cam[3, :3, 3])
    assert np.linalg.norm(result.cameras.world_T_cam[4, :3, 3] - middle) < 0.25 * step


def test_covariances_allow_for_a_focal_length_that_is_held_and_known_to_some_part(
    exact: LabelledTracks, start: np.ndarray, rng: np.random.Generator
) -> None:
    noisy = static_observations(shift(exact, rng.normal(scale=0.01, size=(TRACKS, FRAMES, 2)).astype(np.float32)))
    config, sigma = changed(depth_prior=False, covariance_cells=0), 0.02

    def held(intrinsics: np.ndarray, focal_sigma: float | None) -> StaticScene:
        return adjust_bundle(
            noisy, Cameras(start, intrinsics, np.zeros(FRAMES)), K, config, Freedom(True, False),
            focal_sigma=focal_sigma,
        )  # fmt: skip

    known, unsure = held(K, None), held(K, sigma)
    np.testing.assert_array_equal(unsure.cameras.world_T_cam, known.cameras.world_T_cam)
    np.testing.assert_array_equal(held(K, 0.0).pose_covariance, known.pose_covariance)
    focal = np.sqrt(np.diag(unsure.intrinsics_covariance))
    np.testing.assert_allclose(focal[:2], sigma * K[:2], rtol=1e-2)
    np.testing.assert_array_equal(focal[2:], 0.0)
    # What is added is how the poses follow the focal lengths: by finite differences, solved anew.
    step = 1e-3 * np.array([1.0, 1.0, 0.0, 0.0])
    ends = [held(K * (1.0 + sign * step), None).cameras.world_T_cam for sign in (1.0, -1.0)]
    follows = se3.se3_log(np.linalg.inv(ends[1]) @ ends[0]) / 2e-3
    added = np.sqrt(np.diagonal(unsure.pose_covariance - known.pose_covariance, axis1=1, axis2=2))
    large = np.abs(follows) > 0.1 * np.abs(follows).max()
    np.testing.assert_allclose(added[large], sigma * np.abs(follows)[large], rtol=0.1)


def test_what_moves_by_little_is_trimmed_by_the_noise_of_the_others(
    exact: LabelledTracks, start: np.ndarray, rng: np.random.Generator
) -> None:
    """Its tracks stay below every limit in pixels."""
    offset = rng.normal(scale=0.1, size=(TRACKS, FRAMES, 2))
    moves = np.arange(TRACKS) < 20
    offset[moves, :, 0] += 1.5 * np.sin(np.arange(FRAMES))
    seen = static_observations(shift(exact, offset.astype(np.float32)))
    kept, trimmed = (adjust(seen, start, changed(trim_sigmas=sigmas)) for sigmas in (None, 3.0))
    assert np.isin(kept.landmark_track, np.flatnonzero(moves)).sum() == 20
    assert trimmed.dropped["landmark that departs from the others"] == 20
    assert not np.isin(trimmed.landmark_track, np.flatnonzero(moves)).any()
