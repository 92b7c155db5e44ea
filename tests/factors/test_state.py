"""State: copying to and from ``gtsam.Values``, keys, retraction."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from uni4d_fg.errors import SolverError
from uni4d_fg.factors import factor, factor_type
from uni4d_fg.factors import variable as variables
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import (
    DYNAMIC_POINT,
    IMU_BIAS,
    INTRINSICS,
    LANDMARK,
    LOG_SCALE,
    OBJECT_POSE,
    POSE,
    VELOCITY,
    point_variable,
)
from uni4d_fg.geometry import se3
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.solve import solve


@pytest.fixture
def state(rng: np.random.Generator) -> State:
    return State(
        {
            POSE: se3.se3_exp(rng.normal(scale=0.4, size=(4, 6))),
            INTRINSICS: rng.uniform(300, 500, size=(1, 4)),
            LOG_SCALE: rng.normal(size=(4, 1)),
            LANDMARK: rng.normal(size=(5, 3)),
            DYNAMIC_POINT: rng.normal(size=(6, 3)),
            VELOCITY: rng.normal(size=(4, 3)),
            IMU_BIAS: rng.normal(size=(2, 6)),
        },
        {
            LANDMARK: np.array([3, 7, 8, 20, 21]),
            DYNAMIC_POINT: np.array([[1, 0], [1, 1], [1, 5], [9, 2], [9, 3], [9, 4]]),
            IMU_BIAS: np.array([0, 3]),
        },
    )


SIZE = 4 + 1 + 4 + 5 + 6 + 4 + 2


def test_values_round_trip(state: State) -> None:
    values = state.to_values()
    assert values.size() == SIZE
    blank = State({variable: np.zeros_like(a) for variable, a in state.arrays.items()}, state.index)
    back = blank.with_values(values)
    for variable, array in state.arrays.items():
        np.testing.assert_allclose(back[variable], array, rtol=1e-15, atol=1e-15)


def test_a_state_is_read_from_values_alone(state: State) -> None:
    back = State.from_values(state.to_values())
    assert set(back.arrays) == set(state.arrays)
    for variable, array in state.arrays.items():
        np.testing.assert_allclose(back[variable], array, rtol=1e-15, atol=1e-15)
        np.testing.assert_array_equal(back.numbers(variable), state.numbers(variable))
        assert back.keys(variable) == state.keys(variable)
    values = state.to_values()
    values.insert(gtsam.symbol("j", 3), np.zeros(2))
    with pytest.raises(ValueError, match=r"\(j3\) is of no declared variable type"):
        State.from_values(values)


def test_only_the_rows_asked_for_are_copied(state: State) -> None:
    values = state.to_values({LANDMARK: np.array([True, False, False, True, False]), POSE: np.zeros(4, dtype=bool)})
    assert sorted(values.keys()) == [LANDMARK.key(3), LANDMARK.key(20)]
    values.update(LANDMARK.key(20), np.full(3, 9.0))
    moved = state.with_values(values)
    np.testing.assert_array_equal(moved[LANDMARK][3], 9.0)
    np.testing.assert_array_equal(moved[LANDMARK][[0, 1, 2, 4]], state[LANDMARK][[0, 1, 2, 4]])
    np.testing.assert_array_equal(moved[POSE], state[POSE])


def test_retraction_is_that_of_values(state: State, rng: np.random.Generator) -> None:
    delta = {v: rng.normal(scale=0.5, size=(len(a), v.dim)) for v, a in state.arrays.items()}
    vector = gtsam.VectorValues()
    for variable, step in delta.items():
        for row in range(len(step)):
            wide = np.zeros(variable.gtsam_dim or variable.dim)
            wide[list(variable.gtsam_columns) or slice(None)] = step[row]
            vector.insert(state.key(variable, row), wide)
    expected = state.with_values(state.to_values().retract(vector))
    moved = state.retract(delta)
    for variable in state.arrays:
        np.testing.assert_allclose(moved[variable], expected[variable], atol=1e-12)


def test_a_state_is_immutable_and_shares_what_did_not_move(state: State) -> None:
    before = state[LANDMARK].copy()
    moved = state.retract({LANDMARK: np.ones((5, 3))})
    np.testing.assert_array_equal(state[LANDMARK], before)
    assert moved[POSE] is state[POSE]
    replaced = state.replace({LANDMARK: before})
    assert replaced[INTRINSICS] is state[INTRINSICS]
    assert replaced.key(LANDMARK, 3) == LANDMARK.key(20)


def test_numbers_default_to_rows() -> None:
    state = State({LANDMARK: np.zeros((2, 3)), DYNAMIC_POINT: np.zeros((2, 3))})
    assert state.key(LANDMARK, 1) == LANDMARK.key(1)
    assert state.key(DYNAMIC_POINT, 1) == DYNAMIC_POINT.key(1, 0)
    assert POSE not in state
    assert LANDMARK in state


def test_keys_of_all_rows_are_distinct(state: State) -> None:
    made = [state.key(variable, row) for variable, array in state.arrays.items() for row in range(len(array))]
    assert len(set(made)) == len(made) == SIZE
    assert made == [key for variable in state.arrays for key in state.keys(variable)]
    assert state.describe(DYNAMIC_POINT, 2) == "dynamic point, track 1, frame 5"


def test_rows_are_found_by_key(state: State) -> None:
    places = [(DYNAMIC_POINT, 4), (POSE, 0), (LANDMARK, 4), (POSE, 3), (IMU_BIAS, 1)]
    assert state.rows_of([state.key(variable, row) for variable, row in places]) == places
    for missing in (LANDMARK.key(4), gtsam.symbol("j", 0), DYNAMIC_POINT.key(1, 2)):
        with pytest.raises(KeyError, match=str(missing)):
            state.rows_of([POSE.key(0), missing])


def test_a_type_that_is_not_there_is_named(state: State) -> None:
    with pytest.raises(SolverError, match="the state has no object_pose variables, only pose, "):
        state[OBJECT_POSE]


def test_a_type_that_was_declared_anew_does_not_fit_an_old_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variables, "_REGISTERED", dict(variables._REGISTERED))
    first = point_variable("marker", "m", ("object",))
    held = State({first: np.zeros((2, 3))})
    again = point_variable("marker", "m", ("object",))

    @factor(again, dim=3, name="marker_position")
    def position(marker: np.ndarray) -> np.ndarray:
        return marker

    monkeypatch.delitem(factor_type._LISTED, "marker_position")
    problem = Problem.over(held).add(position([0, 1], sigma=0.1))
    prior = gtsam.PriorFactorPoint3(again.key(0), np.zeros(3), gtsam.noiseModel.Unit.Create(3))
    for attempt in (
        lambda: held[again],
        lambda: problem.energy(held),
        lambda: solve(problem, held),
        lambda: problem.add(prior, state=held),
    ):
        with pytest.raises(SolverError, match="'marker' was declared twice, and this state and what reads it hold"):
            attempt()
    np.testing.assert_array_equal(State({again: np.zeros((2, 3))})[again], held[first])
