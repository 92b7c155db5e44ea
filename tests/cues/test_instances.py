"""Instances over time on shapes that move over a textured background."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.motion_masks import InstanceConfig
from uni4d_fg.cues.detections import FrameDetections
from uni4d_fg.cues.instances import associate_instances, components
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames

SIZE = (96, 160)


def texture(seed: int, size: tuple[int, int]) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (*size, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return np.clip((smooth - smooth.mean()) * 4 + 128, 0, 255).astype(np.uint8)


class Scene:
    """Square things (id -> top left corner per frame, None where absent); later ones hide earlier ones."""

    def __init__(self, corners: dict[int, list[tuple[int, int] | None]], side: int = 28) -> None:
        frames = len(next(iter(corners.values())))
        background = texture(0, SIZE)
        self.images = np.repeat(background[None], frames, axis=0)
        self.truth = np.zeros((frames, *SIZE), np.int32)
        for number, path in corners.items():
            patch = texture(number, (side, side))
            for t, corner in enumerate(path):
                if corner is None:
                    continue
                y, x = corner
                rows, columns = slice(max(y, 0), min(y + side, SIZE[0])), slice(max(x, 0), min(x + side, SIZE[1]))
                inside = patch[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]
                self.images[t, rows, columns] = inside
                self.truth[t, rows, columns] = number

    def detections(self, seed: int = 0, missing: set[tuple[int, int]] = frozenset()) -> list[FrameDetections]:  # type: ignore[assignment]
        """What is visible of every thing, in random order, without the (frame, id) in ``missing``."""
        rng = np.random.default_rng(seed)
        result = []
        for t, labels in enumerate(self.truth):
            ids = [n for n in np.unique(labels[labels > 0]).tolist() if (t, n) not in missing]
            ids = [ids[i] for i in rng.permutation(len(ids))]
            masks = np.array([labels == n for n in ids], bool).reshape(len(ids), *SIZE)
            result.append(FrameDetections(masks, np.ones(len(ids), np.int32), np.ones(len(ids), np.float32)))
        return result


def associate(scene: Scene, found: list[FrameDetections], **changes: object) -> np.ndarray:
    config = InstanceConfig(**{"min_area_px": 20, "drawn_missed_frames": 0, **changes})
    return np.stack(list(associate_instances(found, ArrayFrames(scene.images), config)))


def numbers_of(result: np.ndarray, truth: np.ndarray, number: int) -> list[int | None]:
    """The number that is given to a thing in each frame; None where it is not seen."""
    out: list[int | None] = []
    for labels, true in zip(result, truth, strict=True):
        values = labels[true == number]
        out.append(int(np.bincount(values).argmax()) if len(values) else None)
    return out


def test_two_things_that_cross_keep_their_numbers() -> None:
    steps = range(24)
    scene = Scene({1: [(30, 5 + 5 * t) for t in steps], 2: [(44, 125 - 5 * t) for t in steps]})
    result = associate(scene, scene.detections(seed=3))
    first, second = (set(numbers_of(result, scene.truth, n)) - {None} for n in (1, 2))
    assert len(first) == len(second) == 1
    assert first != second
    assert result.max() == 2


def test_what_is_hidden_for_some_frames_comes_back_with_its_number() -> None:
    steps = range(24)
    # The second thing stands still and hides all of the first in its middle frames.
    scene = Scene({1: [(40, 4 * t) for t in steps], 2: [(30, 46)] * 24}, side=24)
    scene.truth[(scene.truth == 1) & (np.arange(24)[:, None, None] >= 11) & (np.arange(24)[:, None, None] <= 13)] = 0
    result = associate(scene, scene.detections())
    assert set(numbers_of(result, scene.truth, 1)) - {None} == {numbers_of(result, scene.truth, 1)[0]}
    assert result.max() == 2


def test_a_thing_that_a_segmenter_misses_keeps_its_number_only_so_long() -> None:
    scene = Scene({1: [(30, 5 + 5 * t) for t in range(20)]})
    found = scene.detections(missing={(t, 1) for t in range(8, 12)})
    result = associate(scene, found)
    assert numbers_of(result, scene.truth, 1) == [1] * 8 + [0] * 4 + [1] * 8
    impatient = associate(scene, found, max_missed_frames=2)
    assert numbers_of(impatient, scene.truth, 1) == [1] * 8 + [0] * 4 + [2] * 8


def test_a_missed_thing_is_drawn_where_it_would_be() -> None:
    scene = Scene({1: [(30, 5 + 5 * t) for t in range(12)]})
    result = associate(scene, scene.detections(missing={(7, 1), (8, 1), (9, 1)}), drawn_missed_frames=2)
    for t in (7, 8):
        drawn, true = result[t] == 1, scene.truth[t] == 1
        assert (drawn & true).sum() / (drawn | true).sum() > 0.75
    assert not result[9].any()


def test_a_fast_pan_is_followed_by_flow_and_not_by_overlap_alone() -> None:
    # Things of 12 px, 15 px apart, move by 10 px per frame: each overlaps most with the place of its neighbor.
    scene = Scene({n: [(30, 100 + 15 * (n - 1) - 10 * t) for t in range(5)] for n in (1, 2)}, side=12)
    canvas = texture(0, (SIZE[0], SIZE[1] + 64))
    for n in (1, 2):
        canvas[30:42, 100 + 15 * (n - 1) : 112 + 15 * (n - 1)] = texture(n, (12, 12))
    scene.images = np.stack([canvas[:, 10 * t : 10 * t + SIZE[1]] for t in range(5)])
    result = associate(scene, scene.detections(seed=1))
    assert [len(set(numbers_of(result, scene.truth, n))) for n in (1, 2)] == [1, 1]
    scene.images = np.full_like(scene.images, 128)
    assert len(set(numbers_of(associate(scene, scene.detections(seed=1)), scene.truth, 2))) > 1


def test_another_class_does_not_continue_an_instance_if_so_configured() -> None:
    scene = Scene({1: [(30, 20)] * 4})
    found = scene.detections()
    found[2] = FrameDetections(found[2].masks, np.array([5], np.int32), found[2].scores)
    assert numbers_of(associate(scene, found), scene.truth, 1) == [1, 1, 1, 1]
    assert numbers_of(associate(scene, found, same_class=True), scene.truth, 1) == [1, 1, 2, 1]


def test_the_surer_detection_lies_on_top_and_unsure_ones_are_dropped() -> None:
    scene = Scene({1: [(30, 20)], 2: [(30, 34)]})
    whole = np.zeros((3, *SIZE), bool)
    whole[0, 30:58, 20:48], whole[1, 30:58, 34:62], whole[2, 0:20, 0:20] = True, True, True
    found = FrameDetections(whole, np.ones(3, np.int32), np.array([0.9, 0.6, 0.1], np.float32))
    result = associate(scene, [found])[0]
    assert (result[30:58, 20:48] == result[30, 20]).all()
    assert result[30, 60] not in (0, result[30, 20])
    assert not result[:20, :20].any()


def test_parts_of_one_thing_share_its_number() -> None:
    scene = Scene({1: [(30, 20)] * 3})
    found = scene.detections()
    broken = np.repeat(found[1].masks, 2, axis=0)
    broken[0, :, 32:], broken[1, :, :38] = False, False
    found[1] = FrameDetections(broken, np.ones(2, np.int32), np.ones(2, np.float32))
    joined = associate(scene, found, join_parts=True)
    assert set(np.unique(joined)) == {0, 1}
    assert set(np.unique(associate(scene, found)[1])) == {0, 1, 2}


@pytest.mark.parametrize(("first_touch", "stay_apart"), [(8, True), (3, False)], ids=["long apart", "hardly apart"])
def test_things_that_were_apart_stay_so_where_they_touch(first_touch: int, stay_apart: bool) -> None:
    """A region found by motion holds both while they pass: it is parted where one was nearer than the other."""
    gap = [max(0, 6 * (first_touch - t)) for t in range(14)]
    scene = Scene({1: [(30, 52 - g // 2) for g in gap], 2: [(30, 80 + g // 2) for g in gap]})
    both = (scene.truth > 0).astype(np.int32)
    result = associate(scene, [components(labels) for labels in both], join_parts=True)
    counts = [len(components(labels).masks) for labels in both]
    assert counts[first_touch - 1] == 2
    assert counts[-1] == 1
    first, second = (numbers_of(result, scene.truth, n) for n in (1, 2))
    if not stay_apart:
        assert first[-1] == second[-1]
        return
    assert set(first) == {first[0]}
    assert set(second) == {second[0]}
    for n, number in ((1, first[0]), (2, second[0])):
        inside = scene.truth[-1] == n
        assert (result[-1][inside] == number).mean() > 0.95


def test_what_leaves_a_region_was_another_thing() -> None:
    """Two touch from the beginning and part: beyond a gap of their own size they have numbers of their own."""
    gap = [max(0, 6 * (t - 3)) for t in range(14)]
    scene = Scene({1: [(30, 52 - g // 2) for g in gap], 2: [(30, 80 + g // 2) for g in gap]})
    found = [components((labels > 0).astype(np.int32)) for labels in scene.truth]
    result = associate(scene, found, join_parts=True)
    first, second = (numbers_of(result, scene.truth, n) for n in (1, 2))
    assert [a == b for a, b in zip(first, second, strict=True)] == [g <= 28 for g in gap]
    assert len(np.unique(result[result > 0])) == 2
    together = associate(scene, found, join_parts=True, max_part_gap=10.0)
    assert len(np.unique(together[together > 0])) == 1


def test_a_thing_that_left_while_another_region_covers_its_place_parts_nothing() -> None:
    """Two were apart; one leaves the picture: the other's region stays whole, and no empty one is made of it."""
    leaves: list[tuple[int, int] | None] = [(30, 120 + 6 * t) for t in range(6)]
    scene = Scene({1: [(30, 20)] * 12, 2: [*leaves, *[None] * 6]})
    result = associate(scene, [components((labels > 0).astype(np.int32)) for labels in scene.truth], join_parts=True)
    first = numbers_of(result, scene.truth, 1)
    assert set(first) == {first[0]}
    assert len(np.unique(result[result > 0])) == 2


def test_a_class_map_falls_into_its_connected_regions() -> None:
    classes = np.zeros(SIZE, np.int32)
    classes[5:20, 5:20], classes[5:20, 20:30], classes[40:60, 40:60], classes[90, 90] = 3, 4, 3, 3
    found = components(classes, min_area_px=10)
    assert sorted(zip(found.class_ids.tolist(), found.masks.sum(axis=(1, 2)).tolist(), strict=True)) == [
        (3, 225), (3, 400), (4, 150),
    ]  # fmt: skip
    assert len(components(np.zeros(SIZE, np.int32))) == 0


def test_what_does_not_fit_is_one_clear_error() -> None:
    scene = Scene({1: [(30, 20)] * 3})
    with pytest.raises(InputError, match="detections of 2 frames, but 3 images"):
        associate(scene, scene.detections()[:2])
    wrong = [FrameDetections.none((10, 10))] * 3
    with pytest.raises(InputError, match="masks of frame 0 are"):
        associate(scene, wrong)
    with pytest.raises(Cancelled):
        list(associate_instances(scene.detections(), ArrayFrames(scene.images), InstanceConfig(), lambda: True))
