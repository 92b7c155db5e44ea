"""Pixels beside a mask that look like what is inside, and masks that do not fit what moves."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.results.fusion.background import Background
from uni4d_fg.results.fusion.mask_band import FittedMask, compare, fitted_mask, looks_moving, moves_beside, stands_still
from uni4d_fg.results.fusion.multiview.working_frame import WorkingSize

HEIGHT, WIDTH = 48, 64


def test_the_band_around_a_mask_that_is_too_small_looks_like_what_moves_and_the_wall_does_not(
    rng: np.random.Generator,
) -> None:
    thing = np.zeros((HEIGHT, WIDTH), bool)
    thing[14:36, 20:44] = True
    image = np.where(thing[..., None], [190, 60, 50], [70, 80, 160]) + rng.normal(0, 25, (HEIGHT, WIDTH, 3))
    mask = np.zeros((HEIGHT, WIDTH), np.int32)
    mask[17:33, 23:41] = 4
    static = np.ones((HEIGHT, WIDTH), bool)
    static[12:38, 18:46] = False
    found = looks_moving(np.clip(image, 0, 255).astype(np.uint8), mask, static)
    band = ~static & (mask == 0)
    assert not found[static].any()
    assert found[band & thing].mean() > 0.9
    assert found[band & ~thing].mean() < 0.1
    assert not looks_moving(image.astype(np.uint8), np.zeros_like(mask), static).any()


def seen_behind(image: np.ndarray, thing: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> Background:
    """The wall, with noise, also behind the thing."""
    wall = np.where(thing[..., None], np.roll(image, 30, axis=1), image) / 255
    color = (wall + rng.normal(0, 0.02, wall.shape)).astype(np.float32)
    return Background(color, np.full_like(color, 4e-4), np.full(seen.shape, 0.5, np.float32), seen)


@pytest.fixture
def thing() -> np.ndarray:
    found = np.zeros((HEIGHT, WIDTH), bool)
    found[12:38, 18:46] = True
    return found


@pytest.fixture
def image(thing: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A thing before a wall."""
    noisy = np.where(thing[..., None], [170, 70, 70], [80, 80, 140]) + rng.normal(0, 20, (HEIGHT, WIDTH, 3))
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("margin", [2, 4, 6])
def test_what_a_mask_covers_besides_stands_still_where_other_frames_show_the_same(
    margin: int, thing: np.ndarray, image: np.ndarray, rng: np.random.Generator
) -> None:
    large = cv2.dilate(thing.astype(np.uint8), np.ones((2 * margin + 1,) * 2, np.uint8))
    rim = (large > 0) & ~thing
    seen = rng.random(thing.shape) < 0.8
    matched = np.full(thing.shape, 0.1, np.float32)
    found = stands_still(compare(image, large.astype(np.int32), seen_behind(image, thing, seen, rng)), matched)
    assert found[rim & seen].mean() > 0.95
    assert found[rim & ~seen].mean() > 0.7  # as their neighbors
    assert found[thing].mean() < 0.05


def test_a_mask_that_fits_is_left_alone(thing: np.ndarray, image: np.ndarray, rng: np.random.Generator) -> None:
    behind = seen_behind(image, thing, np.ones_like(thing), rng)
    matched = np.full(thing.shape, 0.1, np.float32)
    assert not stands_still(compare(image, thing.astype(np.int32), behind), matched).any()
    # What is matched with confidence stands still in any case.
    matched[14:16, 20:40] = 0.9
    found = stands_still(compare(image, thing.astype(np.int32), behind), matched)
    np.testing.assert_array_equal(found, matched > 0.6)


def test_one_mask_that_is_too_large_says_nothing_of_another(rng: np.random.Generator) -> None:
    """The second thing is partly of the color of the wall, which only its own rim could tell from a mask too large."""
    things = np.zeros((HEIGHT, 2 * WIDTH), np.int32)
    things[12:38, 18:46], things[12:38, 82:110] = 1, 2
    color = np.where((things > 0)[..., None], [170, 70, 70], [80, 80, 140])
    color[16:22, 82:90] = 80, 80, 140
    image = np.clip(color + rng.normal(0, 20, color.shape), 0, 255).astype(np.uint8)
    mask = cv2.dilate((things == 1).astype(np.uint8), np.ones((11, 11), np.uint8)).astype(np.int32)
    mask[things == 2] = 2
    behind = seen_behind(image, things > 0, np.ones_like(things, bool), rng)
    found = stands_still(compare(image, mask, behind), np.full(things.shape, 0.1, np.float32))
    assert found[(mask == 1) & (things == 0)].mean() > 0.95
    assert found[things == 1].mean() < 0.05
    assert not found[things == 2].any()


def test_where_no_frame_sees_what_is_behind_nothing_is_told(thing: np.ndarray, image: np.ndarray) -> None:
    nothing = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    behind = Background(nothing, nothing, nothing[..., 0], np.zeros_like(thing))
    mask = cv2.dilate(thing.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(np.int32)
    matched = np.full(thing.shape, 0.1, np.float32)
    assert not stands_still(compare(image, mask, behind), matched).any()


@pytest.mark.parametrize("margin", [2, 4, 6])
def test_what_a_mask_misses_moves_where_other_frames_show_something_else(
    margin: int, thing: np.ndarray, image: np.ndarray, rng: np.random.Generator
) -> None:
    small = cv2.erode(thing.astype(np.uint8), np.ones((2 * margin + 1,) * 2, np.uint8)) > 0
    seen = rng.random(thing.shape) < 0.8
    matched = np.full(thing.shape, 0.1, np.float32)
    found = moves_beside(compare(image, small.astype(np.int32), seen_behind(image, thing, seen, rng)), matched)
    assert found[thing & ~small].mean() > 0.9
    assert found[~thing].mean() < 0.05
    assert not found[small].any()


def test_a_mask_that_misses_nothing_is_not_grown(
    thing: np.ndarray, image: np.ndarray, rng: np.random.Generator
) -> None:
    matched = np.full(thing.shape, 0.1, np.float32)
    behind = seen_behind(image, thing, np.ones_like(thing), rng)
    assert moves_beside(compare(image, thing.astype(np.int32), behind), matched).mean() < 0.01
    # Nor is anything that frames match with confidence, or that none shows.
    small = cv2.erode(thing.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(np.int32)
    assert not moves_beside(compare(image, small, behind), np.full(thing.shape, 0.9, np.float32)).any()
    assert not moves_beside(compare(image, small, behind._replace(seen=np.zeros_like(thing))), matched).any()
    assert not moves_beside(compare(image, np.zeros_like(small), behind), matched).any()
    # Where a thing has the color of the scene, its colors tell nothing.
    plain = np.full_like(image, 90)
    alike = seen_behind(plain, np.zeros_like(thing), np.ones_like(thing), rng)._replace(
        color=np.full(image.shape, 90 / 255, np.float32), variance=np.zeros(image.shape, np.float32)
    )
    assert not moves_beside(compare(plain, small, alike), matched).any()


def test_a_fitted_mask_gives_what_was_missed_to_the_nearest_instance() -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.int32)
    mask[10:20, 10:20], mask[10:20, 40:50] = 3, 7
    still, missed = np.zeros((2, HEIGHT, WIDTH), bool)
    still[10:20, 10:12] = True
    missed[10:20, 20:23] = missed[10:20, 37:40] = True
    applied = FittedMask(still, missed).applied(mask, WorkingSize(HEIGHT, WIDTH, (HEIGHT, WIDTH)))
    expected = np.zeros_like(mask)
    expected[10:20, 12:23], expected[10:20, 37:50] = 3, 7
    np.testing.assert_array_equal(applied, expected)


def test_masks_that_flicker_fit_better(thing: np.ndarray, image: np.ndarray, rng: np.random.Generator) -> None:
    """One side of a mask reaches too far, the other not far enough."""
    mask = np.roll(thing, 4, axis=1)
    behind = seen_behind(image, thing, np.ones_like(thing), rng)
    fitted = fitted_mask(
        compare(image, mask.astype(np.int32), behind), np.full(thing.shape, 0.1, np.float32), tells_missed=True
    )
    applied = fitted.applied(mask.astype(np.int32), WorkingSize(HEIGHT, WIDTH, (HEIGHT, WIDTH))) > 0
    assert np.count_nonzero(applied ^ thing) < 0.7 * np.count_nonzero(mask ^ thing)
