"""From what is found in each frame alone to instances that keep their number over the video.

An instance of the last frame is warped to the new one by optical flow and compared with the new detections; the
assignment of least total cost (Hungarian method) on intersection over union continues it. A region found by motion may
hold several things that were apart before: it is parted among them; and what leaves a region for good was another
thing. An instance that is not found is moved on by its last velocity for a few frames, so that it keeps its number when
it comes back from behind something: the flow there is that of what hides it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.config.motion_masks import InstanceConfig
from uni4d_fg.cues.dense_flow import DenseFlow, shrunk_gray, shrunk_size, warp_back, working_scale
from uni4d_fg.cues.detections import FrameDetections
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import FrameSource

_UNASSIGNABLE = 1e3
"""Cost of a pair that is not to be: far above the cost 1 of no overlap."""


@dataclass
class _Instance:
    """An instance on its way through the video; its mask is kept at the size of the flow."""

    number: int
    class_id: int
    mask: Float32Array
    velocity: FloatArray
    missed: int = 0
    apart: int = 0
    """Frames in which it was found by itself."""

    def moved_by_flow(self, flow_back: Float32Array) -> None:
        warped = warp_back(self.mask, flow_back)
        inside = warped > 0.5
        if inside.any():
            self.velocity = -np.median(flow_back[inside], axis=0).astype(np.float64)
        self.mask = warped

    def moved_by_velocity(self) -> None:
        shift = np.array([[1, 0, self.velocity[0]], [0, 1, self.velocity[1]]])
        height, width = self.mask.shape
        self.mask = np.asarray(cv2.warpAffine(self.mask, shift, (width, height)), np.float32)


def associate_instances(
    detections: Iterable[FrameDetections],
    images: FrameSource[ImageArray],
    config: InstanceConfig,
    should_stop: Callable[[], bool] | None = None,
) -> Iterator[Int32Array]:
    """Number the detections so that one thing has one number in all frames.

    Args:
        detections: Those of every frame, in order; each is taken when its turn comes.
        images: T images (H, W, 3) uint8 RGB.
        config: Overlap, patience, what is too small or too unsure.
        should_stop: Asked before every frame.

    Yields:
        Per frame the (H, W) int32 numbers, 0 where there is nothing. Where detections overlap, the surer one wins.

    Raises:
        InputError: If a frame's masks have another size than its image, or there are fewer detections than images.
        Cancelled: If ``should_stop`` said so.
    """
    flow = DenseFlow()
    instances: list[_Instance] = []
    next_number = 1
    last: ImageArray | None = None
    source = iter(detections)
    for frame in range(len(images)):
        if should_stop is not None and should_stop():
            raise Cancelled("stopped while joining masks to instances")
        found = next(source, None)
        if found is None:
            raise InputError(f"instances: there are detections of {frame} frames, but {len(images)} images")
        image = images[frame]
        if found.masks.shape[1:] != image.shape[:2]:
            raise InputError(
                f"instances: masks of frame {frame} are {found.masks.shape[1:]}, the image is {image.shape[:2]}; "
                "bring them to one size"
            )
        found = _worth_keeping(found, config)
        size = shrunk_size(image.shape[:2], working_scale(image.shape[:2], config.flow_size_px))
        gray = shrunk_gray(image, size)
        if last is not None:
            _move(instances, flow, gray, last)
        if config.join_parts:
            found = _parted(found, instances, size, config)
        small = [_shrunk_mask(mask, size) for mask in found.masks]
        number_of, next_number = _assign(instances, found, small, next_number, config)
        yield _paint(found, number_of, instances, image.shape[:2], config)
        last = gray
        instances = [i for i in instances if i.missed <= config.max_missed_frames and bool((i.mask > 0.5).any())]


def components(labels: npt.NDArray[np.integer], min_area_px: int = 1) -> FrameDetections:
    """Take every connected region of one class as a detection.

    Args:
        labels: (H, W) class of each pixel; 0 is nothing.
        min_area_px: Smaller regions are left out.

    Returns:
        The regions, of score 1, with their classes.
    """
    masks: list[BoolArray] = []
    classes: list[int] = []
    for class_id in np.unique(labels[labels > 0]):
        count, region, statistics, _ = cv2.connectedComponentsWithStats((labels == class_id).astype(np.uint8))
        for n in range(1, count):
            if statistics[n, cv2.CC_STAT_AREA] >= min_area_px:
                masks.append(region == n)
                classes.append(int(class_id))
    if not masks:
        return FrameDetections.none((labels.shape[0], labels.shape[1]))
    return FrameDetections(np.stack(masks), np.array(classes, np.int32), np.ones(len(masks), np.float32))


def _worth_keeping(found: FrameDetections, config: InstanceConfig) -> FrameDetections:
    large = found.masks.sum(axis=(1, 2)) >= config.min_area_px
    return found.keep(np.asarray(large & (found.scores >= config.min_score)))


def _shrunk_mask(mask: BoolArray, size: tuple[int, int]) -> Float32Array:
    shrunk = cv2.resize(mask.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk, np.float32)


def _move(instances: list[_Instance], flow: DenseFlow, gray: ImageArray, last: ImageArray) -> None:
    if not instances:
        return
    flow_back = flow.between(gray, last)
    for instance in instances:
        if instance.missed:
            instance.moved_by_velocity()
        else:
            instance.moved_by_flow(flow_back)


def _parted(
    found: FrameDetections, instances: list[_Instance], size: tuple[int, int], config: InstanceConfig
) -> FrameDetections:
    """Part regions in which several things lie that were apart before: every pixel goes to the nearest of them."""
    known = [i for i in instances if not i.missed and i.apart >= config.min_apart_frames and bool((i.mask > 0.5).any())]
    if len(known) < 2 or not len(found):
        return found
    masks, classes, scores = [], [], []
    for mask, class_id, score in zip(found.masks, found.class_ids, found.scores, strict=True):
        small = _shrunk_mask(mask, size)
        inside = [i for i in known if float((i.mask * small).sum()) >= config.min_held_part * float(i.mask.sum())]
        pieces = [mask]
        if len(inside) > 1:
            nearest = np.argmin([_distance(i.mask > 0.5) for i in inside], axis=0).astype(np.uint8)
            full = cv2.resize(nearest, mask.shape[::-1], interpolation=cv2.INTER_NEAREST)
            pieces = [mask & (full == n) for n in range(len(inside))]
        for piece in filter(np.any, pieces):
            masks.append(piece)
            classes.append(class_id)
            scores.append(score)
    return FrameDetections(np.stack(masks), np.array(classes, np.int32), np.array(scores, np.float32))


def _distance(mask: BoolArray) -> Float32Array:
    """Return how far each pixel (h, w) is from a mask."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def _assign(
    instances: list[_Instance],
    found: FrameDetections,
    small: list[Float32Array],
    next_number: int,
    config: InstanceConfig,
) -> tuple[Int32Array, int]:
    """Continue instances with detections, in place. Returns the number of each detection, and the next free one."""
    number_of = np.zeros(len(found), np.int32)
    overlap, within = _overlaps(instances, small)
    affinity = overlap.copy()
    for row, instance in enumerate(instances):
        if instance.missed:  # What comes out from behind something is at first only partly seen.
            affinity[row] = np.maximum(affinity[row], config.hidden_overlap_weight * within[row])
        if config.same_class:
            affinity[row, found.class_ids != instance.class_id] = 0
    possible = affinity >= config.min_overlap
    rows, columns = linear_sum_assignment(np.where(possible, 1 - affinity, _UNASSIGNABLE))
    pairs = [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if possible[r, c]]
    for row, column in pairs:
        number_of[column] = instances[row].number
        instances[row].mask, instances[row].missed = small[column], 0
        instances[row].apart += 1
    taken = {row for row, _ in pairs}
    if config.join_parts:
        for column in np.flatnonzero(number_of == 0).tolist():
            rows_around = [
                row
                for row in taken
                if within[row, column] >= config.min_part_overlap
                and _gap(instances[row].mask, small[column]) <= config.max_part_gap
            ]
            if rows_around:
                best = max(rows_around, key=lambda row: float(within[row, column]))
                number_of[column] = instances[best].number
                instances[best].mask = np.maximum(instances[best].mask, small[column])
    for row, instance in enumerate(instances):
        instance.missed += 0 if row in taken else 1
    for column in np.flatnonzero(number_of == 0).tolist():
        number_of[column] = next_number
        instances.append(_Instance(next_number, int(found.class_ids[column]), small[column], np.zeros(2)))
        next_number += 1
    return number_of, next_number


def _gap(mask: Float32Array, part: Float32Array) -> float:
    """Return how far a part (h, w) is from a mask (h, w), in parts of the side of a square of the part's area."""
    nearest = float(_distance(mask > 0.5)[part > 0.5].min(initial=np.inf))
    return nearest / max(float(np.sqrt(part.sum())), 1.0)


def _overlaps(instances: list[_Instance], small: list[Float32Array]) -> tuple[FloatArray, FloatArray]:
    """Return intersection over union, and the share of each detection within each instance; (M, N)."""
    if not instances or not small:
        return np.zeros((len(instances), len(small))), np.zeros((len(instances), len(small)))
    a = np.stack([instance.mask.ravel() for instance in instances])
    b = np.stack([mask.ravel() for mask in small])
    both = (a @ b.T).astype(np.float64)
    area_a, area_b = a.sum(axis=1, dtype=np.float64), b.sum(axis=1, dtype=np.float64)
    union = area_a[:, None] + area_b[None] - both
    return both / np.maximum(union, 1e-9), both / np.maximum(area_b[None], 1e-9)


def _paint(
    found: FrameDetections,
    number_of: Int32Array,
    instances: list[_Instance],
    size: tuple[int, int],
    config: InstanceConfig,
) -> Int32Array:
    labels = np.zeros(size, np.int32)
    for instance in instances:
        if 0 < instance.missed <= config.drawn_missed_frames:
            mask = cv2.resize(instance.mask, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
            labels[mask > 0.5] = instance.number
    for n in np.argsort(found.scores, kind="stable"):
        labels[found.masks[n]] = number_of[n]
    return labels
