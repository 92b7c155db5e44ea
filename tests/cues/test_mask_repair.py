"""Masks that were lost for a frame or two come back to where the thing is; all others stay as they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from mask_overlap import overlap

from uni4d_fg.cues.mask_repair import RepairedMasks, missing_gaps, repair_masks
from uni4d_fg.frontend.sequence.model import ArrayFrames

FRAMES, HEIGHT, WIDTH = 16, 120, 160
TOP, BOTTOM, WIDE = 40, 90, 45


def texture(rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, 2 * WIDTH, 3)), (0, 0), 1.5)
    return np.clip((noise - 127) * 4 + 127, 0, 255).astype(np.uint8)


def clip(rng: np.random.Generator, hidden: tuple[int, ...] = (), number: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Images of a textured thing that crosses a textured wall, and its true masks; in some frames it is not there."""
    noise, images, masks = texture(rng), [], []
    for frame in range(FRAMES):
        left = 30 + 3 * frame
        mask = np.zeros((HEIGHT, WIDTH), np.int32)
        if frame not in hidden:
            mask[TOP:BOTTOM, left : left + WIDE] = number
        thing = np.roll(noise, left, axis=1)[:, :WIDTH]
        images.append(np.where(mask[..., None] > 0, thing, noise[:, WIDTH:]))
        masks.append(mask)
    return np.stack(images), np.stack(masks)


def repaired(images: np.ndarray, masks: np.ndarray) -> RepairedMasks | None:
    return repair_masks(ArrayFrames(images), ArrayFrames(masks), (HEIGHT, WIDTH))


def test_missing_masks_are_made_and_no_other_is_touched(rng: np.random.Generator) -> None:
    images, truth = clip(rng, number=2**31 - 1)
    given = truth.copy()
    given[[7, 11, 12]] = 0
    given[7, TOP : TOP + 3, 55:60] = 2**31 - 1  # a speck is no mask
    found = repaired(images, given)
    assert found is not None
    assert found.frames == [7, 11, 12]
    for frame in range(FRAMES):
        if frame in found.frames:
            assert overlap(found[frame], truth[frame]) > 0.93
            assert found[frame].dtype == np.int32
            assert set(np.unique(found[frame])) == {0, 2**31 - 1}
        else:
            np.testing.assert_array_equal(found[frame], truth[frame])
    assert (given[7] > 0).sum() == 15  # the masks that were given are not written to


def test_masks_beside_may_be_cut_unlike(rng: np.random.Generator) -> None:
    """One too large and the other too small, as segmenters cut them: the smaller lies in the larger."""
    images, truth = clip(rng)
    given = truth.copy()
    given[7] = 0
    for frame, change, px in ((6, cv2.dilate, 6), (8, cv2.erode, 3)):
        given[frame] = 2 * change((truth[frame] == 2).astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1), np.uint8))
    assert overlap(given[6], given[8]) < 0.5
    found = repaired(images, given)
    assert found is not None
    assert found.frames == [7]
    assert overlap(found[7], truth[7]) > 0.85


def test_only_the_lost_one_of_two_instances_is_made(rng: np.random.Generator) -> None:
    images, truth = clip(rng)
    truth[:, 95:110, 20:60] = 1  # something else, which stands still
    given = truth.copy()
    given[7][given[7] == 2] = 0
    found = repaired(images, given)
    assert found is not None
    assert overlap(found[7] == 2, truth[7] == 2) > 0.93
    np.testing.assert_array_equal(found[7] == 1, truth[7] == 1)


@pytest.mark.parametrize("hidden", [(7,), (7, 8)])
def test_a_thing_that_is_not_in_the_picture_gets_no_mask(rng: np.random.Generator, hidden: tuple[int, ...]) -> None:
    assert repaired(*clip(rng, hidden)) is None


def test_a_thing_behind_another_gets_no_mask(rng: np.random.Generator) -> None:
    images, truth = clip(rng)
    images[7, TOP - 5 : BOTTOM + 5, 45:102] = texture(rng)[TOP - 5 : BOTTOM + 5, 45:102]
    truth[7] = 0
    assert repaired(images, truth) is None


def test_a_thing_that_got_another_number_keeps_it(rng: np.random.Generator) -> None:
    images, truth = clip(rng)
    truth[7][truth[7] > 0] = 9
    assert repaired(images, truth) is None


@pytest.mark.parametrize("kept", [slice(None, None, 2), slice(None, None, 3), slice(None, None, 5), slice(4, 12)])
def test_masks_of_some_frames_only_are_left_alone(rng: np.random.Generator, kept: slice) -> None:
    images, truth = clip(rng)
    given = np.zeros_like(truth)
    given[kept] = truth[kept]
    assert repaired(images, given) is None


def test_sound_masks_and_none_at_all_are_left_alone(rng: np.random.Generator) -> None:
    images, truth = clip(rng)
    assert repaired(images, truth) is None
    assert repaired(images, np.zeros_like(truth)) is None


def test_gaps_are_short_rare_and_between_masks_alike() -> None:
    def gaps(changed: dict[int, float], frames: int = 20) -> list[tuple[int, int]]:
        area = np.full(frames, 500.0)
        for frame, value in changed.items():
            area[frame] = value
        return missing_gaps(area)

    assert gaps({}) == []
    assert gaps({5: 0, 9: 0, 10: 20}) == [(5, 5), (9, 10)]
    assert gaps({0: 0, 19: 0}) == []  # it comes and goes
    assert gaps({5: 0, 6: 0, 7: 0}) == []  # too long
    assert gaps({2: 0, 5: 0, 8: 0, 11: 0, 14: 0}) == []  # too often
    assert gaps({5: 0, **dict.fromkeys(range(6, 20), 100.0)}) == []  # unlike on both sides
    assert gaps({frame: 10.0 for frame in range(20)} | {5: 0}) == []  # too small
    assert missing_gaps(np.zeros(6)) == []
