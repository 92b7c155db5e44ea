"""Starts of structure from motion that compete: what they are judged by, and the focal length they begin with."""

from __future__ import annotations

import numpy as np
import pytest
from cues.start_scenes import GUESS, SIZE, K, TrackedScene, camera_path, forward, sideways, tracked

from uni4d_fg.config.load import load_config
from uni4d_fg.cues.structure import hypotheses
from uni4d_fg.cues.structure.epipolar import epipolar_geometry
from uni4d_fg.cues.structure.first_pair import FramePair
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.hypotheses import Competition, Hypothesis, Part, distinct, ranked, trial_frames
from uni4d_fg.cues.structure.judging import HeldOut, errors_of, held_out
from uni4d_fg.cues.structure.self_calibration import FocalGuess, focal_of_pairs
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import intrinsics_matrix

CONFIG = load_config("default", [])
FRAMES = 20
PAIR = FramePair(5, 13, 30.0, 200)
TURNING = camera_path(FRAMES, (0.0, 0.0, 0.0), (0.05, -0.4, 0.03))


def scene_of(tracks: TrackedScene, intrinsics: np.ndarray = K) -> GrowingScene:
    return GrowingScene.empty(
        tracks.observations, FRAMES, intrinsics, CONFIG, free_focal=True, prior_intrinsics=intrinsics,
        should_stop=lambda: False,
    )  # fmt: skip


def with_cameras(tracks: TrackedScene, turned: float = 0.0) -> GrowingScene:
    """A scene with the true cameras, every second one turned about the view by a few degrees."""
    scene = scene_of(tracks, K)
    scene.registered[:] = True
    turns = se3.so3_exp(np.radians([[0.0, 0.0, turned * (frame % 2)] for frame in range(FRAMES)]))
    scene.world_T_cam[:] = tracks.world_T_cam
    scene.world_T_cam[:, :3, :3] = scene.world_T_cam[:, :3, :3] @ turns
    scene.triangulate_all()
    return scene


def start(errors_px: list[float], noise_px: float = 0.2, is_usual: bool = True, pair: FramePair = PAIR) -> Hypothesis:
    """A start with given errors of what was held out, alike in weight."""
    error = np.array(errors_px)
    scene = scene_of(tracked(sideways(FRAMES), 4, points=20))
    judged = HeldOut(error, np.ones(len(error)))
    left = judged.unexplained(CONFIG.geometric_depth.max_reprojection_px)
    return Hypothesis(pair, "majority", scene, np.arange(FRAMES), judged, noise_px, is_usual, left)


def competition_of(tracks: TrackedScene, guess: FocalGuess | None = None) -> Competition:
    nothing = np.zeros(len(tracks.observations), dtype=bool)
    return Competition(tracks.observations, nothing, FRAMES, SIZE, GUESS, CONFIG, True, lambda: False, guess)


def test_a_bad_pair_loses_and_an_unusual_focal_length_too(monkeypatch: pytest.MonkeyPatch) -> None:
    competition = competition_of(tracked(sideways(FRAMES), 4, points=60))
    pairs = [FramePair(3, 4, 2.0, 300), PAIR, FramePair(6, 19, 30.0, 100)]
    lost = {pairs[0]: 10, pairs[1]: 4, pairs[2]: 2}  # of 20 errors
    tried = []

    def trial(pair: FramePair, factor: float, part: Part) -> Hypothesis:
        tried.append((pair, factor))
        errors = [np.inf] * lost[pair] + [0.0] * (20 - lost[pair])
        return start(errors, is_usual=pair != pairs[2], pair=pair)

    monkeypatch.setattr(competition, "pairs", lambda _: pairs)
    monkeypatch.setattr(competition, "trial", trial)
    monkeypatch.setattr(hypotheses, "thread_count", lambda: 1)  # so that they are tried in their order
    assert [h.pair for h in competition.run()] == [pairs[1], pairs[1], pairs[1], pairs[2], pairs[0]]
    # Other focal lengths are tried from the best pair.
    assert tried[3:] == [(pairs[1], 0.75), (pairs[1], 1.4)]


def test_trials_side_by_side_end_as_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks = tracked(sideways(FRAMES), 4, points=80)
    found = []
    for count in (1, 3):
        monkeypatch.setattr(hypotheses, "thread_count", lambda count=count: count)
        found.append(competition_of(tracks).run())
    alone, together = found
    assert len(alone) > 2
    assert [one.pair for one in alone] == [one.pair for one in together]
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one.scene.world_T_cam, other.scene.world_T_cam)
        np.testing.assert_array_equal(one.scene.position, other.scene.position)
        assert one.misfit == other.misfit


@pytest.mark.parametrize("enough", [100, 15])
def test_where_wide_pairs_fail_those_with_the_most_common_tracks_are_tried(
    enough: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a camera turns fast, tracks are short: a wide baseline has dozens, and a trial takes a part of them."""
    competition = competition_of(tracked(sideways(FRAMES), 4, points=60))
    wide = [FramePair(3 * k, 3 * k + 3, 90.0, 55 - k) for k in range(5)]
    near = [FramePair(3 * k, 3 * k + 1, 6.0, 600 - k) for k in range(6)]
    tried = []

    def trial(pair: FramePair, factor: float, part: Part) -> Hypothesis | None:
        tried.append(pair)
        return start([0.0] * 20, pair=pair) if pair.common >= enough else None

    monkeypatch.setattr(competition, "pairs", lambda _: [*wide, *near])
    monkeypatch.setattr(competition, "trial", trial)
    monkeypatch.setattr(hypotheses, "thread_count", lambda: 1)  # so that they are tried in their order
    assert competition.run()[0].pair == (near if enough == 100 else wide)[0]
    count = CONFIG.geometric_depth.tried_pairs
    expected = [*wide[:count], *near[:count]] if enough == 100 else wide[:count]
    assert tried[: len(expected)] == expected
    assert len(tried) == len(expected) + 2  # and the best of them with other focal lengths


@pytest.mark.parametrize(
    ("guess", "first", "later"),
    [
        (None, 1.0, [0.75, 1.4]),
        (FocalGuess(240.0, is_agreed=True), 0.75, [1.0, 0.75, 1.4]),
        (FocalGuess(256.0, is_agreed=False), 1.0, [0.75, 1.4, 0.8]),
    ],
    ids=["none", "agreed", "doubtful"],
)
def test_where_pairs_agree_on_the_focal_length_all_starts_begin_with_it(
    guess: FocalGuess | None, first: float, later: list[float]
) -> None:
    factors = competition_of(tracked(sideways(FRAMES), 4, points=60), guess).factors()
    np.testing.assert_allclose(factors, [first, *later])


def test_explaining_some_to_the_noise_is_more_than_explaining_much_to_some_pixels() -> None:
    """As a person at arm's length makes scenes that fit them and what is behind them, each by a pixel."""
    bent = start([0.9] * 14 + [np.inf] * 6, noise_px=0.8, pair=FramePair(0, 9, 30.0, 100))
    world = start([0.2] * 11 + [np.inf] * 9, noise_px=0.2)
    assert bent.held_out.unexplained(4.0) < world.held_out.unexplained(4.0)
    best, other = ranked([bent, world])
    assert best.pair == world.pair
    assert best.misfit == pytest.approx((11 * (0.2 / 0.6) ** 2 + 9) / 20)
    assert other.misfit == pytest.approx(1.0)


def test_the_noise_of_tracks_is_not_told_by_a_start_that_explains_few() -> None:
    few = start([0.01] * 3 + [np.inf] * 17, noise_px=0.01, pair=FramePair(0, 9, 30.0, 100))
    many = start([0.2] * 16 + [np.inf] * 4, noise_px=0.2)
    best, other = ranked([few, many])
    assert best.pair == many.pair
    assert best.misfit == pytest.approx((16 * (0.2 / 0.6) ** 2 + 4) / 20)
    assert ranked([few])[0].misfit == pytest.approx(few.held_out.unexplained(4.0))
    assert other.misfit > best.misfit


def test_exact_tracks_are_judged_as_those_of_the_least_noise_that_is_believed() -> None:
    floor = CONFIG.bundle_adjustment.min_reprojection_sigma_px
    (best,) = ranked([start([0.0] * 10 + [1e-9] * 5 + [floor] * 5, noise_px=0.0)])
    assert best.misfit == pytest.approx(5 * (1 / 3) ** 2 / 20)


def test_cameras_that_only_turn_explain_tracks_without_points() -> None:
    tracks = tracked(TURNING, 1, noise_px=0.3)
    scene = with_cameras(tracks)
    assert np.isfinite(scene.position[:, 0]).mean() < 0.2  # rays that meet at no angle are no points
    assert np.median(errors_of(scene, tracks.observations)) < 0.5
    wrong = with_cameras(tracks, 2.0)
    assert np.median(errors_of(wrong, tracks.observations)) > 1.0


def test_true_cameras_explain_more_than_shaken_ones() -> None:
    tracks = tracked(sideways(FRAMES), 4, points=200)
    right, wrong = (HeldOut.of(with_cameras(tracks, turned), tracks.observations, SIZE) for turned in (0.0, 0.5))
    assert right.unexplained(1.0) < 0.4
    assert right.share_within(1.0) > 0.9
    assert wrong.unexplained(1.0) > right.unexplained(1.0) + 0.05


def test_every_part_of_the_picture_has_the_same_say() -> None:
    tracks = tracked(sideways(FRAMES), 4, points=200)
    first = np.flatnonzero(tracks.observations.frame == 3)
    judged = HeldOut.of(with_cameras(tracks), tracks.observations.select(np.repeat(first, 3)), SIZE)
    once = HeldOut.of(with_cameras(tracks), tracks.observations.select(first), SIZE)
    assert judged.unexplained(1.0) == pytest.approx(once.unexplained(1.0))
    assert judged.weight.sum() == pytest.approx(once.weight.sum())


def test_nothing_held_out_explains_nothing() -> None:
    nothing = HeldOut(np.zeros(0), np.zeros(0))
    assert nothing.unexplained(1.0) == 1.0
    assert nothing.share_within(1.0) == 0.0


def fundamental_of(poses: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Exact fundamental matrices (P, 3, 3) of all pairs three frames apart."""
    inverse = np.linalg.inv(intrinsics_matrix(intrinsics))
    found = []
    for first, second in zip(poses[:-3], poses[3:], strict=True):
        between = np.linalg.inv(second) @ first
        x, y, z = between[:3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        found.append(inverse.T @ cross @ between[:3, :3] @ inverse)
    return np.array(found)


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.7])
def test_exact_epipolar_geometry_tells_the_focal_length(factor: float) -> None:
    intrinsics = K * np.array([factor, factor, 1.0, 1.0])
    matrices = fundamental_of(sideways(FRAMES), intrinsics)
    scales = np.random.default_rng(0).choice([-3.0, 0.1, 5.0], len(matrices))  # none of them means anything
    guess = focal_of_pairs(matrices * scales[:, None, None], SIZE, K[2:])
    assert guess is not None
    assert guess.is_agreed
    assert guess.focal == pytest.approx(factor * K[0], rel=0.035)  # a step of the grid


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_tracks_of_a_turning_camera_tell_the_focal_length(seed: int) -> None:
    scene = tracked(sideways(FRAMES), seed, moving=200, size=0.6)
    matrices = epipolar_geometry(scene.observations, FRAMES, SIZE, CONFIG.geometric_depth).fundamental
    guess = focal_of_pairs(matrices, SIZE, GUESS[2:])
    assert guess is not None
    assert abs(np.log(guess.focal / K[0])) < abs(np.log(GUESS[0] / K[0]))


def test_few_pairs_or_pure_translation_tell_no_focal_length() -> None:
    matrices = fundamental_of(sideways(FRAMES), K)
    assert focal_of_pairs(matrices[:7], SIZE, K[2:]) is None
    assert focal_of_pairs(np.zeros((0, 3, 3)), SIZE, K[2:]) is None
    straight = np.tile(np.eye(4), (FRAMES, 1, 1))
    straight[:, 0, 3] = np.linspace(0, 1, FRAMES)  # F is skew: any focal length makes it essential
    guess = focal_of_pairs(fundamental_of(straight, K), SIZE, K[2:])
    assert guess is None or not guess.is_agreed


def test_forward_motion_does_not_agree_on_a_wrong_focal_length() -> None:
    scene = tracked(forward(FRAMES), 0, noise_px=0.5)
    matrices = epipolar_geometry(scene.observations, FRAMES, SIZE, CONFIG.geometric_depth).fundamental
    guess = focal_of_pairs(matrices, SIZE, GUESS[2:])
    assert guess is None or not guess.is_agreed


def test_frames_of_a_trial_hold_the_pair_and_lie_around_it() -> None:
    pair = FramePair(30, 46, 30.0, 100)
    frames = trial_frames(pair, 300, 8, 24)
    assert len(frames) == 24
    assert {30, 46} <= set(frames.tolist())
    assert frames[0] == 16
    assert frames[-1] == 62
    np.testing.assert_array_equal(trial_frames(FramePair(0, 2, 9.0, 50), 4, 8, 24), [0, 1, 2, 3])


def test_pairs_that_compete_lie_apart() -> None:
    pairs = [FramePair(a, b, 30.0, 100) for a, b in ((0, 10), (1, 11), (0, 9), (20, 30), (22, 30))]
    assert [(p.first, p.second) for p in distinct(pairs, 2)] == [(0, 10), (20, 30)]
    assert len(distinct(pairs, 4)) == 4


def test_what_is_held_out_leaves_both_ends_of_every_track() -> None:
    observations = tracked(sideways(FRAMES), 6, points=60).observations
    out = held_out(observations, 4)
    assert 0.12 < out.mean() < 0.25
    first = np.flatnonzero(np.diff(observations.track, prepend=-1))
    last = np.append(first[1:] - 1, len(observations) - 1)
    assert not out[first].any()
    assert not out[last].any()
