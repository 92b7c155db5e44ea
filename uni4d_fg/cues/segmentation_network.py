"""The things in one image by a segmentation network that a card describes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, Int32Array
from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.card import ModelFile, SegmentationCard
from uni4d_fg.cues.detections import MOVABLE_CLASSES, FrameDetections, movable_class_ids
from uni4d_fg.cues.preprocess import Placement, input_shape, place, prepare
from uni4d_fg.cues.session import Network
from uni4d_fg.errors import ConfigError

_BOX = 4
_MAX_CANDIDATES = 300
"""Candidates of a frame that are looked at, best first."""


class SegmentationNetwork:
    """A semantic or instance segmenter, and which of its classes may move.

    Args:
        model: Card and ONNX file.
        config: Provider and threads.
        moving: Names of the classes that may move; None takes those of the card, else people, animals and vehicles.

    Raises:
        ConfigError: If the card is not for segmentation, or none of its classes is one that moves.
        InputError: If a class is unknown, or the file is missing, damaged or does not fit the card.
        MissingDependencyError: If ONNX Runtime is not installed.
    """

    def __init__(self, model: ModelFile, config: NetworkConfig, moving: tuple[str, ...] | None = None) -> None:
        card = model.card
        if not isinstance(card, SegmentationCard):
            raise ConfigError(f"{model.name}: this card is for {card.kind}, but one for segmentation is needed")
        self.card = card
        self.class_ids = movable_class_ids(card.classes, _moving_names(card, moving, model.name))
        self.network = Network(model, {card.input.name: input_shape(card.input, card.size)}, _outputs(card), config)

    def detect(self, image: ImageArray) -> FrameDetections:
        """Return what may move in one image (H, W, 3) uint8 RGB.

        Raises:
            InputError: If the network cannot be run, or gives other shapes than the card says.
        """
        card = self.card
        size = (image.shape[0], image.shape[1])
        placement = place(size, card.size)
        outputs = self.network.run({card.input.name: prepare(image, placement, card.input, card.size)[None]})
        if card.outputs.format == "semantic":
            found = self._semantic(outputs[card.outputs.scores], placement)
        elif card.outputs.format == "yolo_seg":
            found = self._yolo(outputs, placement)
        else:
            found = self._masks(outputs, placement)
        least = card.min_area_fraction * size[0] * size[1]
        return found.keep(np.asarray(found.masks.sum(axis=(1, 2)) >= max(least, 1.0)))

    def _semantic(self, output: npt.NDArray[Any], placement: Placement) -> FrameDetections:
        """Return the connected pieces of every class that may move."""
        name, classes = self.card.outputs.scores, len(self.card.classes)
        if output.ndim == 4 and output.shape[:2] == (1, classes):
            probability = _activated(output[0].astype(np.float32), self.card.outputs.activation)
            winner = probability.argmax(axis=0) if classes > 1 else np.zeros(output.shape[2:], np.int64)
        elif output.ndim in (3, 4) and output.size == output.shape[-2] * output.shape[-1]:
            winner = output.reshape(output.shape[-2:]).astype(np.int64)
            probability = None
        else:
            raise self.network.misfit(name, output.shape, f"(1, {classes}, H, W), or class ids (1, H, W)")
        masks, ids, scores = [], [], []
        for class_id in self.class_ids.tolist():
            share = (winner == class_id).astype(np.float32) if probability is None else probability[class_id]
            whole = placement.restore(share)
            inside = whole >= (0.5 if probability is None else self.card.min_score)
            if probability is not None and classes > 1:
                inside &= placement.restore((winner == class_id).astype(np.float32)) >= 0.5
            for piece in self._pieces(inside):
                masks.append(piece)
                ids.append(class_id)
                scores.append(float(whole[piece].mean()))
        return _detections(masks, ids, scores, placement.image_size)

    def _pieces(self, mask: BoolArray) -> list[BoolArray]:
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
        least = max(1.0, self.card.min_area_fraction * mask.size)
        return [labels == label for label in range(1, count) if stats[label, cv2.CC_STAT_AREA] >= least]

    def _yolo(self, outputs: dict[str, npt.NDArray[Any]], placement: Placement) -> FrameDetections:
        spec, classes = self.card.outputs, len(self.card.classes)
        candidates = outputs[spec.candidates].astype(np.float32)
        prototypes = outputs[spec.prototypes].astype(np.float32)
        if prototypes.ndim != 4 or prototypes.shape[0] != 1:
            raise self.network.misfit(spec.prototypes, prototypes.shape, "(1, M, h, w)")
        rows = _BOX + classes + prototypes.shape[1]
        if candidates.ndim != 3 or candidates.shape[:2] != (1, rows):
            raise self.network.misfit(spec.candidates, candidates.shape, f"(1, {rows}, A), for {classes} classes")
        table = candidates[0].T
        scores = table[:, _BOX : _BOX + classes]
        class_ids = scores.argmax(axis=1).astype(np.int32)
        best = scores.max(axis=1)
        boxes = np.concatenate((table[:, :2] - table[:, 2:4] / 2, table[:, :2] + table[:, 2:4] / 2), axis=1)
        kept = self._best(boxes, class_ids, best)
        logits = np.tensordot(table[kept, _BOX + classes :], prototypes[0], axes=1)
        probability = 1 / (1 + np.exp(-logits))
        masks = [self._cropped(p, boxes[n], placement) for p, n in zip(probability, kept.tolist(), strict=True)]
        return _detections(masks, class_ids[kept].tolist(), best[kept].tolist(), placement.image_size)

    def _masks(self, outputs: dict[str, npt.NDArray[Any]], placement: Placement) -> FrameDetections:
        spec = self.card.outputs
        boxes, scores = outputs[spec.boxes].reshape(-1, 4), outputs[spec.scores].reshape(-1)
        class_ids = outputs[spec.labels].reshape(-1).astype(np.int32)
        masks = outputs[spec.masks]
        masks = masks.reshape(-1, *masks.shape[-2:]).astype(np.float32)
        if not len(boxes) == len(scores) == len(class_ids) == len(masks):
            raise self.network.misfit(spec.masks, outputs[spec.masks].shape, f"one mask for each of {len(boxes)} boxes")
        kept = self._best(boxes, class_ids, scores)
        found = [placement.restore(masks[n]) >= self.card.mask_threshold for n in kept.tolist()]
        return _detections(found, class_ids[kept].tolist(), scores[kept].tolist(), placement.image_size)

    def _best(self, boxes: npt.NDArray[Any], class_ids: Int32Array, scores: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return the indices of what may move, is sure enough, and is not the same thing again; best first."""
        wanted = np.flatnonzero((scores >= self.card.min_score) & np.isin(class_ids, self.class_ids))
        wanted = wanted[np.argsort(-scores[wanted], kind="stable")][:_MAX_CANDIDATES]
        return wanted[suppress_overlaps(boxes[wanted], class_ids[wanted], self.card.nms_iou)]

    def _cropped(self, probability: Float32Array, box: npt.NDArray[Any], placement: Placement) -> BoolArray:
        """Return a mask of the size of the image, cut at its box (px at the network's size)."""
        mask = placement.restore(probability) >= self.card.mask_threshold
        corners = placement.to_image(box.reshape(2, 2).astype(np.float64) - 0.5)
        (x0, y0), (x1, y1) = np.floor(corners[0]), np.ceil(corners[1])
        height, width = placement.image_size
        inside = np.zeros_like(mask)
        inside[max(0, int(y0)) : min(height, int(y1) + 1), max(0, int(x0)) : min(width, int(x1) + 1)] = True
        result: BoolArray = mask & inside
        return result


def suppress_overlaps(boxes: npt.NDArray[Any], class_ids: Int32Array, max_iou: float) -> npt.NDArray[np.int64]:
    """Return which of (N, 4) boxes x0, y0, x1, y1, best first, overlap no better one of their class by more than this.

    Greedy non-maximum suppression by intersection over union.
    """
    area = np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0), axis=1)
    alive = np.ones(len(boxes), bool)
    kept = []
    for n in range(len(boxes)):
        if not alive[n]:
            continue
        kept.append(n)
        low, high = np.maximum(boxes[n, :2], boxes[:, :2]), np.minimum(boxes[n, 2:], boxes[:, 2:])
        shared = np.prod(np.maximum(high - low, 0), axis=1)
        union = np.maximum(area[n] + area - shared, 1e-9)
        alive &= ~((shared / union > max_iou) & (class_ids == class_ids[n]))
    return np.array(kept, np.int64)


def _moving_names(card: SegmentationCard, moving: tuple[str, ...] | None, name: str) -> tuple[str, ...]:
    if moving is not None:
        return moving
    if card.moving is not None:
        return card.moving
    known = {" ".join(word.lower().replace("_", " ").split()) for word in card.classes}
    common = tuple(word for word in MOVABLE_CLASSES if word in known)
    if not common:
        raise ConfigError(f"{name}: none of its classes is known to move; say with --classes which may")
    return common


def _outputs(card: SegmentationCard) -> tuple[str, ...]:
    spec = card.outputs
    if spec.format == "semantic":
        return (spec.scores,)
    if spec.format == "yolo_seg":
        return (spec.candidates, spec.prototypes)
    return (spec.boxes, spec.labels, spec.scores, spec.masks)


def _activated(values: Float32Array, activation: str) -> Float32Array:
    if activation == "sigmoid":
        return np.asarray(1 / (1 + np.exp(-values)), np.float32)
    if activation == "softmax":
        powers = np.exp(values - values.max(axis=0))
        result: Float32Array = powers / powers.sum(axis=0)
        return result
    return values


def _detections(masks: list[BoolArray], ids: list[int], scores: list[float], size: tuple[int, int]) -> FrameDetections:
    if not masks:
        return FrameDetections.none(size)
    return FrameDetections(np.stack(masks), np.array(ids, np.int32), np.array(scores, np.float32))
