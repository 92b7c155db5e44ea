"""Tracks that are fragments of one point: how many are found, how many rightly, and what a solve makes of them."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.config.rejoin import RejoinConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.synthetic.occlusion import Occluded, pass_bar
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.association.candidates import Candidates, find_candidates, landmark_covariances
from uni4d_fg.slam.association.fragments import FragmentSearch, group_pairs, pair_probability
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.merging import merge_tracks
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise, StaticScene
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver

HIDDEN = 15


@dataclasses.dataclass
class Solved:
    """A solve of stages 1 and 2, and what its search for fragments saw and said."""

    scene: StaticScene
    state: State
    observations: Observations
    noise: StaticNoise
    name: np.ndarray


@functools.cache
def occluded() -> tuple[Sequence, Occluded]:
    pytest.importorskip("open3d")
    whole = make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=48, height=156, width=208, focal=195.0, objects="none", grid_columns=21, grid_rows=16
        )
    )
    return whole, pass_bar(whole, HIDDEN, first=4)


def solve(sequence: Sequence, *, searching: bool, images: np.ndarray | None = None) -> Solved:
    config = load_config()
    assert sequence.tracks is not None
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    if images is not None:
        sequence = dataclasses.replace(sequence, images=ArrayFrames(images))
    search = FragmentSearch.of(sequence, labelled, RejoinConfig(enabled="auto" if searching else "off"))
    asked: list[tuple[State, Observations, StaticNoise, np.ndarray]] = []

    def keep(state: State, observations: Observations, noise: StaticNoise) -> np.ndarray:
        assert search is not None
        asked.append((state, observations, noise, search(state, observations, noise)))
        return asked[-1][-1]

    solver = StaticSceneSolver(config, find_fragments=None if search is None else keep)
    start = solver.initialize(labelled, sequence.intrinsics, free_intrinsics=True)
    scene = solver.adjust(labelled, start.cameras, sequence.intrinsics, Freedom(poses=True, intrinsics=True))
    if not asked:
        asked.append((scene.state(), scene.observations, scene.noise, scene.landmark_track))
    return Solved(scene, *asked[0])


@functools.cache
def joined() -> Solved:
    return solve(occluded()[1].sequence, searching=True)


def test_bar_hides_every_track_for_its_frames() -> None:
    whole, seen = occluded()
    before, after = (seen.sequence.tracks.visible[rows] for rows in (seen.earlier, seen.later))
    assert not (before & after).any()
    last, first = before.shape[1] - 1 - before[:, ::-1].argmax(axis=1), after.argmax(axis=1)
    assert (first > last).all()
    # Visible observations drop out and the camera moves: a point that stands still misses HIDDEN frames.
    assert abs(np.median(first - last - 1) - HIDDEN) <= 4
    assert seen.sequence.tracks.visible.sum() < whole.tracks.visible.sum()


def shares(seen: Occluded, result: Solved) -> tuple[float, float]:
    """Recall and precision of the joins, against which tracks are one material point."""
    track = result.observations.rows()[0]
    there = np.isin(seen.earlier, track) & np.isin(seen.later, track)
    assert there.sum() > 500
    origin = np.arange(int(track.max()) + 1)
    origin[seen.later[there]] = seen.earlier[there]
    changed = result.name != track
    right = origin[track[changed]] == origin[result.name[changed]]
    return float(right.sum() / there.sum()), float(right.mean())


def test_joins_are_right_even_where_points_are_dense_and_few_pixels_are_left() -> None:
    recall, precision = shares(occluded()[1], joined())
    assert precision >= 0.99
    assert recall >= 0.55


def test_where_no_track_was_cut_auto_compares_nothing() -> None:
    whole = occluded()[0]
    result = solve(whole, searching=True, images=np.zeros((0, 1, 1), np.uint8))
    assert np.array_equal(result.name, result.observations.rows()[0])
    assert result.scene.joined == 0


@pytest.mark.slow
def test_points_seen_again_are_joined_and_joined_rightly() -> None:
    pytest.importorskip("open3d")
    seen = pass_bar(make_synthetic_sequence(SyntheticSceneConfig(num_frames=60, seed=1)), HIDDEN)
    recall, precision = shares(seen, solve(seen.sequence, searching=True))
    assert precision >= 0.99
    assert recall >= 0.70


def test_joined_tracks_share_a_point_and_keep_their_names() -> None:
    scene = joined().scene
    name = dict(zip(joined().observations.rows()[0].tolist(), joined().name.tolist(), strict=True))
    assert scene.joined == sum(track != point for track, point in name.items())
    np.testing.assert_array_equal(scene.observations.rows()[0], scene.landmark_track)
    assert (np.diff(scene.observations.track) >= 0).all()
    points: dict[int, np.ndarray] = {}
    for track, landmark in zip(scene.landmark_track.tolist(), scene.landmarks, strict=True):
        np.testing.assert_array_equal(landmark, points.setdefault(name[track], landmark))
    assert len(points) < len(scene.landmark_track) - 300


def test_joins_bring_the_cameras_nearer_to_those_of_tracks_that_were_never_cut() -> None:
    whole, seen = occluded()
    truth = whole.ground_truth.world_T_cam
    assert truth is not None
    apart = solve(seen.sequence, searching=False).scene
    ates = [evaluate_trajectory(scene.cameras.world_T_cam, truth).ate_m for scene in (apart, joined().scene)]
    assert ates[1] < 0.9 * ates[0]


def test_nothing_is_joined_where_patches_say_nothing() -> None:
    sequence = occluded()[1].sequence
    flat = np.full((sequence.num_frames, *sequence.image_size, 3), 128, np.uint8)
    assert solve(sequence, searching=True, images=flat).scene.joined == 0


def test_nothing_is_joined_where_images_differ(rng: np.random.Generator) -> None:
    sequence = occluded()[1].sequence
    noise = rng.integers(0, 255, (sequence.num_frames, *sequence.image_size, 3)).astype(np.uint8)
    found = solve(sequence, searching=True, images=noise)
    assert found.scene.joined <= 0.01 * len(found.scene.landmarks)


def test_candidates_are_never_seen_together_and_lie_in_order() -> None:
    result = joined()
    pairs = find_candidates(result.state, result.observations, result.noise, RejoinConfig())
    _, row = result.observations.rows()
    frames = [set(result.observations.frame[row == n].tolist()) for n in range(int(row.max()) + 1)]
    some = np.linspace(0, len(pairs) - 1, 200).astype(int)
    for a, b in zip(pairs.earlier[some].tolist(), pairs.later[some].tolist(), strict=True):
        assert not frames[a] & frames[b]
        assert min(frames[a]) < min(frames[b])


def test_covariance_of_landmarks_is_the_spread_over_noise(rng: np.random.Generator) -> None:
    """Linear least squares over repeated noise, with cameras held, against the formula."""
    poses = np.repeat(np.eye(4)[None], 6, axis=0)
    poses[:, 0, 3] = np.linspace(0.0, 0.5, 6)
    intrinsics = np.array([200.0, 200.0, 100.0, 80.0])
    point = np.array([0.2, -0.1, 3.0])
    x = point - poses[:, :3, 3]
    uv = intrinsics[:2] * x[:, :2] / x[:, 2:] + intrinsics[2:]
    frame = np.arange(6)
    weight = np.linspace(0.5, 1.0, 6)
    observations = Observations(np.zeros(6, np.int64), frame, uv, np.full(6, np.nan), weight)
    state = Cameras(poses, intrinsics, np.zeros(6)).state(point[None], np.array([0]))
    sigma = 0.4
    found = landmark_covariances(state, observations, StaticNoise(sigma, 0.02))[0]
    z = x[:, 2]
    rows = np.zeros((12, 3))
    rows[0::2, 0], rows[0::2, 2] = intrinsics[0] / z, -intrinsics[0] * x[:, 0] / z**2
    rows[1::2, 1], rows[1::2, 2] = intrinsics[1] / z, -intrinsics[1] * x[:, 1] / z**2
    root = np.repeat(np.sqrt(weight), 2) / sigma
    solution = np.linalg.pinv(rows * root[:, None])
    spread = np.cov(solution @ rng.normal(size=(12, 40000)))
    np.testing.assert_allclose(found, spread, rtol=0.05, atol=0.02 * spread.max())


def test_probability_of_a_pair_is_against_all_pairs_of_both_tracks() -> None:
    pairs = Candidates(np.array([0, 0, 1, 2]), np.array([5, 6, 5, 7]), np.zeros(4))
    likelihood = np.array([0.8, 0.1, 0.3, 0.2])
    found = pair_probability(pairs, -2.0 * np.log(likelihood))
    np.testing.assert_allclose(found, [0.8 / 1.2, 0.1 / 0.9, 0.3 / 1.1, 1.0])


def test_groups_are_chains_without_common_frames() -> None:
    track = np.array([0, 0, 1, 1, 2, 2, 3])
    frame = np.array([0, 6, 2, 3, 4, 5, 6])
    observations = Observations(track, frame, np.zeros((7, 2)), np.zeros(7), np.ones(7))
    pairs = Candidates(np.array([0, 1, 2]), np.array([1, 2, 3]), np.zeros(3))
    # 3 is seen in frame 6, as 0 is.
    np.testing.assert_array_equal(group_pairs(pairs, observations), [0, 0, 0, 3])


def test_merge_and_split_are_inverse() -> None:
    track, frame = np.array([2, 2, 4, 7, 7, 7]), np.array([3, 4, 1, 0, 1, 2])
    weight = np.array([0.5, 0.5, 1.0, 1.0, 1.0, 1.0])
    observations = Observations(track, frame, np.arange(12.0).reshape(6, 2), np.ones(6), weight)
    cameras = Cameras(np.repeat(np.eye(4)[None], 5, axis=0), np.ones(4), np.zeros(5))
    state = cameras.state(np.array([[0.0, 0, 1], [5, 5, 5], [4, 0, 1]]), np.array([2, 4, 7]))
    merged_state, merged, who = merge_tracks(state, observations, np.array([2, 4, 2]))
    np.testing.assert_array_equal(merged.track, [2, 2, 2, 2, 2, 4])
    np.testing.assert_array_equal(merged.frame, [0, 1, 2, 3, 4, 1])
    np.testing.assert_allclose(merged_state[LANDMARK], [[3.0, 0, 1], [5, 5, 5]])  # weights 1 and 3
    scene = StaticScene(
        cameras, merged_state[LANDMARK], np.array([2, 4]), merged, StaticNoise(1.0, 1.0),
        np.array([0.1, 0.2], np.float32), np.zeros((5, 6, 6)), np.zeros((4, 4)),
    )  # fmt: skip
    back = who.split(scene)
    assert back.joined == 1
    np.testing.assert_array_equal(back.landmark_track, [2, 4, 7])
    np.testing.assert_allclose(back.landmarks, [[3.0, 0, 1], [5, 5, 5], [3, 0, 1]])
    for name in ("track", "frame", "uv", "depth", "weight"):
        np.testing.assert_array_equal(getattr(back.observations, name), getattr(observations, name))
