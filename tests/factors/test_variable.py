"""Variable types: keys that are invertible, ordered, GTSAM's own symbols and bounded; manifolds; declaring."""

from __future__ import annotations

import copy
import pickle

import gtsam
import numpy as np
import pytest
from factor_samples import random_values
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.errors import SolverError
from uni4d_fg.factors import VariableType, variable
from uni4d_fg.factors.variable import (
    MAX_INDEX,
    SE3,
    describe,
    format_key,
    locate,
    variable_type,
    variable_types,
    vector_space,
)
from uni4d_fg.factors.variable_types import (
    DYNAMIC_POINT,
    IMU_BIAS,
    INTRINSICS,
    LANDMARK,
    LOG_SCALE,
    POSE,
    VELOCITY,
    point_variable,
    pose_variable,
)

EARLY_TRACKS, EARLY_FRAMES = 10**11, 10**4
LATE_TRACKS, LATE_FRAMES = (MAX_INDEX - 10**15) // 10**8, 10**8
index = st.integers(0, MAX_INDEX)
track_frame = st.one_of(
    st.tuples(st.integers(0, EARLY_TRACKS - 1), st.integers(0, EARLY_FRAMES - 1)),
    st.tuples(st.integers(0, LATE_TRACKS - 1), st.integers(EARLY_FRAMES, LATE_FRAMES - 1)),
)
early = st.tuples(st.integers(0, EARLY_TRACKS - 1), st.integers(0, EARLY_FRAMES - 1))
PLAIN = (POSE, INTRINSICS, LOG_SCALE, LANDMARK, VELOCITY, IMU_BIAS)
MANIFOLDS = (SE3, vector_space(1), vector_space(4))


@given(index)
def test_plain_keys_are_gtsam_symbols(i: int) -> None:
    for kind, character in zip(PLAIN, "xkslvb", strict=True):
        assert kind.key(i) == gtsam.symbol(character, i)
        assert locate(kind.key(i)) == (kind, (i,))


@given(track_frame)
def test_dynamic_point_keys_are_invertible(numbers: tuple[int, int]) -> None:
    key = DYNAMIC_POINT.key(*numbers)
    assert locate(key) == (DYNAMIC_POINT, numbers)
    assert gtsam.Symbol(key).chr() == ord("p")


@pytest.mark.parametrize(
    "numbers",
    [
        (0, 0), (0, EARLY_FRAMES - 1), (EARLY_TRACKS - 1, 0), (EARLY_TRACKS - 1, EARLY_FRAMES - 1),
        (0, EARLY_FRAMES), (LATE_TRACKS - 1, EARLY_FRAMES), (LATE_TRACKS - 1, LATE_FRAMES - 1), (0, LATE_FRAMES - 1),
    ],
)  # fmt: skip
def test_dynamic_point_keys_at_the_bounds_are_invertible(numbers: tuple[int, int]) -> None:
    assert locate(DYNAMIC_POINT.key(*numbers)) == (DYNAMIC_POINT, numbers)


@given(track_frame, track_frame)
def test_different_points_have_different_keys_and_names(a: tuple[int, int], b: tuple[int, int]) -> None:
    keys = [DYNAMIC_POINT.key(*numbers) for numbers in (a, b)]
    assert (keys[0] == keys[1]) == (a == b)
    assert (format_key(keys[0]) == format_key(keys[1])) == (a == b)


@given(early, early)
def test_dynamic_point_keys_order_by_track_then_frame(a: tuple[int, int], b: tuple[int, int]) -> None:
    assert (DYNAMIC_POINT.key(*a) < DYNAMIC_POINT.key(*b)) == (a < b)


@given(index, index)
def test_plain_keys_order_by_index(a: int, b: int) -> None:
    assert (LANDMARK.key(a) < LANDMARK.key(b)) == (a < b)


def test_gtsams_own_printing_shows_track_and_frame() -> None:
    assert gtsam.DefaultKeyFormatter(DYNAMIC_POINT.key(2, 3)) == "p20003"
    assert gtsam.DefaultKeyFormatter(POSE.key(12)) == "x12"


def test_keys_survive_numpy_integers_and_gtsam_values() -> None:
    key = DYNAMIC_POINT.key(np.int32(2**28 - 1), np.int64(LATE_FRAMES - 1))
    values = gtsam.Values()
    values.insert(key, np.ones(3))
    assert list(values.keys()) == [key]
    assert DYNAMIC_POINT.keys(np.array([[2, 3], [4, 5]])) == [DYNAMIC_POINT.key(2, 3), DYNAMIC_POINT.key(4, 5)]
    assert POSE.keys(np.zeros(0, dtype=np.int64)) == []


@pytest.mark.parametrize(
    ("key", "text", "short"),
    [
        (DYNAMIC_POINT.key(17, 3), "dynamic point, track 17, frame 3", "p17_3"),
        (LANDMARK.key(5), "landmark, track 5", "l5"),
        (POSE.key(12), "camera pose, frame 12", "x12"),
        (INTRINSICS.key(0), "intrinsics, camera 0", "k0"),
        (LOG_SCALE.key(2), "depth log-scale, frame 2", "s2"),
        (VELOCITY.key(2), "velocity, frame 2", "v2"),
        (IMU_BIAS.key(2), "IMU bias, frame 2", "b2"),
        (42, "unknown variable 42", "42"),
        (gtsam.symbol("j", 3), f"unknown variable {gtsam.symbol('j', 3)}", str(gtsam.symbol("j", 3))),
    ],
)
def test_keys_read_as_words(key: int, text: str, short: str) -> None:
    assert describe(key) == text
    assert format_key(key) == short


@pytest.mark.parametrize("kind", PLAIN)
@pytest.mark.parametrize("i", [-1, MAX_INDEX + 1])
def test_indices_out_of_bounds_are_refused(kind: VariableType, i: int) -> None:
    with pytest.raises(ValueError, match=f"{kind.describe(i)} is outside"):
        kind.key(i)


@pytest.mark.parametrize(
    ("track", "t"),
    [
        (-1, 0), (0, -1), (EARLY_TRACKS, 0), (EARLY_TRACKS, EARLY_FRAMES - 1),
        (LATE_TRACKS, EARLY_FRAMES), (LATE_TRACKS, LATE_FRAMES - 1), (0, LATE_FRAMES),
    ],
)  # fmt: skip
def test_dynamic_points_out_of_bounds_are_refused(track: int, t: int) -> None:
    with pytest.raises(ValueError, match=f"track {track}, frame {t} is outside"):
        DYNAMIC_POINT.keys(np.array([[0, 0], [track, t]]))


def test_a_key_needs_as_many_numbers_as_its_type_says() -> None:
    with pytest.raises(ValueError, match=r"dynamic_point has the numbers \('track', 'frame'\), got 1"):
        DYNAMIC_POINT.key(3)
    with pytest.raises(ValueError, match=r"pose has the numbers \('frame',\), got 2"):
        POSE.key(3, 4)


# --- declaring ----------------------------------------------------------------------------------------------


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Types that are declared inside a test end with it."""
    monkeypatch.setattr(variable, "_REGISTERED", dict(variable._REGISTERED))


@pytest.mark.usefixtures("registry")
def test_a_name_or_a_key_character_is_given_once() -> None:
    before = variable_types()
    with pytest.raises(SolverError, match=r"'pose' \(w\): the name or the key character is that of 'pose' \(x\)"):
        pose_variable("pose", "w")
    with pytest.raises(SolverError, match=r"'marker' \(x\): the name or the key character is that of 'pose' \(x\)"):
        point_variable("marker", "x")
    with pytest.raises(SolverError, match=r"'pose' \(x\): the name or the key character"):
        VariableType("pose", "x", vector_space(3))
    for symbol in ("", "mm", "é", "Ж", "²", "7", "_", " "):
        with pytest.raises(SolverError, match=f"'marker': the key character '{symbol}' must be one letter, a to z"):
            point_variable("marker", symbol)
    with pytest.raises(SolverError, match="needs one or two index names, got"):
        point_variable("marker", "m", index=("object", "camera", "frame"))
    assert variable_types() == before


@pytest.mark.usefixtures("registry")
def test_declaring_the_same_type_again_replaces_it() -> None:
    first = point_variable("marker", "m", ("object", "frame"))
    again = point_variable("marker", "m", ("object", "frame"), label="marker on a body")
    assert first is not again
    assert [kind for kind in variable_types() if kind.name == "marker"] == [again]
    assert variable_type("marker") is again
    assert first.key(3, 4) == again.key(3, 4)
    assert describe(again.key(3, 4)) == "marker on a body, object 3, frame 4"
    assert locate(again.key(3, 4)) == (again, (3, 4))


def test_types_are_found_by_name_and_stay_one_object() -> None:
    assert variable_type("log_scale") is LOG_SCALE
    with pytest.raises(SolverError, match="no variable type 'speed'; declared are pose, intrinsics, "):
        variable_type("speed")
    for kind in variable_types():
        assert copy.deepcopy(kind) is copy.copy(kind) is kind
        assert pickle.loads(pickle.dumps(kind)) is kind


# --- manifolds ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=lambda m: m.name)
def test_local_is_the_inverse_of_retract_and_its_jacobian_its_slope(manifold, rng: np.random.Generator) -> None:
    values = random_values(manifold, rng)
    tangents = rng.normal(scale=0.3, size=(len(values), manifold.dim))
    moved = manifold.retract(values, tangents)
    np.testing.assert_allclose(manifold.local(values, moved), tangents, atol=1e-12)
    np.testing.assert_allclose(manifold.retract(values, manifold.local(values, moved)), moved, atol=1e-12)
    jacobian, step = manifold.local_jacobian(tangents), 1e-6
    for i in range(manifold.dim):
        d = np.tile(step * np.eye(manifold.dim)[i], (len(values), 1))
        ends = [manifold.local(values, manifold.retract(moved, s * d)) for s in (1.0, -1.0)]
        np.testing.assert_allclose(jacobian[:, :, i], (ends[0] - ends[1]) / (2 * step), atol=1e-7)


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=lambda m: m.name)
def test_parameters_give_the_values_back(manifold, rng: np.random.Generator) -> None:
    values = random_values(manifold, rng)
    assert values.shape == (len(values), *manifold.shape)
    parameters = manifold.to_parameters(values)
    assert {name: array.shape[1] for name, array in parameters.items()} == {
        name: columns.stop - columns.start for name, columns in manifold.parameter_columns.items()
    }
    np.testing.assert_allclose(manifold.from_parameters(parameters), values, atol=1e-14)


@pytest.mark.parametrize("kind", variable_types(), ids=str)
def test_values_and_tangents_are_gtsams(kind: VariableType, rng: np.random.Generator) -> None:
    """One value into ``gtsam.Values`` and back, and a step there that is the step here."""
    value = random_values(kind.manifold, rng)[:1]
    values = gtsam.Values()
    key = kind.key(*(3 for _ in kind.index))
    values.insert(key, kind.to_gtsam(value[0]))
    np.testing.assert_allclose(kind.from_gtsam(values, key), value[0], rtol=1e-15, atol=1e-15)
    assert values.dim() == (kind.gtsam_dim or kind.dim)
    tangent = rng.normal(scale=0.3, size=kind.dim)
    wide = np.zeros(values.dim())
    wide[list(kind.gtsam_columns) or slice(None)] = tangent
    step = gtsam.VectorValues()
    step.insert(key, wide)
    moved = kind.from_gtsam(values.retract(step), key)
    np.testing.assert_allclose(moved, kind.manifold.retract(value, tangent[None])[0], atol=1e-12)
