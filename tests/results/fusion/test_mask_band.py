"""Pixels beside a mask that look like what is inside."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.fusion.mask_band import looks_moving, stands_still

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


def test_the_rim_of_a_mask_that_is_too_large_stands_still_where_depth_and_colors_say_so(
    rng: np.random.Generator,
) -> None:
    thing = np.zeros((HEIGHT, WIDTH), bool)
    thing[12:38, 18:46] = True
    image = np.where(thing[..., None], [190, 60, 50], [70, 80, 160]) + rng.normal(0, 25, (HEIGHT, WIDTH, 3))
    image = np.clip(image, 0, 255).astype(np.uint8)
    mask = np.zeros((HEIGHT, WIDTH), np.int32)
    mask[8:42, 14:50] = 4
    static = np.ones((HEIGHT, WIDTH), bool)
    static[5:45, 11:53] = False
    rim = (mask > 0) & ~thing
    # As on scenes with truth: four tenths of the rim are shown with confidence, the rest and what moves are not.
    matched = np.where(rim, rng.choice([0.9, 0.15], (HEIGHT, WIDTH), p=[0.4, 0.6]), 0.05).astype(np.float32)
    found = stands_still(image, mask, matched, static)
    assert found[rim].mean() > 0.9
    assert found[thing].mean() < 0.02
    # A mask that fits is left alone, whatever its colors.
    unsure = np.minimum(matched, np.float32(0.15))
    assert not stands_still(image, mask, unsure, static).any()
