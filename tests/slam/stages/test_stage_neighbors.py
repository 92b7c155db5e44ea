"""Links of as-rigid-as-possible: nearest, within one instance, each once, none that is much too long."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.slam.stages.neighbors import nearest_neighbors


def still(points: np.ndarray, frames: int = 3) -> np.ndarray:
    return np.repeat(points[:, None], frames, axis=1)


def test_points_on_a_line_link_to_the_next_ones() -> None:
    points = np.zeros((5, 3))
    points[:, 0] = [0.0, 1.0, 2.1, 3.3, 4.6]
    pairs, _ = nearest_neighbors(still(points), np.ones((5, 3), bool), np.ones(5, np.int64), 1, 10.0)
    np.testing.assert_array_equal(pairs, [[0, 1], [1, 2], [2, 3], [3, 4]])


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 7), members=st.integers(0, 25))
def test_links_stay_within_an_instance_and_are_unique(seed: int, count: int, members: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(members, 4, 3))
    observed = rng.random((members, 4)) < 0.6
    instance = rng.integers(1, 4, members)
    pairs, _ = nearest_neighbors(points, observed, instance, count, 6.0)
    assert pairs.shape[1] == 2
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    np.testing.assert_array_equal(instance[pairs[:, 0]], instance[pairs[:, 1]])
    assert (observed[pairs[:, 0]] & observed[pairs[:, 1]]).any(axis=1).all()
    assert len(pairs) <= members * count


def test_links_much_longer_than_the_median_are_cut() -> None:
    points = np.zeros((6, 3))
    points[:, 0] = [0.0, 1.0, 2.0, 3.0, 4.0, 20.0]
    seen, instance = np.ones((6, 3), bool), np.ones(6, np.int64)
    near, _ = nearest_neighbors(still(points), seen, instance, 2, 6.0)
    far, _ = nearest_neighbors(still(points), seen, instance, 2, 1e6)
    assert 5 not in near
    assert 5 in far
    assert len(far) == len(near) + 2


def test_an_instance_far_away_does_not_raise_the_median_of_another() -> None:
    points = np.zeros((8, 3))
    points[:4, 0] = [0.0, 0.1, 0.2, 3.0]
    points[4:, 0] = [100.0, 110.0, 120.0, 130.0]
    instance = np.repeat([1, 2], 4)
    pairs, _ = nearest_neighbors(still(points), np.ones((8, 3), bool), instance, 1, 6.0)
    assert [2, 3] not in pairs.tolist()
    assert [4, 5] in pairs.tolist()


def test_the_search_uses_the_frame_with_most_company() -> None:
    points = np.zeros((4, 2, 3))
    points[:, 1, 0] = [0.0, 1.0, 2.0, 3.0]
    points[:, 0, 0] = [0.0, 50.0, 1.0, 60.0]
    observed = np.array([[True, True], [False, True], [True, True], [False, True]])
    pairs, _ = nearest_neighbors(points, observed, np.ones(4, np.int64), 1, 100.0)
    np.testing.assert_array_equal(pairs, [[0, 1], [1, 2], [2, 3]])


def test_trajectories_never_seen_together_are_not_linked() -> None:
    observed = np.array([[True, False], [False, True]])
    pairs, _ = nearest_neighbors(np.zeros((2, 2, 3)), observed, np.ones(2, np.int64), 3, 6.0)
    assert pairs.shape == (0, 2)


def test_coinciding_points_are_linked() -> None:
    pairs, _ = nearest_neighbors(np.zeros((3, 2, 3)), np.ones((3, 2), bool), np.ones(3, np.int64), 2, 6.0)
    np.testing.assert_array_equal(pairs, [[0, 1], [0, 2], [1, 2]])


def test_points_without_position_are_never_linked() -> None:
    points = np.zeros((3, 2, 3))
    points[1] = np.nan
    pairs, _ = nearest_neighbors(points, np.ones((3, 2), bool), np.ones(3, np.int64), 2, 6.0)
    np.testing.assert_array_equal(pairs, [[0, 2]])


def test_a_pair_of_which_each_is_a_neighbor_of_the_other_was_found_twice(rng: np.random.Generator) -> None:
    """Against neighbors by brute force: sorted distances, track by track."""
    points, count = rng.normal(size=(12, 3)), 3
    pairs, times = nearest_neighbors(still(points), np.ones((12, 3), bool), np.ones(12, np.int64), count, 1e6)
    directed = set()
    for k in range(12):
        distance = [np.linalg.norm(points[k] - points[m]) if m != k else np.inf for m in range(12)]
        directed |= {(k, int(m)) for m in np.argsort(distance)[:count]}
    expected = {tuple(sorted(pair)): ((pair in directed) + (pair[::-1] in directed)) for pair in directed}
    assert {tuple(pair): n for pair, n in zip(pairs.tolist(), times.tolist(), strict=True)} == expected
    assert times.sum() == 12 * count
    assert set(times.tolist()) == {1, 2}
