"""Colors tell what moves where evidence is blurred or silent."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.region_colors import NearRegion, color_odds

SIZE = (180, 240)
CONFIG = MotionMaskConfig()
REACH = CONFIG.color_reach_px
EVERYWHERE = np.ones(SIZE, bool)


def walker(left: int = 0, legs: bool = True) -> np.ndarray:
    """A body with a head and two legs, (H, W)."""
    mask = np.zeros(SIZE, np.uint8)
    cv2.circle(mask, (left + 60, 40), 12, 1, -1)
    cv2.rectangle(mask, (left + 42, 52), (left + 78, 110), 1, -1)
    if legs:
        cv2.rectangle(mask, (left + 44, 110), (left + 52, 160), 1, -1)
        cv2.rectangle(mask, (left + 66, 110), (left + 74, 160), 1, -1)
    return mask > 0


def picture(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The body in red and blue before a wall and a floor of other colors, with noise; RGB."""
    image = np.empty((*SIZE, 3))
    image[:120], image[120:] = (170, 160, 120), (90, 110, 80)
    image[mask] = (150, 40, 40)
    image[mask & (np.arange(SIZE[0])[:, None] >= 110)] = (30, 40, 110)
    return np.clip(image + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)


def blurred(mask: np.ndarray) -> np.ndarray:
    """What is seen to move: without edges, and with a strip of the wall that is not quite sure."""
    evidence = 8 * cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 2.5) - 4
    evidence[60:66, 0:230] = np.maximum(evidence[60:66, 0:230], 1.5)
    return np.asarray(evidence, np.float32)


def looked_at(image: np.ndarray, evidence: np.ndarray, reach_px: int = REACH, larger: int = 1) -> NearRegion:
    region = cv2.resize((evidence > 0.25).astype(np.uint8), None, fx=larger, fy=larger, interpolation=cv2.INTER_NEAREST)
    return NearRegion.of(region > 0, image, evidence, reach_px, EVERYWHERE)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("larger", [1, 2])
def test_legs_that_stand_in_one_frame_have_moved_in_others(larger: int, rng: np.random.Generator) -> None:
    frames, truth = [], []
    for frame in range(6):
        body = walker(20 * frame)
        seen = walker(20 * frame, legs=frame % 2 == 1)
        evidence = blurred(seen)
        evidence[body & ~seen & (evidence < 0.25)] = -0.5
        truth.append(body)
        frames.append(looked_at(picture(body, rng), evidence, larger=larger))
    odds = color_odds(frames, CONFIG)
    for frame, (looked, body) in enumerate(zip(frames, truth, strict=True)):
        moves = looked.moving(odds) > CONFIG.threshold
        before = looked.moving(np.zeros_like(odds)) > 0.25
        rows = slice(0, 125)  # as far as colors reach below what was found where the legs stand
        legs = body[rows] & (np.arange(125)[:, None] >= 112)
        assert overlap(moves[rows], body[rows]) > 0.97 > 0.85 > overlap(before[rows], body[rows])
        assert moves[rows][legs].mean() > 0.9
        if frame % 2 == 0:
            assert before[rows][legs].mean() < 0.1


def test_it_reaches_no_farther_than_said(rng: np.random.Generator) -> None:
    body = walker()
    for reach in (0, 6):
        looked = looked_at(picture(body, rng), blurred(body), reach)
        region = (blurred(body) > 0.25).astype(np.uint8)
        near = cv2.dilate(region, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)) > 0
        np.testing.assert_array_equal(looked.near.unpacked(), near)
        found = looked.moving(np.full(32**3, 4.0, np.float32))
        assert (found[~near] < -5).all()
        np.testing.assert_allclose(
            looked.evidence, np.clip(blurred(body)[near], -5.29, 5.29), atol=1 / 48 + 1e-6
        )  # what is held is rounded


def test_colors_that_both_have_say_nothing(rng: np.random.Generator) -> None:
    image = np.clip(rng.normal(120, 6, (*SIZE, 3)), 0, 255).astype(np.uint8)
    body = walker()
    looked = looked_at(image, blurred(body))
    odds = color_odds([looked], CONFIG)
    said = looked.colored(odds)[1] - looked.evidence
    assert np.abs(said).mean() < 0.3
    assert overlap(looked.moving(odds) > 0.25, blurred(body) > 0.25) > 0.9


def test_what_was_seen_for_sure_outweighs_colors_up_to_their_limit(rng: np.random.Generator) -> None:
    body = walker()
    looked = looked_at(picture(body, rng), blurred(body))
    for limit in (0.5, 2.0):
        odds = color_odds([looked], CONFIG.model_copy(update={"color_limit": limit}))
        assert np.abs(odds).max() == pytest.approx(limit)
    none = color_odds([looked], CONFIG.model_copy(update={"color_limit": 0.0}))
    np.testing.assert_array_equal(none, 0)
    np.testing.assert_allclose(looked.moving(none)[looked.near.unpacked()], looked.evidence)


def test_without_what_moves_or_what_stands_colors_say_nothing(rng: np.random.Generator) -> None:
    image = picture(walker(), rng)
    for evidence in (np.full(SIZE, 3.5, np.float32), np.full(SIZE, -3.5, np.float32), np.zeros(SIZE, np.float32)):
        everywhere = NearRegion.of(EVERYWHERE, image, evidence, REACH, EVERYWHERE)
        np.testing.assert_array_equal(color_odds([everywhere], CONFIG), 0)
    nothing = NearRegion.of(np.zeros(SIZE, bool), image, np.zeros(SIZE, np.float32), REACH, EVERYWHERE)
    np.testing.assert_array_equal(color_odds([nothing], CONFIG), 0)
    assert (nothing.moving(color_odds([nothing], CONFIG)) < -5).all()


def test_a_few_pixels_say_little(rng: np.random.Generator) -> None:
    evidence = np.full(SIZE, -3.0, np.float32)
    evidence[50, 60:63] = 3.5
    looked = NearRegion.of(EVERYWHERE, picture(walker(), rng), evidence, REACH, EVERYWHERE)
    odds = color_odds([looked], CONFIG)
    assert odds.max() < 1.2  # one of three pixels has a color: log((1/3 + 1/3) / (1/3)), and its neighbors less


def test_black_bars_have_no_color(rng: np.random.Generator) -> None:
    body = walker()
    image, evidence = picture(body, rng), blurred(body)
    image[:20], evidence[:20] = 0, 3.9  # bars seem to move where the scene does
    pictured = np.arange(SIZE[0])[:, None] * np.ones(SIZE) >= 20
    with_bars = NearRegion.of(evidence > 0.25, image, evidence, REACH, EVERYWHERE)
    looked = NearRegion.of(evidence > 0.25, image, evidence, REACH, pictured)
    black = 16 * 32 + 16  # the middle of both axes of color, and no lightness
    assert color_odds([with_bars], CONFIG)[black] > 2
    assert color_odds([looked], CONFIG)[black] == pytest.approx(0, abs=0.1)
    assert not (looked.moving(color_odds([looked], CONFIG))[:20] > -5).any()
