"""State: copying to and from ``gtsam.Values``, names, retraction; Problem: what is free."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from uni4d_fg.geometry import se3
from uni4d_fg.graph import keys
from uni4d_fg.graph.problem import Problem, all_free
from uni4d_fg.graph.state import TANGENT_DIM, State, VariableNames


@pytest.fixture
def state(rng: np.random.Generator) -> State:
    groups = {
        "pose": se3.se3_exp(rng.normal(scale=0.4, size=(4, 6))),
        "intrinsics": rng.uniform(300, 500, size=(1, 4)),
        "log_scale": rng.normal(size=(4, 1)),
        "landmark": rng.normal(size=(5, 3)),
        "dynamic_point": rng.normal(size=(6, 3)),
    }
    names = VariableNames(
        landmark_track=np.array([3, 7, 8, 20, 21]),
        dynamic_track_frame=np.array([[1, 0], [1, 1], [1, 5], [9, 2], [9, 3], [9, 4]]),
    )
    return State(groups, names)


def test_values_round_trip(state: State) -> None:
    values = state.to_values()
    assert values.size() == 4 + 1 + 4 + 5 + 6
    blank = State({g: np.zeros_like(a) for g, a in state.groups.items()}, state.names)
    back = blank.with_values(values)
    for group, array in state.groups.items():
        np.testing.assert_allclose(back[group], array, rtol=1e-15, atol=1e-15)


def test_only_the_rows_asked_for_are_copied(state: State) -> None:
    values = state.to_values({"landmark": np.array([True, False, False, True, False]), "pose": np.zeros(4, dtype=bool)})
    assert sorted(values.keys()) == [keys.landmark_key(3), keys.landmark_key(20)]
    values.update(keys.landmark_key(20), np.full(3, 9.0))
    moved = state.with_values(values)
    np.testing.assert_array_equal(moved["landmark"][3], 9.0)
    np.testing.assert_array_equal(moved["landmark"][[0, 1, 2, 4]], state["landmark"][[0, 1, 2, 4]])
    np.testing.assert_array_equal(moved["pose"], state["pose"])


def test_retraction_is_that_of_values(state: State, rng: np.random.Generator) -> None:
    delta = {g: rng.normal(scale=0.5, size=(len(a), TANGENT_DIM[g])) for g, a in state.groups.items()}
    vector = gtsam.VectorValues()
    for group, step in delta.items():
        for row in range(len(step)):
            vector.insert(state.key(group, row), step[row])
    expected = state.with_values(state.to_values().retract(vector))
    moved = state.retract(delta)
    for group in state.groups:
        np.testing.assert_allclose(moved[group], expected[group], atol=1e-12)


def test_a_state_is_immutable_and_shares_what_did_not_move(state: State) -> None:
    before = state["landmark"].copy()
    moved = state.retract({"landmark": np.ones((5, 3))})
    np.testing.assert_array_equal(state["landmark"], before)
    assert moved["pose"] is state["pose"]
    assert state.replace(landmark=before)["intrinsics"] is state["intrinsics"]


def test_names_default_to_row_numbers() -> None:
    state = State({"landmark": np.zeros((2, 3)), "dynamic_point": np.zeros((2, 3))})
    assert state.key("landmark", 1) == keys.landmark_key(1)
    assert state.key("dynamic_point", 1) == keys.dynamic_point_key(1, 0)


def test_keys_of_all_rows_are_distinct(state: State) -> None:
    made = [state.key(group, row) for group, array in state.groups.items() for row in range(len(array))]
    assert len(set(made)) == len(made)
    assert str(keys.decode(state.key("dynamic_point", 2))) == "dynamic point, track 1, frame 5"


def test_problem_reports_what_is_free(state: State) -> None:
    free = all_free(state, "pose", "landmark")
    free["pose"][0] = False
    free["intrinsics"] = np.zeros((1, 4), dtype=bool)
    problem = Problem((), free)
    assert problem.is_free("pose")
    assert not problem.is_free("intrinsics")
    assert not problem.is_free("log_scale")
    rows = problem.free_rows()
    assert set(rows) == {"pose", "landmark"}
    np.testing.assert_array_equal(rows["pose"], [False, True, True, True])
