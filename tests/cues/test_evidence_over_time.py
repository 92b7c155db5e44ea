"""Evidence averaged along optical flow: what a surface says in one frame is known of it in others, and of no other."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues import evidence_over_time
from uni4d_fg.cues.evidence_over_time import LookedAt, averaged_over_time
from uni4d_fg.optim.threads import thread_limit

SIZE, SIDE, STEP = (96, 160), 36, 3
"""Of the image and of a square that moves to the right by as many pixels per frame."""
DECAY = MotionMaskConfig().memory


def texture(shape: tuple[int, int], seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (*shape, 3)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2)
    return np.clip(128 + 4 * (blurred - blurred.mean()), 0, 255).astype(np.uint8)


def left_of(frame: int) -> int:
    return 8 + STEP * frame


def core(frame: int) -> tuple[slice, slice]:
    """Return where the square is for sure."""
    return slice(38, 58), slice(left_of(frame) + 8, left_of(frame) + SIDE - 8)


def video(frames: int, evidence: np.ndarray) -> list[LookedAt]:
    """Return a square that moves, with evidence (T,) of its pixels, before what says -2."""
    background, square = texture(SIZE, 0), texture((SIDE, SIDE), 1)
    looked = []
    for frame in range(frames):
        image, said = background.copy(), np.full(SIZE, -2, np.float32)
        where = slice(30, 30 + SIDE), slice(left_of(frame), left_of(frame) + SIDE)
        image[where], said[where] = square, evidence[frame]
        looked.append(LookedAt(image, said, np.ones(SIZE, np.float32)))
    return looked


def averaged(frames: list[LookedAt], **changes: float) -> list[np.ndarray]:
    return [found.evidence for found in averaged_over_time(iter(frames), MotionMaskConfig().model_copy(update=changes))]


def test_what_one_frame_says_of_a_surface_is_known_in_all() -> None:
    said = np.zeros(9)
    said[3] = 3.0
    found = averaged(video(9, said))
    for frame in range(9):
        weight = DECAY ** np.abs(np.arange(9) - frame)
        expected = weight @ said / weight.sum()
        assert np.median(found[frame][core(frame)]) == pytest.approx(expected, rel=0.1)  # flow is not exact
        assert np.median(found[frame][:24]) == pytest.approx(-2, abs=1e-3)


def test_what_is_only_assumed_counts_less() -> None:
    said = np.array([-1.0, 3.0, -1.0])
    seen = np.array([0.3, 1.0, 0.3], np.float32)
    frames = [f._replace(weight=np.full(SIZE, s)) for f, s in zip(video(3, said), seen, strict=True)]
    for frame, found in enumerate(averaged(frames)):
        weight = seen * DECAY ** np.abs(np.arange(3) - frame)
        assert np.median(found[core(frame)]) == pytest.approx(weight @ said / weight.sum(), rel=0.05)
        assert np.median(found[:24]) == pytest.approx(-2, abs=1e-3)


def test_what_comes_out_from_behind_keeps_what_it_says() -> None:
    found = averaged(video(9, np.full(9, 3.0)))
    uncovered = slice(38, 58), slice(left_of(0) + 4, left_of(8) - 4)  # the square was there, and is not any more
    assert np.quantile(found[8][uncovered], 0.95) < -1.5
    assert np.quantile(found[8][core(8)], 0.05) > 2.9


def test_a_frame_alone_says_no_more_than_that() -> None:
    said = np.zeros(9)
    said[3] = 300.0
    found = averaged(video(9, said))
    weight = DECAY ** np.abs(np.arange(9) - 4)
    assert np.median(found[4][core(4)]) == pytest.approx(4.0 * weight[3] / weight.sum(), rel=0.05)


def test_other_colors_are_another_surface() -> None:
    frames = video(2, np.array([3.0, -1.0]))
    inverted = frames[0]._replace(image=255 - frames[0].image)
    found = averaged([inverted, frames[1]])
    for own, frame in zip(found, (inverted, frames[1]), strict=True):
        # Inverted texture is alike where it is middle gray.
        assert np.mean(np.abs(own - frame.evidence) > 0.2) < 0.03


def test_long_videos_are_averaged_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    said = np.random.default_rng(3).normal(1, 1, 24)
    frames = video(24, said)
    whole = averaged(frames)
    monkeypatch.setattr(evidence_over_time, "_BLOCK", 5)
    monkeypatch.setattr(evidence_over_time, "_AHEAD", 8)
    parts = averaged(frames)
    assert len(parts) == len(whole) == 24
    for frame, (part, all_at_once) in enumerate(zip(parts, whole, strict=True)):
        # What is farther behind than frames are looked at ahead: 0.9^8 of a side of the average.
        assert np.abs(part - all_at_once)[core(frame)].max() < 0.45
        if frame >= 15:  # of the last frames all that are behind are seen
            np.testing.assert_allclose(part, all_at_once, atol=1e-4)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_frames(count: int) -> None:
    frames = video(count, np.full(count, 1.0))
    found = averaged(frames)
    assert len(found) == count
    for own, frame in zip(found, frames, strict=True):
        assert np.median(np.abs(own - frame.evidence)) == 0


def test_without_memory_nothing_changes() -> None:
    frames = video(4, np.array([9.0, -1.0, 2.0, 0.0]))
    for own, frame in zip(averaged(frames, memory=0.0), frames, strict=True):
        np.testing.assert_array_equal(own, frame.evidence)


def test_threads_change_no_byte() -> None:
    frames = video(6, np.arange(6.0))
    found = []
    for threads in (1, 3):
        with thread_limit(threads):
            found.append(np.stack(averaged(frames)).tobytes())
    assert found[0] == found[1]
