"""Evidence that pixels have moved: the C++ version against NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from uni4d_fg.cues.evidence_numpy import moved_evidence_numpy
from uni4d_fg.optim.extension import find_extension

SETTINGS: dict[str, Any] = {
    "patch": 5,
    "shadow_window": 15,
    "deepest_shadow": 0.4,
    "lit": 0.97,
    "nearer": 0.9,
    "limits": (-1.0, 3.0),
    "step": 4,
}


def compared(rng: np.random.Generator, size: tuple[int, int]) -> list[Any]:
    """Arguments of a comparison of random pictures, part of them in a shadow, part of them hidden or out of sight."""
    height, width = size
    color = rng.uniform(0, 255, (height, width, 3))
    seen = color / np.where(np.arange(width) < width // 4, 0.7, 1.0)[:, None] + rng.normal(4.0, 3.0, color.shape)
    elsewhere = seen[: height // 2, 2 * width // 3 :]
    elsewhere[:] = rng.uniform(0, 255, elsewhere.shape)
    v, u = np.mgrid[0:height, 0:width] + rng.normal(2.0, 0.3, (2, 1, 1))
    u[:3, :5] = np.nan
    du, dv = rng.normal(0, 2, (2, height, width))
    z, sigma = rng.uniform(1, 5, (height, width)), rng.uniform(0.01, 0.1, (height, width))
    gxx, gyy, variance = rng.uniform(0, 50, (3, height, width))
    contrast, texture = rng.uniform(0, 4000, (2, height, width))
    nearest = np.where(rng.uniform(size=size) < 0.1, np.inf, rng.uniform(1, 8, size))
    arrays = (
        color, seen, u, v, du, dv, z, sigma, gxx, np.sqrt(gxx * gyy) / 2, gyy, 48 + variance, contrast, texture, nearest
    )  # fmt: skip
    return [np.ascontiguousarray(each, np.float32) for each in arrays]


@pytest.mark.parametrize("size", [(60, 83), (17, 120), (5, 6)])
@pytest.mark.parametrize("with_shadows", [True, False])
@pytest.mark.parametrize("windows", [(5, 15), (4, 6), (1, 1)])
def test_cpp_and_numpy_agree(
    size: tuple[int, int], with_shadows: bool, windows: tuple[int, int], rng: np.random.Generator
) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    given = compared(rng, size)
    if not with_shadows:
        given[13] = None
    settings = SETTINGS | {"patch": windows[0], "shadow_window": windows[1]}
    slow, fast = moved_evidence_numpy(*given, **settings), core.moved_evidence(*given, **settings)
    assert fast.dtype == np.float32
    np.testing.assert_allclose(fast, slow, atol=2e-3)
    if size == (60, 83):
        assert (slow == 0).mean() > 0.1
        assert (slow > 0.5).mean() > 0.05


def test_shadows_are_forgiven_only_where_they_are_looked_for(rng: np.random.Generator) -> None:
    given = compared(rng, (60, 83))
    given[14][:] = np.inf  # nothing hides
    shaded = np.zeros((60, 83), bool)
    shaded[10:-10, 8 : 83 // 4 - 8] = True
    found = moved_evidence_numpy(*given, **SETTINGS)
    given[13] = None
    assert np.median(found[shaded]) < 0 < np.median(moved_evidence_numpy(*given, **SETTINGS)[shaded])


def test_bad_input_is_named(rng: np.random.Generator) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    given = compared(rng, (20, 30))
    with pytest.raises(ValueError, match="nearest"):
        core.moved_evidence(*given[:14], given[14][:-1], **SETTINGS)
    with pytest.raises(ValueError, match="patch"):
        core.moved_evidence(*given, **(SETTINGS | {"patch": 0}))
