"""Pixels beside a mask that look like what is inside."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.fusion.mask_band import looks_moving

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
