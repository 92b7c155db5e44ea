"""Cuts are found where they are; flashes, changes of exposure and whip pans are none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from uni4d_fg.arrays import ImageArray
from uni4d_fg.config.shots import ShotsConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.shots.cuts import Cut, _Dissolve, _Search, find_cuts
from uni4d_fg.frontend.shots.links import small_frame
from uni4d_fg.frontend.shots.one_place import show_one_place
from uni4d_fg.frontend.shots.survival import Span

CONFIG = ShotsConfig()
HEIGHT, WIDTH = 120, 160


def world(seed: int) -> ImageArray:
    """A wide picture of structure at several sizes."""
    rng = np.random.default_rng(seed)
    size = (2 * HEIGHT, 6 * WIDTH)
    layers = []
    for cell in (6, 14, 30):
        small = rng.uniform(size=(size[0] // cell + 1, size[1] // cell + 1)).astype(np.float32)
        layers.append(cv2.resize(small, size[::-1], interpolation=cv2.INTER_NEAREST))
    return np.round(235 * np.mean(layers, axis=0) + 10).astype(np.uint8)


def view(picture: ImageArray, x: float) -> ImageArray:
    begin = round(x)
    return picture[40 : 40 + HEIGHT, begin : begin + WIDTH]


def shot(seed: int, frames: int, speed: float = 1.0) -> ImageArray:
    picture = world(seed)
    return np.stack([view(picture, 100 + speed * t) for t in range(frames)])


def dissolved(one: ImageArray, other: ImageArray, length: int) -> ImageArray:
    stop, alpha = len(one) - length, np.arange(1, length + 1)[:, None, None] / (length + 1)
    between = (1 - alpha) * one[stop:] + alpha * other[:length]
    return np.concatenate((one[:stop], between.astype(np.uint8), other[length:]))


def cuts(frames: ImageArray) -> tuple[Cut, ...]:
    return find_cuts(ArrayFrames(frames), CONFIG)


def test_hard_cuts_are_found_to_the_frame() -> None:
    clip = np.concatenate((shot(0, 17), shot(1, 23, -2.0), shot(2, 14)))
    assert cuts(clip) == (Cut(17, 17), Cut(40, 40))
    color = np.repeat(clip[..., None], 3, axis=-1)
    assert cuts(color) == cuts(clip)


def test_one_shot_has_none() -> None:
    assert cuts(shot(0, 60, 3.0)) == ()
    assert cuts(shot(0, 1)) == ()


def test_frames_that_show_nothing_have_none() -> None:
    assert cuts(np.full((20, HEIGHT, WIDTH), 128, np.uint8)) == ()


@pytest.mark.parametrize("length", [1, 3])
@pytest.mark.parametrize("brightness", [120, 255])
def test_a_flash_is_no_cut(length: int, brightness: int) -> None:
    clip = shot(0, 40)
    clip[20 : 20 + length] = np.clip(clip[20 : 20 + length].astype(int) + brightness, 0, 255)
    assert cuts(clip) == ()


def test_a_change_of_exposure_is_no_cut() -> None:
    clip = shot(0, 40)
    clip[20:] = clip[20:] * 0.4
    assert cuts(clip) == ()


@pytest.mark.parametrize("step", [20, 50])
def test_a_whip_pan_is_no_cut(step: int) -> None:
    picture = world(0)
    at = np.concatenate((np.arange(20), 20 + step * np.arange(6), 20 + 5 * step + np.arange(1, 20))).astype(float)
    frames = []
    for x, following in zip(at, np.append(at[1:], at[-1]), strict=True):
        open_part = np.linspace(x, x + 0.5 * (following - x), 8)
        frames.append(np.mean([view(picture, 50 + p) for p in open_part], axis=0).astype(np.uint8))
    assert cuts(np.stack(frames)) == ()


@pytest.mark.parametrize("length", [8, 14])
def test_a_dissolve_is_one_cut_and_its_frames_are_of_neither_shot(length: int) -> None:
    found = cuts(dissolved(shot(0, 40), shot(1, 40), length))
    assert len(found) == 1
    assert abs(found[0].stop - (40 - length)) <= 2
    assert abs(found[0].start - 40) <= 2


def test_a_fade_through_black_is_one_cut() -> None:
    one, other = shot(0, 20), shot(1, 20)
    found = cuts(np.concatenate((one, np.zeros((6, HEIGHT, WIDTH), np.uint8), other)))
    assert found == (Cut(20, 26),)


def test_black_frames_within_a_shot_are_no_cut() -> None:
    clip = shot(0, 40)
    clip[18:24] = 0
    assert cuts(clip) == ()


def test_corners_outlive_what_is_no_dissolve() -> None:
    """What a dissolve found in small images is confirmed by."""
    clip, plain = dissolved(shot(0, 32), shot(1, 32), 8), shot(0, 56)
    cut = Cut(24, 32)
    searches = []
    for frames in (clip, plain):
        search = _Search([small_frame(frame, CONFIG) for frame in frames], CONFIG)
        search.run()
        searches.append(search)
    assert not searches[0].is_outlived(cut)
    assert searches[1].is_outlived(cut)
    found = cuts(clip)
    assert len(found) == 1
    assert abs(found[0].frame - cut.frame) <= 2


@pytest.mark.parametrize(("more", "is_one"), [(0.0, False), (0.2, True)])
def test_what_no_blend_explains_is_no_dissolve(monkeypatch: pytest.MonkeyPatch, more: float, is_one: bool) -> None:
    """As measured on a fast orbit: one side goes as the other comes, among much that neither of them shows."""
    shares = np.array([0.0, 0.11, 0.17, 0.28, 0.38, 0.56, 0.71, 0.86, 0.98])
    explained = np.array([0.77, 0.49, 0.32, 0.31, 0.34, 0.3, 0.37, 0.48, 0.77]) + more
    gained = np.array([0.0, 0.005, 0.011, 0.034, 0.084, 0.161, 0.074, 0.018, 0.0])
    search = _Search([small_frame(frame, CONFIG) for frame in shot(0, 11)], CONFIG)
    monkeypatch.setattr(search, "connected", lambda a, b: (False, np.eye(2, 3)))
    monkeypatch.setattr(search, "blend", lambda a, b: (shares, explained, gained))
    found = search.dissolve(Span(0, 10, 0.0))
    assert (None if found is None else found.cut) == (Cut(3, 9) if is_one else None)


def test_a_cut_that_larger_images_do_not_show_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = np.concatenate((shot(0, 20), shot(1, 20)))
    twice = [np.ascontiguousarray(cv2.resize(frame, None, fx=2, fy=2)) for frame in clip]
    assert find_cuts(ArrayFrames(np.stack(twice)), CONFIG) == (Cut(20, 20),)
    run = _Search.run
    monkeypatch.setattr(_Search, "run", lambda self: run(self) if max(self.frames[0].size) <= CONFIG.width else ())
    assert find_cuts(ArrayFrames(np.stack(twice)), CONFIG) == ()


@pytest.mark.parametrize(("part", "is_one"), [pytest.param(1.0, True, marks=pytest.mark.slow), (0.4, False)])
def test_a_dissolve_that_larger_images_do_not_show_must_be_explained(
    monkeypatch: pytest.MonkeyPatch, part: float, is_one: bool
) -> None:
    """No corner of a fast orbit outlives it either, and a blend of both ends explains some of it."""
    frames = dissolved(shot(1, 40), shot(2, 40), 8).repeat(2, axis=1).repeat(2, axis=2)
    there = cuts(frames)
    assert len(there) == 1
    assert there[0].start > there[0].stop
    run = _Search.run

    def small_only(search: _Search) -> tuple[Cut, ...]:
        if max(search.frames[0].size) > CONFIG.width:
            return ()
        found = run(search)
        search.explained = {cut: part * explained for cut, explained in search.explained.items()}
        assert min(search.explained.values()) > 0.8 * part
        return found

    monkeypatch.setattr(_Search, "run", small_only)
    monkeypatch.setattr(_Search, "is_outlived", lambda *_: False)
    assert cuts(frames) == (there if is_one else ())


@pytest.mark.parametrize("is_pan", [True, False])
def test_the_ends_of_a_dissolve_do_not_show_one_place(monkeypatch: pytest.MonkeyPatch, is_pan: bool) -> None:
    """In the blur of a fast pan corners are lost, and what lies between its ends looks like a blend of both."""
    frames = shot(0, 40, 4.0) if is_pan else dissolved(shot(0, 24), shot(1, 24), 8)
    monkeypatch.setattr(_Search, "run", lambda search: (Cut(16, 24),) if len(search.frames) == 40 else ())
    monkeypatch.setattr(_Search, "is_outlived", lambda *_: False)
    larger = frames.repeat(2, axis=1).repeat(2, axis=2)
    assert cuts(larger) == (() if is_pan else (Cut(16, 24),))


@pytest.mark.parametrize("is_one", [True, False])
def test_what_is_small_and_stays_shows_one_place_beside_what_is_large_and_does_not(is_one: bool) -> None:
    """As a room does through which people walk: halved, its pictures and books have too few features."""
    rng = np.random.default_rng(0)

    def room(of: int, people: int) -> ImageArray:
        image, small = np.full((480, 640), 170, np.uint8), np.random.default_rng(of)
        for k in range(12):  # 16 px of detail of one or two pixels each
            y, x = 20 + 110 * (k // 3), 400 + 75 * (k % 3)
            image[y : y + 16, x : x + 16] = cv2.GaussianBlur(small.integers(0, 255, (16, 16), np.uint8), (0, 0), 0.8)
        large = np.random.default_rng(people).integers(0, 255, (48, 30), np.uint8)
        image[:, 40:340] = cv2.resize(large, (300, 480), interpolation=cv2.INTER_CUBIC)
        noise = rng.normal(0, 2.0, image.shape)
        return np.clip(image + noise, 0, 255).astype(np.uint8)

    assert show_one_place(room(1, 5), room(1 if is_one else 2, 6)) is is_one


def test_a_search_can_be_stopped() -> None:
    with pytest.raises(Cancelled):
        find_cuts(ArrayFrames(shot(0, 10)), CONFIG, lambda: True)


@pytest.mark.data
@pytest.mark.parametrize("step", [1, -1])
def test_a_camera_that_follows_a_runner_dissolves_into_nothing(data_root: Path, step: int) -> None:
    """The background sweeps past and the runner changes all the time: few corners last, but nothing is blended."""
    images = list(open_video(data_root / "lady_running").images)
    small = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in images]
    assert find_cuts(ArrayFrames(np.stack(small[::step])), CONFIG) == ()


@pytest.mark.parametrize(
    ("elsewhere", "explained", "is_found"), [(0.5, 0.5, True), (0.05, 0.5, False), (0.05, 0.97, True)]
)
def test_where_corners_never_last_a_blend_must_explain_nearly_all(
    elsewhere: float, explained: float, is_found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the window of a train no corner outlives half a second, and two views of it may well pass for a blend."""
    frames = [small_frame(image, CONFIG) for image in shot(0, 40)]
    search = _Search(frames, CONFIG)
    search.run()
    across = Span(14, 24, 0.03)
    search.__dict__["spans"] = [across, *(Span(first, first + 10, elsewhere) for first in (0, 4, 26, 30))]
    found = _Dissolve(Cut(17, 21), True, explained, (4.0, 0.0))
    monkeypatch.setattr(_Search, "dissolve", lambda self, span: found if span is across else None)
    assert search.dissolves() == ([Cut(17, 21)] if is_found else [])
