"""Regions that move end where colors do."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.region_colors import end_at_colors
from uni4d_fg.cues.track_motion import TrackMotion
from uni4d_fg.frontend.track_model import Tracks

SIZE = (180, 240)
CONFIG = MotionMaskConfig()


def walker() -> np.ndarray:
    """A body with a head and two legs, (H, W)."""
    mask = np.zeros(SIZE, np.uint8)
    cv2.circle(mask, (120, 40), 12, 1, -1)
    cv2.rectangle(mask, (102, 52), (138, 110), 1, -1)
    cv2.rectangle(mask, (104, 110), (112, 160), 1, -1)
    cv2.rectangle(mask, (126, 110), (134, 160), 1, -1)
    return mask > 0


def picture(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The body in red and blue before a wall and a floor of other colors, with noise; RGB."""
    image = np.empty((*SIZE, 3))
    image[:120], image[120:] = (170, 160, 120), (90, 110, 80)
    image[mask] = (150, 40, 40)
    image[mask & (np.arange(SIZE[0])[:, None] >= 110)] = (30, 40, 110)
    return np.clip(image + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)


def tracks_at(uv: list[tuple[float, float]]) -> tuple[Tracks, TrackMotion]:
    """Static tracks in one frame."""
    count = len(uv)
    tracks = Tracks(
        np.array(uv, np.float32).reshape(count, 1, 2), np.ones((count, 1), bool), np.zeros(count, np.int32)
    )  # fmt: skip
    return tracks, TrackMotion(np.zeros(count, bool), np.ones(count, bool), np.zeros(count))


def ended(
    region: np.ndarray, image: np.ndarray, uv: list[tuple[float, float]], evidence: np.ndarray | None = None,
    **changes: int,
) -> np.ndarray:  # fmt: skip
    tracks, motion = tracks_at(uv)
    config = CONFIG.model_copy(update=changes)
    scale = np.array([image.shape[1] / region.shape[1], image.shape[0] / region.shape[0]])
    evidence = np.ones(image.shape[:2], np.float32) if evidence is None else evidence
    return end_at_colors(region, image, evidence, tracks, motion, 0, scale, config)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


BESIDE = [(60.0, 60.0), (180.0, 60.0), (60.0, 140.0), (180.0, 140.0)]


def rough(mask: np.ndarray) -> np.ndarray:
    """What evidence makes of the body: without head and feet, too wide, and with a strip of the wall."""
    region = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 8) > 0.4
    region[:45] = region[140:] = False
    region[60:66, 138:170] = True
    return region


@pytest.mark.parametrize("larger", [1, 2])
def test_head_and_legs_are_found_and_what_is_beside_goes(larger: int, rng: np.random.Generator) -> None:
    truth = walker()
    image = picture(truth, rng)
    size = (SIZE[1] * larger, SIZE[0] * larger)
    region, whole = (
        cv2.resize(m.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for m in (rough(truth), truth)
    )
    uv = [(u * larger, v * larger) for u, v in BESIDE]
    found = ended(region, image, uv)
    assert found.shape == whole.shape
    assert overlap(region, whole) < 0.75
    assert overlap(found, whole) > 0.93
    np.testing.assert_array_equal(ended(region, image, uv), found)  # nothing is left to chance


def test_it_reaches_no_farther_than_said(rng: np.random.Generator) -> None:
    truth = walker()
    image, region = picture(truth, rng), rough(truth)
    found = ended(region, image, BESIDE, color_reach_px=6)
    near = (
        cv2.dilate(region.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (19, 19))) > 0
    )  # 6 and 2, and the corners of disks
    assert not (found & ~near).any()
    assert overlap(found, truth) > overlap(region, truth)
    np.testing.assert_array_equal(ended(region, image, BESIDE, color_reach_px=0), region)


def test_the_core_stays_even_in_the_colors_of_what_is_around(rng: np.random.Generator) -> None:
    image = np.clip(rng.normal(120, 6, (*SIZE, 3)), 0, 255).astype(np.uint8)
    region = np.zeros(SIZE, bool)
    region[40:140, 90:150] = True
    found = ended(region, image, BESIDE)
    core = cv2.erode(region.astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    assert found[core].all()


def test_around_a_static_track_nothing_moves(rng: np.random.Generator) -> None:
    truth = walker()
    image, region = picture(truth, rng), rough(truth)
    at = (120.0, 36.0)  # on the head, outside of the region
    assert not region[36, 120]
    assert ended(region, image, BESIDE)[36, 120]
    assert not ended(region, image, [*BESIDE, at])[36, 120]


def test_a_region_without_anything_around_it_is_returned(rng: np.random.Generator) -> None:
    image = rng.integers(0, 255, (*SIZE, 3)).astype(np.uint8)
    whole, nothing = np.ones(SIZE, bool), np.zeros(SIZE, bool)
    np.testing.assert_array_equal(ended(whole, image, []), whole)
    np.testing.assert_array_equal(ended(nothing, image, []), nothing)


def test_what_is_background_for_sure_is_left_out_whatever_its_color(rng: np.random.Generator) -> None:
    mask = walker()
    image = picture(mask, rng)
    evidence = np.ones(mask.shape, np.float32)
    evidence[:80] = -1  # the red upper half is what a red wall shows
    found = ended(mask, image, BESIDE, evidence)
    assert not found[:79].any()
    assert overlap(found[82:], mask[82:]) > 0.9
    assert not ended(mask, image, BESIDE, -np.ones(mask.shape, np.float32)).any()


def test_what_moves_for_sure_stays_however_thin_and_whatever_its_color(rng: np.random.Generator) -> None:
    image = np.clip(rng.normal(120, 6, (*SIZE, 3)), 0, 255).astype(np.uint8)
    image[40:100, 40:100] = np.clip(rng.normal((30, 40, 110), 6, (60, 60, 3)), 0, 255)  # the colors are this thing's
    region, thin = np.zeros(SIZE, bool), np.zeros(SIZE, bool)
    thin[60:120, 150:156] = True
    region[40:100, 40:100] = True
    region |= thin
    evidence = np.ones(SIZE, np.float32)
    unsure = ended(region, image, [], evidence)
    assert unsure[thin].mean() < 0.2
    evidence[thin] = CONFIG.color_sure + 0.1
    sure = ended(region, image, [], evidence)
    assert sure[thin].all()
    near = cv2.dilate(region.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert not (sure & ~near).any()
