"""Edges of depth that matching has blurred are found again; what is right stays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.multiview import edges
from uni4d_fg.results.fusion.multiview.edges import edges_again
from uni4d_fg.results.fusion.multiview.edges_numpy import edges_again_numpy
from uni4d_fg.results.fusion.pixel_transfer import PixelTransfer, pixel_transfer

HEIGHT, WIDTH, FOCAL = 60, 90, 80.0
K = np.array([FOCAL, FOCAL, 44.5, 29.5])
NEAR, FAR, LEFT, RIGHT = 2.0, 5.0, -0.35, 0.3
STEPS = (-0.2, -0.1, 0.1, 0.2)
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    waves = [np.sin(a * x + b * y + c) for a, b, c in ((9, 2, 0), (-3, 11, 1), (17, 13, 2), (5, -21, 3), (23, 7, 4))]
    return np.asarray(0.5 + 0.09 * np.sum(waves, axis=0), np.float32)


def view(shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Image and inverse depth of a post before a wall, from a camera that has moved to the right."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x, y = (u - K[2]) / FOCAL, (v - K[3]) / FOCAL
    on_post = (x * NEAR + shift > LEFT) & (x * NEAR + shift < RIGHT)
    depth = np.where(on_post, NEAR, FAR)
    image = np.where(on_post, texture(7 + 3 * (x * NEAR + shift), 3 * y * NEAR), texture(x * FAR + shift, y * FAR))
    return image.astype(np.float32), (1 / depth).astype(np.float32)


def transfers() -> list[PixelTransfer]:
    poses = []
    for step in STEPS:
        pose = np.eye(4)
        pose[0, 3] = step
        poses.append(pose)
    return [pixel_transfer(K, K, np.linalg.inv(pose)) for pose in poses]


def widened(inverse: np.ndarray, by: int) -> np.ndarray:
    """What is near reaches farther, as windows make it."""
    out = inverse.copy()
    for step in range(1, by + 1):
        out[:, step:] = np.maximum(out[:, step:], inverse[:, :-step])
        out[:, :-step] = np.maximum(out[:, :-step], inverse[:, step:])
    return out


@pytest.mark.parametrize("by", [2, 3, 4])
def test_a_post_that_is_too_wide_is_as_wide_as_it_is(by: int) -> None:
    image, truth = view(0.0)
    others = [view(step)[0] for step in STEPS]
    wrong = widened(truth, by)
    assert np.mean(wrong != truth) > 0.019 * by
    again = edges_again(wrong, image, EVERYWHERE, others, transfers())
    assert np.mean(np.abs(again / truth - 1) > 0.01) < 0.1 * np.mean(wrong != truth)


def test_edges_that_are_right_stay() -> None:
    image, truth = view(0.0)
    again = edges_again(truth, image, EVERYWHERE, [view(step)[0] for step in STEPS], transfers())
    assert np.mean(again != truth) < 0.004


def test_what_is_not_matched_and_what_views_do_not_show_stays() -> None:
    image, truth = view(0.0)
    wrong = widened(truth, 4)
    others = [view(step)[0] for step in STEPS]
    masked = image.copy()
    masked[:30] = np.nan
    again = edges_again(wrong, masked, EVERYWHERE, others, transfers())
    np.testing.assert_array_equal(again[:30], wrong[:30])
    assert np.mean(again[34:] != wrong[34:]) > 0.05
    nothing = [np.full_like(image, np.nan) for _ in STEPS]
    np.testing.assert_array_equal(edges_again(wrong, image, EVERYWHERE, nothing, transfers()), wrong)


def test_one_view_that_something_hides_does_not_decide() -> None:
    image, truth = view(0.0)
    others = [view(step)[0] for step in STEPS]
    others[1][:, 20:60] = np.nan
    wrong = widened(truth, 4)
    again = edges_again(wrong, image, EVERYWHERE, others, transfers())
    assert np.mean(np.abs(again / truth - 1) > 0.01) < 0.15 * np.mean(wrong != truth)


def test_what_is_not_chosen_stays() -> None:
    image, truth = view(0.0)
    wrong, others = widened(truth, 4), [view(step)[0] for step in STEPS]
    chosen = EVERYWHERE.copy()
    chosen[:, 45:] = False
    again = edges_again(wrong, image, chosen, others, transfers())
    np.testing.assert_array_equal(again[~chosen], wrong[~chosen])
    assert np.mean(again != wrong) > 0.03


def test_a_plain_scene_keeps_what_it_has() -> None:
    """Where nothing tells depths apart, no depth is better than a pixel's own."""
    _, truth = view(0.0)
    plain = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    wrong = widened(truth, 4)
    np.testing.assert_array_equal(edges_again(wrong, plain, EVERYWHERE, [plain] * len(STEPS), transfers()), wrong)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), hidden=st.floats(0, 0.6), views=st.integers(1, 4))
def test_cpp_and_numpy_agree(seed: int, hidden: float, views: int) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    rng = np.random.default_rng(seed)
    image, truth = view(0.0)
    inverse = (truth * rng.choice([0.6, 1.0, 1.01, 1.5], truth.shape)).astype(np.float32)
    others = [view(step)[0] for step in STEPS[:views]]
    for each in (image, *others):
        each += rng.normal(0, 0.02, each.shape).astype(np.float32)
        each[rng.random(each.shape) < hidden * rng.random()] = np.nan
    chosen = rng.random(image.shape) < 0.7
    turns, shifts = (np.stack(parts)[:views] for parts in zip(*transfers(), strict=True))
    slow = edges_again_numpy(inverse, image, chosen, np.stack(others), turns, shifts)
    inverse, image, wide = (np.asarray(part, np.float64) for part in (inverse, image, np.stack(others)))
    fast = core.depth_edges(inverse, image, chosen.astype(np.uint8), wide, turns, shifts, threads=2).astype(np.float32)
    # Where two depths are as good to the last digits, either may be taken.
    assert np.mean(fast != slow) < 0.001


def test_without_the_extension_it_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    image, truth = view(0.0)
    others, wrong = [view(step)[0] for step in STEPS], widened(truth, 4)
    expected = edges_again(wrong, image, EVERYWHERE, others, transfers())
    monkeypatch.setattr(edges, "find_extension", lambda: (None, "is not there"))
    assert np.mean(edges_again(wrong, image, EVERYWHERE, others, transfers()) != expected) < 0.001


def test_the_extension_refuses_what_makes_no_sense() -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    image, truth = (np.asarray(part, np.float64) for part in view(0.0))
    turns, shifts = (np.stack(parts) for parts in zip(*transfers(), strict=True))
    others, chosen = np.stack([image] * len(STEPS)), EVERYWHERE.astype(np.uint8)
    with pytest.raises(ValueError, match="inverse_depth: expected positive numbers"):
        core.depth_edges(0 * truth, image, chosen, others, turns, shifts)
    with pytest.raises(ValueError, match="others"):
        core.depth_edges(truth, image, chosen, others[:, 1:], turns, shifts)
    with pytest.raises(ValueError, match="turns"):
        core.depth_edges(truth, image, chosen, others, turns[1:], shifts)
    with pytest.raises(ValueError, match="chosen"):
        core.depth_edges(truth, image, chosen[1:], others, turns, shifts)
