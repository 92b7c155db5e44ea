"""Detections and the classes that may move."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.cues.coco_classes import COCO_CLASSES
from uni4d_fg.cues.detections import MOVABLE_CLASSES, FrameDetections, movable_class_ids
from uni4d_fg.errors import InputError


def test_keep_selects_by_mask_and_by_index() -> None:
    masks = np.zeros((3, 4, 5), bool)
    masks[1, 2, 3] = True
    found = FrameDetections(masks, np.array([7, 8, 9], np.int32), np.array([0.1, 0.2, 0.3], np.float32))
    assert found.keep(np.array([False, True, True])).class_ids.tolist() == [8, 9]
    assert found.keep(np.array([1])).masks[0, 2, 3]
    assert len(FrameDetections.none((4, 5))) == 0
    assert FrameDetections.none((4, 5)).masks.shape == (0, 4, 5)


def test_shapes_that_disagree_are_refused() -> None:
    with pytest.raises(ValueError, match="masks must be bool"):
        FrameDetections(np.zeros((1, 4, 5), np.uint8), np.zeros(1, np.int32), np.zeros(1, np.float32))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="scores must have shape"):
        FrameDetections(np.zeros((1, 4, 5), bool), np.zeros(1, np.int32), np.zeros(2, np.float32))


def test_class_names_are_matched_however_they_are_written() -> None:
    assert movable_class_ids(["background", "Person", "sports_ball"], ["person ", "Sports Ball"]).tolist() == [1, 2]
    assert movable_class_ids({3: "car", 9: "car"}, ["car"]).tolist() == [3, 9]


def test_an_unknown_class_is_named_with_those_there_are() -> None:
    with pytest.raises(InputError, match="no class is called 'dragon'; choose from cat, dog"):
        movable_class_ids(["cat", "dog"], ["dog", "dragon"])


def test_the_default_classes_are_cocos() -> None:
    assert len(COCO_CLASSES) == 80
    assert (COCO_CLASSES[1], COCO_CLASSES[18], COCO_CLASSES[44], COCO_CLASSES[90]) == (
        "person",
        "dog",
        "bottle",
        "toothbrush",
    )
    assert len(movable_class_ids(COCO_CLASSES, MOVABLE_CLASSES)) == len(MOVABLE_CLASSES)
