"""Black bars: found where there are some, and only there."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from video_samples import write_video

from uni4d_fg.frontend.sequence.bars import bars_note, find_content, tracks_inside, without_bars
from uni4d_fg.frontend.sequence.model import ArrayFrames, Content, Video
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.track_model import Tracks

SIZE = (120, 160)


def pan(length: int = 10, seed: int = 0, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A textured plane moving by 3 px a frame, (T, H, W, 3)."""
    noise = np.random.default_rng(seed).integers(0, 256, (size[0], size[1] + 3 * length, 3), dtype=np.uint8)
    wide = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
    return np.stack([wide[:, 3 * i : 3 * i + size[1]] for i in range(length)])


def overlap(found: Content, true: Content, size: tuple[int, int]) -> float:
    """Intersection over union of the bars."""
    masks = []
    for content in (found, true):
        mask = np.ones(size, bool)
        mask[content.slices] = False
        masks.append(mask)
    return float((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())


@pytest.mark.parametrize("sides", [(15, 15, 0, 0), (0, 0, 20, 20), (10, 30, 0, 0), (12, 12, 9, 9), (2, 2, 0, 0)])
@pytest.mark.parametrize("encoded", [False, True])
def test_bars_are_found(tmp_path: Path, sides: tuple[int, int, int, int], encoded: bool) -> None:
    top, bottom, left, right = sides
    frames = pan()
    true = Content(top, SIZE[0] - bottom, left, SIZE[1] - right)
    black = np.ones(SIZE, bool)
    black[true.slices] = False
    frames[:, black] = 0
    images = open_video(write_video(tmp_path / "a.mp4", list(frames))).images if encoded else ArrayFrames(frames)
    found = find_content(images)
    # A coded edge is blurred into the bar by a line or two.
    edge = 2 if encoded else 0
    assert max(abs(getattr(found, s) - getattr(true, s)) for s in ("top", "bottom", "left", "right")) <= edge
    if min(s for s in sides if s) > 5:
        assert overlap(found, true, SIZE) > (0.85 if encoded else 0.999)
    assert bars_note(found, SIZE)[0].startswith("black bars are left out: ")


def test_what_is_dark_is_no_bar() -> None:
    whole = Content(0, SIZE[0], 0, SIZE[1])
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    hills = pan()
    hills[:, y < 20 + 15 * np.sin(x / 25.0)] = 0  # a night sky above hills
    fading = pan()
    fading[:] = fading * np.clip(y / 60.0, 0.0, 1.0)[..., None]  # light that falls off upwards
    lamp = np.zeros_like(pan())
    lamp[:, 40:80, 60:100] = 200  # a light in the dark
    night = (pan() * 0.04).astype(np.uint8)
    fade_in = pan() * (np.arange(10) > 4)[:, None, None, None].astype(np.uint8)
    for frames in (hills, fading, lamp, night, np.zeros_like(lamp), fade_in, pan()):
        assert find_content(ArrayFrames(frames)) == whole
        assert bars_note(find_content(ArrayFrames(frames)), SIZE) == []


@pytest.mark.skipif("UNI4D_FG_DATA" not in os.environ, reason="needs the recordings (UNI4D_FG_DATA)")
@pytest.mark.parametrize("name", ["kitchen", "kitchen_dog", "lady_running"])
def test_no_bars_in_recordings(name: str) -> None:
    video = open_video(Path(os.environ["UNI4D_FG_DATA"]) / name)
    assert find_content(video.images) == Content(0, video.image_size[0], 0, video.image_size[1])


def test_what_lies_in_bars_says_nothing() -> None:
    frames = pan()
    frames[:, :15] = frames[:, -15:] = 0
    uv = np.full((2, 10, 2), 5.0, np.float32)
    uv[1] = 60.0
    tracks = Tracks(uv, np.ones((2, 10), bool), np.zeros(2, np.int32))
    video = Video(
        "a", ArrayFrames(frames), SIZE, np.arange(10.0), depths=ArrayFrames(np.ones((10, *SIZE), np.float32)),
        masks=ArrayFrames(np.ones((10, *SIZE), np.int32)), tracks=tracks,
    )  # fmt: skip
    seen = without_bars(video)
    assert seen.content == Content(15, 105, 0, 160)
    assert seen.depths is not None
    assert seen.masks is not None
    assert seen.tracks is not None
    depth, mask = seen.depths[3], seen.masks[-1]
    assert np.isnan(depth[:15]).all() and np.isnan(depth[105:]).all() and (depth[15:105] == 1).all()  # noqa: PT018
    assert mask.sum() == 90 * 160
    assert seen.tracks.visible.sum(axis=1).tolist() == [0, 10]
    assert seen.images is video.images
    assert without_bars(seen) is seen
    assert without_bars(video, look=False).depths is video.depths
    assert tracks_inside(tracks, Content(0, 120, 0, 160)).visible.all()
