"""Keys: invertible, ordered, GTSAM's own symbols, readable, bounded."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.graph import keys

index = st.integers(0, keys.MAX_INDEX)
frame = st.integers(0, keys.MAX_FRAME)


@given(index)
def test_plain_keys_are_gtsam_symbols(i: int) -> None:
    for make, character, group in (
        (keys.pose_key, "x", "pose"),
        (keys.intrinsics_key, "k", "intrinsics"),
        (keys.log_scale_key, "s", "log_scale"),
        (keys.landmark_key, "l", "landmark"),
    ):
        assert make(i) == gtsam.symbol(character, i)
        assert keys.decode(make(i)) == keys.DecodedKey(group, i)


@given(frame, frame)
def test_dynamic_point_keys_are_invertible(track: int, t: int) -> None:
    key = keys.dynamic_point_key(track, t)
    assert keys.decode(key) == keys.DecodedKey("dynamic_point", track, t)
    assert gtsam.Symbol(key).chr() == ord("p")


@given(frame, frame, frame, frame)
def test_dynamic_point_keys_order_by_track_then_frame(a: int, s: int, b: int, t: int) -> None:
    assert (keys.dynamic_point_key(a, s) < keys.dynamic_point_key(b, t)) == ((a, s) < (b, t))


@given(index, index)
def test_plain_keys_order_by_index(a: int, b: int) -> None:
    assert (keys.landmark_key(a) < keys.landmark_key(b)) == (a < b)


def test_keys_survive_numpy_integers_and_gtsam_values() -> None:
    key = keys.dynamic_point_key(np.int32(keys.MAX_FRAME), np.int64(keys.MAX_FRAME))
    values = gtsam.Values()
    values.insert(key, np.ones(3))
    assert list(values.keys()) == [key]


@pytest.mark.parametrize(
    ("key", "text"),
    [
        (keys.dynamic_point_key(17, 3), "dynamic point, track 17, frame 3"),
        (keys.landmark_key(5), "landmark, track 5"),
        (keys.pose_key(12), "camera pose, frame 12"),
        (keys.intrinsics_key(), "intrinsics 0"),
        (keys.log_scale_key(2), "depth log-scale, frame 2"),
        (42, "unknown variable 42"),
        (gtsam.symbol("q", 3), f"unknown variable {gtsam.symbol('q', 3)}"),
    ],
)
def test_decoded_keys_read_as_words(key: int, text: str) -> None:
    assert str(keys.decode(key)) == text


@pytest.mark.parametrize("make", [keys.pose_key, keys.landmark_key, keys.log_scale_key, keys.intrinsics_key])
@pytest.mark.parametrize("i", [-1, keys.MAX_INDEX + 1])
def test_indices_out_of_bounds_are_refused(make, i: int) -> None:
    with pytest.raises(ValueError, match="outside"):
        make(i)


@pytest.mark.parametrize(("track", "t"), [(-1, 0), (0, -1), (keys.MAX_FRAME + 1, 0), (0, keys.MAX_FRAME + 1)])
def test_dynamic_points_out_of_bounds_are_refused(track: int, t: int) -> None:
    with pytest.raises(ValueError, match=f"track {track}, frame {t}"):
        keys.dynamic_point_key(track, t)
