"""The start of structure from motion: what competes, what is taken out, and what is said to be open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cues.start_scenes import GUESS, SIZE, K, TrackedScene, camera_path, forward, sideways, tracked

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.cues.structure.epipolar import epipolar_geometry
from uni4d_fg.cues.structure.first_pair import CommonTracks, FramePair
from uni4d_fg.cues.structure.focal_interval import FocalInterval, clustered_deviation, design_effect, focal_interval
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.growth import grow, misfits
from uni4d_fg.cues.structure.motion import Structure, only_turns, structure_from_motion
from uni4d_fg.cues.structure.rivals import rotation_difference
from uni4d_fg.cues.structure.two_view import parallax
from uni4d_fg.geometry import se3
from uni4d_fg.progress import SilentReporter
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory

CONFIG = load_config("default", [])
FRAMES = 20


def found(scene: TrackedScene, config: Config = CONFIG) -> Structure:
    structure = structure_from_motion(
        scene.observations, len(scene.world_T_cam), SIZE, GUESS, config, SilentReporter(), lambda: False
    )
    assert structure is not None
    return structure


def error_of(structure: Structure, scene: TrackedScene) -> tuple[float, float]:
    """ATE as a part of the path's extent, and degrees per frame."""
    metrics = evaluate_trajectory(structure.world_T_cam, scene.world_T_cam)
    extent = np.linalg.norm(np.ptp(scene.world_T_cam[:, :3, 3], axis=0))
    assert metrics.rpe_rotation_deg is not None
    return metrics.ate_m / extent, metrics.rpe_rotation_deg


@pytest.mark.parametrize("seed", [0])
def test_a_large_thing_near_the_camera_does_not_become_the_world(seed: int) -> None:
    scene = tracked(sideways(FRAMES), seed, points=1500, moving=350)
    share = scene.moves[scene.observations.track].mean()
    assert share > 0.35  # and as much of the picture
    structure = found(scene)
    path, turn = error_of(structure, scene)
    assert path < 0.01
    assert turn < 0.1
    np.testing.assert_allclose(structure.intrinsics[:2], K[:2], rtol=0.03)
    assert structure.focal.low <= K[0] <= structure.focal.high


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_camera_that_is_held_by_somebody_who_stands_is_found(seed: int) -> None:
    """It sways by a hundredth of the distance, so that nothing is nearer than 40 times what it moves."""
    poses = camera_path(FRAMES, (0.03, -0.02, 0.02), (0.0, 0.03, 0.0))
    scene = tracked(poses, seed, noise_px=0.1, life=FRAMES)
    structure = found(scene, load_config("default", ["geometric_depth.min_parallax_px=0.4"]))
    path, turn = error_of(structure, scene)
    assert path < 0.015
    assert turn < 0.02
    np.testing.assert_allclose(structure.intrinsics[:2], K[:2], rtol=0.01)
    assert structure.focal.low <= K[0] <= structure.focal.high


def test_tracks_of_the_thing_disagree_with_the_picture() -> None:
    scene = tracked(sideways(FRAMES), 3, points=1500, moving=350, size=0.6)
    tracks, _ = scene.observations.rows()
    outlier = epipolar_geometry(scene.observations, FRAMES, SIZE, CONFIG.geometric_depth).outlier
    moves = scene.moves[tracks]
    assert outlier[moves].mean() > 0.6
    assert outlier[~moves].mean() < 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_forward_motion_leaves_the_focal_length_open_in_an_interval_that_holds_it(seed: int) -> None:
    scene = tracked(forward(FRAMES), seed, noise_px=0.5)
    structure = found(scene)
    below, above = structure.focal.relative(float(structure.intrinsics[0]))
    assert above - below > 0.04
    assert structure.focal.low <= K[0] <= structure.focal.high


def test_what_motion_leaves_open_is_weighed_with_what_cameras_usually_have() -> None:
    scene = tracked(forward(FRAMES), 0, noise_px=0.5)
    structure = found(scene)
    assert structure.focal.is_wide
    weight = 0.3**2 / (0.3**2 + structure.focal.deviation**2)
    told = np.exp((np.log(structure.intrinsics[0]) - (1 - weight) * np.log(GUESS[0])) / weight)
    tight = CONFIG.geometric_depth.model_copy(update={"focal_log_sigma": 1e-3})
    usual = found(scene, CONFIG.model_copy(update={"geometric_depth": tight}))
    free = CONFIG.geometric_depth.model_copy(update={"focal_log_sigma": 1e3})
    alone = found(scene, CONFIG.model_copy(update={"geometric_depth": free}))
    assert usual.intrinsics[0] == pytest.approx(GUESS[0], rel=1e-4)
    assert alone.intrinsics[0] == pytest.approx(told, rel=1e-4)
    assert usual.sigma_px < 1.2 * alone.sigma_px  # points and cameras have followed
    for structure in (usual, alone):
        assert structure.focal.low <= structure.intrinsics[0] <= structure.focal.high
        assert error_of(structure, scene)[0] < 0.02


def test_a_focal_length_of_which_tracks_say_nothing_is_the_usual_one() -> None:
    interval = FocalInterval(100.0, 900.0, True, True, float("nan"))
    assert interval.is_wide
    assert interval.likely(700.0, 500.0, 0.3) == 500.0
    assert interval.likely_sigma(0.3) == 0.3
    half = FocalInterval(100.0, 900.0, deviation=0.3)
    assert half.likely(800.0, 200.0, 0.3) == pytest.approx(400.0)
    assert half.likely_sigma(0.3) == pytest.approx(0.3 / np.sqrt(2.0))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_turning_camera_tells_the_focal_length(seed: int) -> None:
    structure = found(tracked(sideways(FRAMES), seed))
    below, above = structure.focal.relative(float(structure.intrinsics[0]))
    assert above - below < 0.2
    assert structure.focal.low <= K[0] <= structure.focal.high


def scene_of(tracks: TrackedScene, intrinsics: np.ndarray = K) -> GrowingScene:
    return GrowingScene.empty(
        tracks.observations, FRAMES, intrinsics, CONFIG, free_focal=True, prior_intrinsics=intrinsics,
        should_stop=lambda: False,
    )  # fmt: skip


def test_views_that_fit_badly_are_taken_out_and_posed_again() -> None:
    tracks = tracked(sideways(FRAMES), 5)
    scene = scene_of(tracks)
    assert scene.start(FramePair(4, 12, 30.0, 200)) > 50
    grow(scene, SilentReporter())
    assert scene.registered.all()
    assert len(misfits(scene)) == 0
    right = scene.world_T_cam.copy()
    scene.world_T_cam[9, :3, :3] = right[9, :3, :3] @ se3.so3_exp(np.array([0.0, 0.2, 0.1]))
    scene.world_T_cam[17, :3, 3] += 0.3
    scene._judge()
    np.testing.assert_array_equal(misfits(scene), [9, 17])
    scene.take_out(misfits(scene))
    assert not scene.registered[[9, 17]].any()
    grow(scene, SilentReporter())
    assert scene.registered.all()
    degrees, _ = rotation_difference(scene.world_T_cam, right, np.arange(FRAMES))
    assert degrees < 0.05
    np.testing.assert_allclose(scene.world_T_cam[[9, 17]], right[[9, 17]], atol=0.01)


def test_judging_what_has_changed_is_judging_all() -> None:
    scene = scene_of(tracked(sideways(FRAMES), 5))
    assert scene.start(FramePair(4, 12, 30.0, 200)) > 50
    for _ in range(4):
        frame = scene.next_frame(set())
        assert frame is not None
        assert scene.register(frame)
        good, position = scene.good.copy(), scene.position.copy()
        scene._judge()
        np.testing.assert_array_equal(scene.good, good)
        np.testing.assert_array_equal(scene.position, position)
    assert np.count_nonzero(scene.good) > 1000


def test_errors_that_are_alike_count_once(rng: np.random.Generator) -> None:
    group = np.repeat(np.arange(300), 10)
    alone = rng.normal(0, 1, (3000, 2))
    assert design_effect(alone, group) == pytest.approx(1.0, abs=0.15)
    alike = np.repeat(rng.normal(0, 1, (300, 2)), 10, axis=0)
    assert design_effect(alike, group) == pytest.approx(10.0, rel=0.02)


def test_a_held_focal_length_is_not_open() -> None:
    scene = scene_of(tracked(sideways(FRAMES), 7))
    scene.free_focal = False
    scene.start(FramePair(4, 12, 30.0, 200))
    grow(scene, SilentReporter())
    interval = focal_interval(scene, SIZE)
    assert interval.low == interval.high == pytest.approx(K[0])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_tracks_of_one_part_of_the_image_that_drift_alike_widen_the_interval(seed: int) -> None:
    scene = tracked(sideways(FRAMES), seed)
    seen = scene.observations
    tracks, row = seen.rows()
    first = np.searchsorted(row, np.arange(len(tracks)))
    column, line = (seen.uv[first] // 60).astype(int).clip(0, 15).T
    drift = np.random.default_rng(seed).normal(0, 0.06, (16, 16, 2))[column, line]
    uv = seen.uv + drift[row] * (seen.frame - seen.frame[first][row])[:, None]
    growth, width = [], []
    for observations in (seen, replace(seen, uv=uv)):
        grown = scene_of(replace(scene, observations=observations))
        grown.start(FramePair(4, 12, 30.0, 200))
        grow(grown, SilentReporter())
        grown.measure_noise()
        stage, state, _, _ = grown.bundle()
        growth.append(clustered_deviation(grown, stage, state) / grown.focal_deviation())
        interval = focal_interval(grown, SIZE)
        assert interval.low < K[0] < interval.high
        width.append(interval.high / interval.low - 1.0)
    assert 0.6 < growth[0] < 1.4  # independent errors: as the model says
    assert growth[1] > 1.6
    assert width[1] > 2 * width[0]


@pytest.mark.parametrize("factor", [0.8, 0.893, 1.0, 1.12, 1.3])
def test_a_rotation_leaves_little_whatever_the_guess(factor: float) -> None:
    """Turned by 30 degrees, the factors of 1.26 alone would leave pixels between two of them."""
    poses = camera_path(2, (0.0, 0.0, 0.0), (0.0, -0.5, 0.0))
    seen = tracked(poses, 0, noise_px=0.2).observations
    a, b = CommonTracks(seen, 2).between(0, 1)
    assert len(a) > 50
    left = parallax(seen.uv[a], seen.uv[b], K * np.array([factor, factor, 1.0, 1.0]), known_focal=False)
    assert left.median < 0.8
    assert left.upper < 1.2


def test_a_camera_that_only_turns_has_no_structure_at_the_focal_length_that_is_found() -> None:
    scene = tracked(camera_path(FRAMES, (0.0, 0.0, 0.0), (0.05, -0.4, 0.03)), 1)
    assert only_turns(scene_of(scene), scene.observations)
    long = K * np.array([1.5, 1.5, 1.0, 1.0])
    assert not only_turns(scene_of(scene, long), scene.observations)
    moving = tracked(sideways(FRAMES), 1)
    assert not only_turns(scene_of(moving), moving.observations)
