"""Masks that grow and shrink are averaged to where the thing is; true changes and normal noise are left alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from mask_overlap import overlap

from uni4d_fg.cues import mask_flicker
from uni4d_fg.cues.mask_distance import PackedDistance, signed_distance
from uni4d_fg.cues.mask_flicker import may_flicker
from uni4d_fg.cues.mask_repair import RepairedMasks, repair_masks
from uni4d_fg.frontend.sequence.model import ArrayFrames

FRAMES, HEIGHT, WIDTH, SIDE = 20, 120, 160, 48


def clip(rng: np.random.Generator, sizes: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """A textured square that crosses a textured wall and has a size (of :data:`SIDE`) per frame, and its true masks."""
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, 2 * WIDTH, 3)), (0, 0), 1.5)
    noise = np.clip((noise - 127) * 4 + 127, 0, 255).astype(np.uint8)
    images, masks = [], []
    for frame, scale in enumerate(sizes):
        side = round(scale * SIDE)
        top, left = (HEIGHT - side) // 2, 45 + 2 * frame - side // 2
        image, mask = noise[:, WIDTH:].copy(), np.zeros((HEIGHT, WIDTH), np.int32)
        image[top : top + side, left : left + side] = cv2.resize(noise[:SIDE, :SIDE], (side, side))
        mask[top : top + side, left : left + side] = 2
        images.append(image)
        masks.append(mask)
    return np.stack(images), np.stack(masks)


def flickering(truth: np.ndarray, px: int) -> np.ndarray:
    """Masks that are too large by some pixels in one frame, and too small in the next."""
    out = truth.copy()
    for frame, mask in enumerate(truth):
        change = cv2.dilate if frame % 2 else cv2.erode
        out[frame] = 2 * change((mask == 2).astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1), np.uint8))
    return out


def repaired(images: np.ndarray, masks: np.ndarray) -> RepairedMasks | None:
    return repair_masks(ArrayFrames(images), ArrayFrames(masks), (HEIGHT, WIDTH))


def test_flickering_masks_are_averaged_to_the_truth(rng: np.random.Generator) -> None:
    images, truth = clip(rng, [1.0] * FRAMES)
    given = flickering(truth, 4)
    given[7] = 0
    found = repaired(images, given)
    assert found is not None
    assert found.instances == [2]
    assert found.frames == [7]
    before = [overlap(given[frame] > 0, truth[frame] > 0) for frame in range(FRAMES)]
    after = [overlap(found[frame] > 0, truth[frame] > 0) for frame in range(FRAMES)]
    assert np.mean(before) < 0.72
    assert np.mean(after) > 0.9
    assert min(after[2:-2]) > 0.8


def test_masks_that_are_too_large_or_too_small_for_some_frames_are_averaged(rng: np.random.Generator) -> None:
    """In half of the frames those beside are alike, and where they change one lies deep within the other."""
    images, truth = clip(rng, [1.0] * FRAMES)
    large = np.repeat([True, False, True, False, True], FRAMES // 5)
    given = truth.copy()
    for frame in range(FRAMES):
        change = cv2.dilate if large[frame] else cv2.erode
        given[frame] = 2 * change((truth[frame] == 2).astype(np.uint8), np.ones((13, 13), np.uint8))
    found = repaired(images, given)
    assert found is not None
    assert found.instances == [2]
    ends = np.flatnonzero(np.diff(large))  # where the change is, both sides are averaged
    after = [overlap(found[frame], truth[frame]) for frame in (*ends, *(ends + 1))]
    assert max(overlap(given[frame], truth[frame]) for frame in ends) < 0.66
    assert min(after) > 0.75


@pytest.mark.parametrize("there", [slice(0, 130), slice(60, 80)])
def test_in_a_long_video_a_sample_of_frames_tells_first(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, there: slice
) -> None:
    """What flickers is found wherever it is, and averaged in all frames; what is sound costs the sample's flow only."""
    looked: list[int] = []

    def counted(near: object, labels: list[int], frame: int) -> object:
        looked.append(frame)
        return averaged(near, labels, frame)

    averaged = mask_flicker._averaged
    monkeypatch.setattr(mask_flicker, "_averaged", counted)
    images, truth = clip(rng, [1.0] * FRAMES)
    walk = np.abs((np.arange(130) + FRAMES) % (2 * FRAMES - 2) - FRAMES + 1)  # there and back
    images, truth = images[walk], truth[walk]
    given = np.where(np.isin(np.arange(130), np.arange(130)[there])[:, None, None], flickering(truth, 4), 0)
    found = repaired(images, given)
    assert found is not None
    assert found.instances == [2]
    shown = range(130)[there][2:-2]
    assert min(overlap(found[frame] > 0, truth[frame] > 0) for frame in shown) > 0.8
    looked.clear()
    growing, grown = clip(rng, [0.93, 1.07] * (FRAMES // 2))
    assert repaired(growing[walk], grown[walk]) is None
    assert 0 < len(looked) <= 48


def test_another_instance_keeps_its_pixels(rng: np.random.Generator) -> None:
    images, truth = clip(rng, [1.0] * FRAMES)
    given = flickering(truth, 4)
    given[:, 50:, :34][given[:, 50:, :34] == 0] = 5  # beside it in the first frames, and whole after
    found = repaired(images, given)
    assert found is not None
    assert found.instances == [2]
    for frame in range(FRAMES):
        np.testing.assert_array_equal(found[frame] == 5, given[frame] == 5)


def test_good_masks_stay_as_they_are(rng: np.random.Generator) -> None:
    images, truth = clip(rng, [1.0] * FRAMES)
    assert repaired(images, truth) is None
    given = truth.copy()
    for frame, kind in enumerate(rng.integers(0, 3, FRAMES)):  # the noise of a good segmenter
        given[frame] = (truth, flickering(truth, 1), flickering(truth[::-1], 1)[::-1])[kind][frame]
    assert not np.array_equal(given, truth)
    assert repaired(images, given) is None


@pytest.mark.parametrize("swing", [0.05, 0.07, 0.1])
def test_a_thing_that_really_grows_and_shrinks_stays_as_it_is(rng: np.random.Generator, swing: float) -> None:
    images, truth = clip(rng, [1 - swing, 1 + swing] * (FRAMES // 2))
    area = np.count_nonzero(truth, axis=(1, 2)).astype(float)
    assert may_flicker(area)  # flow has to tell
    assert repaired(images, truth) is None


def test_a_thing_that_comes_nearer_does_not_flicker() -> None:
    assert not may_flicker(400.0 * 1.25 ** np.arange(12.0))
    assert not may_flicker(np.zeros(12))
    assert not may_flicker(np.array([900.0, 400.0]))


def test_distances_are_packed_to_a_tenth_of_a_px() -> None:
    mask = np.zeros((60, 80), bool)
    mask[20:35, 0:30] = True
    distance = signed_distance(mask)
    packed = PackedDistance.of(distance)
    np.testing.assert_allclose(packed.whole(), distance, atol=0.0501)
    assert packed.steps.nbytes < mask.size / 2
    assert (PackedDistance.of(signed_distance(np.zeros_like(mask))).whole() < 0).all()
