from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from uni4d_fg.frontend.tracks.mask_certainty import UNCERTAIN, certain_labels


def half(size: int = 40, edge: int = 20, instance: int = 1) -> np.ndarray:
    mask = np.zeros((size, size), np.int32)
    mask[:, edge:] = instance
    return mask


@pytest.mark.parametrize(("static_px", "dynamic_px"), [(0, 0), (1, 2), (5, 3), (7, 0)])
def test_band_has_the_widths_asked_for_on_both_sides(static_px: int, dynamic_px: int) -> None:
    for turn in range(4):
        mask = np.rot90(half(), turn).copy()
        certain = np.rot90(certain_labels(mask, static_px, dynamic_px), -turn)
        expected = half()
        expected[:, 20 - static_px : 20 + dynamic_px] = UNCERTAIN
        np.testing.assert_array_equal(certain, expected)


def test_image_border_is_not_eroded() -> None:
    for value in (0, 3):
        mask = np.full((20, 30), value, np.int32)
        np.testing.assert_array_equal(certain_labels(mask, 5, 5), mask)


def test_touching_instances_have_a_band_between_them() -> None:
    mask = half(instance=2)
    mask[:, :20] = 7
    certain = certain_labels(mask, 5, 3)
    assert (certain[:, 17:23] == UNCERTAIN).all()
    assert (certain[:, :17] == 7).all()
    assert (certain[:, 23:] == 2).all()


def test_an_instance_thinner_than_the_band_is_never_certain() -> None:
    mask = np.zeros((30, 30), np.int32)
    mask[:, 14:17] = 1
    certain = certain_labels(mask, 2, 3)
    assert not (certain == 1).any()
    assert (certain[:, 12:19] == UNCERTAIN).all()


@pytest.mark.parametrize("instance", [255, 65535, 70_000, 2**31 - 1])
def test_large_ids_survive(instance: int) -> None:
    certain = certain_labels(half(instance=instance), 1, 1)
    assert certain.dtype == np.int32
    assert certain[0, -1] == instance


def brute_force(mask: np.ndarray, static_px: int, dynamic_px: int) -> np.ndarray:
    out = mask.copy()
    height, width = mask.shape
    for y in range(height):
        for x in range(width):
            radius = dynamic_px if mask[y, x] else static_px
            for v in range(max(0, y - radius), min(height, y + radius + 1)):
                for u in range(max(0, x - radius), min(width, x + radius + 1)):
                    near = (u - x) ** 2 + (v - y) ** 2 <= (radius + 0.5) ** 2
                    if near and mask[v, u] != mask[y, x]:
                        out[y, x] = UNCERTAIN
    return out


@settings(max_examples=30, deadline=None)
@given(arrays(np.int32, (9, 11), elements=st.sampled_from([0, 0, 0, 1, 5])), st.integers(0, 3), st.integers(0, 3))
def test_against_the_definition(mask: np.ndarray, static_px: int, dynamic_px: int) -> None:
    np.testing.assert_array_equal(certain_labels(mask, static_px, dynamic_px), brute_force(mask, static_px, dynamic_px))
