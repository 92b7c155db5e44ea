"""Segmenters: classes, thresholds, non-maximum suppression, and where masks lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_networks import constant_network, two_classes, write_card

from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.card import find_model
from uni4d_fg.cues.segmentation_network import SegmentationNetwork, suppress_overlaps
from uni4d_fg.errors import InputError, Uni4dFgError

CPU = NetworkConfig(threads=1)
SEMANTIC = {"format": "semantic", "scores": "scores", "activation": "softmax"}


def segmenter(tmp_path: Path, moving: tuple[str, ...] | None = None, **card: Any) -> SegmentationNetwork:
    written = write_card(tmp_path / "tiny.yaml", **{"kind": "segmentation", "min_area_fraction": 0.0, **card})
    return SegmentationNetwork(find_model(str(written), "segmentation"), CPU, moving)


def test_a_semantic_segmenter_gives_one_thing_per_connected_piece(tmp_path: Path) -> None:
    two_classes(tmp_path / "tiny.onnx")
    image = np.zeros((60, 80, 3), np.uint8)
    image[5:25, 10:30, 0] = 255
    image[40:50, 50:70, 0] = 255
    image[0, 79, 0] = 255
    model = segmenter(tmp_path, outputs=SEMANTIC, classes=["background", "person"], min_area_fraction=0.01)
    found = model.detect(image)
    assert len(found) == 2
    assert found.class_ids.tolist() == [1, 1]
    np.testing.assert_array_equal(
        found.masks[0], (image[..., 0] > 0) & (np.arange(60) < 30)[:, None] & (np.arange(80) < 79)
    )
    assert (found.scores > 0.99).all()
    assert len(model.detect(np.zeros_like(image))) == 0


def test_masks_come_back_to_the_pixels_of_the_image_through_padding(tmp_path: Path) -> None:
    two_classes(tmp_path / "tiny.onnx")
    image = np.zeros((48, 96, 3), np.uint8)
    image[10:30, 20:60, 0] = 255
    size = {"rule": "fixed", "height": 64, "width": 64, "pad_color": [255, 0, 0]}
    found = segmenter(tmp_path, outputs=SEMANTIC, classes=["background", "person"], size=size).detect(image)
    assert len(found) == 1
    expected = image[..., 0] > 0
    iou = (found.masks[0] & expected).sum() / (found.masks[0] | expected).sum()
    assert iou > 0.9


def test_class_ids_need_no_scores(tmp_path: Path) -> None:
    ids = np.zeros((1, 16, 16))
    ids[0, 4:8, 4:12] = 2
    constant_network(tmp_path / "tiny.onnx", {"scores": ids}, (16, 16))
    size = {"rule": "fixed", "height": 16, "width": 16}
    outputs = {"format": "semantic", "scores": "scores"}
    model = segmenter(tmp_path, ("dog",), outputs=outputs, classes=["sky", "person", "dog"], size=size)
    found = model.detect(np.zeros((16, 16, 3), np.uint8))
    assert found.class_ids.tolist() == [2]
    np.testing.assert_array_equal(found.masks[0], ids[0] == 2)


CLASSES = ["person", "chair", "dog"]


def yolo(tmp_path: Path, rows: list[list[float]], **card: Any) -> SegmentationNetwork:
    """Candidates: box center x, y, width, height, three scores, two coefficients; two prototypes of 16 x 16."""
    prototypes = np.full((1, 2, 16, 16), -8.0)
    prototypes[0, 0] = 8.0  # everywhere
    prototypes[0, 1, :, 8:] = 8.0  # right half
    outputs = {"output0": np.array(rows).T[None], "output1": prototypes}
    constant_network(tmp_path / "tiny.onnx", outputs, (64, 64))
    size = {"rule": "fixed", "height": 64, "width": 64}
    fields = {"outputs": {"format": "yolo_seg"}, "classes": CLASSES, "size": size, "min_score": 0.3, **card}
    return segmenter(tmp_path, **fields)


def test_yolo_candidates_become_masks_cut_at_their_boxes(tmp_path: Path) -> None:
    model = yolo(
        tmp_path,
        [
            [20, 20, 20, 20, 0.9, 0, 0, 1, 0],
            [21, 20, 20, 20, 0.8, 0, 0, 1, 0],  # the same person again
            [21, 20, 20, 20, 0, 0, 0.7, 1, 0],  # a dog at the same place
            [50, 50, 20, 20, 0, 0.9, 0, 1, 0],  # a chair, which does not move
            [32, 48, 40, 16, 0.1, 0, 0, 1, 0],  # too unsure
            [32, 48, 40, 16, 0.5, 0, 0, 0, 1],  # its right half only
        ],
    )
    found = model.detect(np.zeros((64, 64, 3), np.uint8))
    assert found.class_ids.tolist() == [0, 2, 0]
    np.testing.assert_allclose(found.scores, [0.9, 0.7, 0.5], rtol=1e-6)
    y, x = np.nonzero(found.masks[0])
    assert (abs(y.min() - 10) <= 1, abs(y.max() - 30) <= 1, abs(x.min() - 10) <= 1, abs(x.max() - 30) <= 1) == (
        True,
    ) * 4
    y, x = np.nonzero(found.masks[2])
    assert abs(x.min() - 32) <= 2
    assert abs(x.max() - 52) <= 1


def test_classes_on_request_and_nms_of_the_card_decide(tmp_path: Path) -> None:
    rows = [[20, 20, 20, 20, 0.9, 0, 0, 1, 0], [24, 20, 20, 20, 0.8, 0, 0, 1, 0], [50, 50, 20, 20, 0, 0.9, 0, 1, 0]]
    image = np.zeros((64, 64, 3), np.uint8)
    assert yolo(tmp_path, rows).detect(image).class_ids.tolist() == [0]
    assert yolo(tmp_path, rows, nms_iou=0.9).detect(image).class_ids.tolist() == [0, 0]
    assert yolo(tmp_path, rows, moving=["chair"]).detect(image).class_ids.tolist() == [1]
    model = SegmentationNetwork(find_model(str(tmp_path / "tiny.yaml"), "segmentation"), CPU, ("Dog",))
    assert len(model.detect(image)) == 0
    with pytest.raises(InputError, match="no class is called 'cat'; choose from chair, dog, person"):
        SegmentationNetwork(find_model(str(tmp_path / "tiny.yaml"), "segmentation"), CPU, ("cat",))


def test_nothing_found_is_no_error(tmp_path: Path) -> None:
    found = yolo(tmp_path, [[20, 20, 20, 20, 0, 0, 0, 1, 0]]).detect(np.zeros((50, 70, 3), np.uint8))
    assert found.masks.shape == (0, 50, 70)


def test_whole_masks_with_boxes(tmp_path: Path) -> None:
    masks = np.zeros((3, 1, 32, 32))
    masks[0, 0, 2:10, 2:10], masks[1, 0, 2:10, 3:11], masks[2, 0, 20:30, 20:30] = 0.9, 0.9, 0.9
    boxes = [[2, 2, 10, 10], [3, 2, 11, 10], [20, 20, 30, 30]]
    outputs = {"boxes": boxes, "labels": [0, 0, 2], "scores": [0.7, 0.9, 0.8], "masks": masks}
    constant_network(tmp_path / "tiny.onnx", outputs, (32, 32))
    spec = {"format": "masks", "scores": "scores"}
    size = {"rule": "fixed", "height": 32, "width": 32}
    found = segmenter(tmp_path, outputs=spec, classes=CLASSES, size=size).detect(np.zeros((32, 32, 3), np.uint8))
    assert found.class_ids.tolist() == [0, 2]
    np.testing.assert_array_equal(found.masks, masks[[1, 2], 0] > 0.5)


@pytest.mark.parametrize(
    ("outputs", "card", "said"),
    [
        ({"scores": np.zeros((1, 5, 8, 8))}, SEMANTIC, r"\(1, 3, H, W\), or class ids"),
        ({"output0": np.zeros((1, 11, 4)), "output1": np.zeros((1, 2, 4, 4))}, {"format": "yolo_seg"}, r"\(1, 9, A\)"),
        ({"output0": np.zeros((1, 9, 4)), "output1": np.zeros((2, 4))}, {"format": "yolo_seg"}, r"\(1, M, h, w\)"),
        (
            {"boxes": np.zeros((2, 4)), "labels": [0.0], "scores": [1.0, 1.0], "masks": np.zeros((2, 8, 8))},
            {"format": "masks", "scores": "scores"},
            "one mask for each of 2 boxes",
        ),
    ],
)
def test_shapes_that_do_not_match_the_card_are_one_error(tmp_path: Path, outputs: Any, card: Any, said: str) -> None:
    constant_network(tmp_path / "tiny.onnx", outputs, (8, 8))
    size = {"rule": "fixed", "height": 8, "width": 8}
    with pytest.raises(InputError, match=said):
        segmenter(tmp_path, outputs=card, classes=CLASSES, size=size).detect(np.zeros((8, 8, 3), np.uint8))


def test_classes_that_are_not_known_to_move_must_be_named(tmp_path: Path) -> None:
    constant_network(tmp_path / "tiny.onnx", {"scores": np.zeros((1, 2, 8, 8))}, (8, 8))
    with pytest.raises(Uni4dFgError, match="--classes"):
        segmenter(tmp_path, outputs=SEMANTIC, classes=["sky", "rock"])


def test_suppression_keeps_the_best_of_each_group() -> None:
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [0, 0, 10, 10], [30, 0, 40, 10]], float)
    assert suppress_overlaps(boxes, np.array([0, 0, 1, 0], np.int32), 0.5).tolist() == [0, 2, 3]
    assert suppress_overlaps(boxes[:0], np.zeros(0, np.int32), 0.5).tolist() == []


@pytest.mark.data
def test_sinet_finds_the_man_in_front(data_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from uni4d_fg.frontend.sequence.decode import read_image

    models = data_root.parent / "models"
    if not (models / "SINet_Softmax.onnx").is_file():
        pytest.skip("the network is not there")
    monkeypatch.setenv("UNI4D_FG_MODELS", str(models))
    model = SegmentationNetwork(find_model("sinet_person", "segmentation"), CPU)
    image = read_image(data_root / "lady_running" / "00000.jpg")
    found = model.detect(image)
    people = found.masks.any(axis=0)
    height, width = people.shape
    # He sits in the lower left corner; there is nobody in the upper right quarter.
    assert people[int(0.6 * height) : int(0.95 * height), int(0.05 * width) : int(0.35 * width)].mean() > 0.8
    assert people[: height // 2, 2 * width // 3 :].mean() < 0.05
