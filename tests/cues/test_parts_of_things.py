"""Parts of one thing that masks tell apart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from uni4d_fg.cues.parts_of_things import feet_of, things_below

FRACTION = 0.1
HEIGHT, WIDTH = 80, 60


def drawn(*boxes: tuple[int, int, int, int, int]) -> np.ndarray:
    """A mask with boxes (id, first and last line, first and last column), later ones before earlier ones."""
    mask = np.zeros((HEIGHT, WIDTH), np.int32)
    for label, top, bottom, left, right in boxes:
        mask[top : bottom + 1, left : right + 1] = label
    return mask


SHIRT, TROUSERS = (1, 10, 39, 20, 39), (2, 40, 69, 22, 37)


@pytest.mark.parametrize(("gap", "rests"), [(0, True), (10, True), (16, False)])
def test_a_shirt_rests_on_trousers_that_begin_within_half_its_height(gap: int, rests: bool) -> None:
    mask = drawn(SHIRT, (2, 40 + gap, 69, 22, 37))
    assert things_below(mask, FRACTION) == ({1: 2} if rests else {})


def test_most_of_what_ends_must_have_the_other_below_it() -> None:
    assert things_below(drawn(SHIRT, (2, 40, 69, 31, 50)), FRACTION) == {}
    assert things_below(drawn(SHIRT, (2, 40, 69, 28, 50)), FRACTION) == {1: 2}
    # Beside each other: neither.
    assert things_below(drawn(SHIRT, (2, 10, 60, 40, 55)), FRACTION) == {}


def test_only_the_first_that_follows_counts() -> None:
    mask = drawn(SHIRT, (2, 40, 49, 20, 39), (3, 50, 69, 20, 39))
    assert things_below(mask, FRACTION) == {1: 2, 2: 3}


def areas(*sizes: list[int]) -> dict[int, np.ndarray]:
    """Areas of things 1, 2 and so on."""
    return {label: np.array(size) for label, size in enumerate(sizes, 1)}


def test_a_part_stands_by_the_lowest_that_follows_downward() -> None:
    below = [{1: 2, 2: 3}] * 3 + [{}]
    found = feet_of(below, areas([9, 9, 9, 9], [9, 9, 9, 0], [9, 9, 9, 9]))
    assert found == ({1: 3, 2: 3, 3: 3},) * 3 + ({1: 1, 3: 3},)


def test_who_is_hidden_for_a_while_stands_where_they_do() -> None:
    """Somebody passes before somebody else in two of six frames."""
    below = [{}, {}, {1: 2}, {1: 2}, {}, {}]
    assert feet_of(below, areas([9] * 6, [9] * 6)) == ({1: 1, 2: 2},) * 6


@pytest.mark.parametrize(("last", "foot"), [(17, 2), (19, 1)])
def test_frames_count_by_what_is_seen(last: int, foot: int) -> None:
    found = feet_of([{1: 2}, {1: 2}, {}], areas([9, 9, last], [9, 9, 9]))
    assert [here[1] for here in found] == [foot, foot, 1]


def test_two_things_below_each_other_end() -> None:
    assert feet_of([{1: 2, 2: 1}], areas([9], [9])) == ({1: 2, 2: 1},)


@given(hnp.arrays(np.int32, (12, 9), elements=st.integers(0, 3)))
def test_whatever_the_masks_each_thing_stands_by_one_that_is_there(mask: np.ndarray) -> None:
    below = things_below(mask, FRACTION)
    labels = set(np.unique(mask[mask > 0]).tolist())
    assert set(below) <= labels
    assert all(other in labels and other != label for label, other in below.items())
    (feet,) = feet_of([below], {label: np.array([np.count_nonzero(mask == label)]) for label in labels})
    assert set(feet) == labels
    assert set(feet.values()) <= labels
