"""Masks in COCO's JSON: result files, data-set files and BURST's, with run lengths."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.arrays import ImageArray, Int32Array
from uni4d_fg.config.motion_masks import InstanceConfig
from uni4d_fg.cues.coco_classes import COCO_CLASSES
from uni4d_fg.cues.detections import MOVABLE_CLASSES, FrameDetections, movable_class_ids
from uni4d_fg.cues.instances import associate_instances
from uni4d_fg.cues.label_store import CompressedLabels
from uni4d_fg.cues.rle import decode_rle
from uni4d_fg.frontend.sequence.frames import ConstantFrames, LazyFrames
from uni4d_fg.frontend.sequence.layout import frame_numbers
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of

_REWRITE = "write it as COCO results: a list of {image_id, category_id, score, segmentation: {size, counts}}"


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        InputError: If it cannot be read or is not JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise SequenceProblem(path, f"cannot be read ({error.strerror})", "check the file") from error
    except (ValueError, RecursionError) as error:
        raise SequenceProblem(path, f"is not JSON, or cut short ({error})", "write it again") from error


@dataclass(frozen=True)
class _Mask:
    """One mask of the file, still encoded."""

    segmentation: Any
    class_id: int
    score: float
    track: int | None
    where: str


@dataclass(frozen=True)
class CocoContent:
    """The masks of a file by what it calls their frames."""

    masks: dict[str, list[_Mask]] = field(default_factory=dict)
    """Image id or file name, as text, to its masks."""
    stems: dict[str, str] = field(default_factory=dict)
    """The same to the stem of the image file, where the file gives it."""
    class_names: dict[int, str] | None = None
    has_scores: bool = False


def parse(path: Path, content: Any) -> CocoContent:
    """Sort the masks of a file by frame.

    Raises:
        InputError: If it is of none of the known forms.
    """
    if isinstance(content, list):
        return _results(path, content)
    if isinstance(content, dict) and isinstance(content.get("segmentations"), list):
        return _burst(path, content["segmentations"])
    if isinstance(content, dict) and isinstance(content.get("annotations"), list):
        return _data_set(path, content)
    raise SequenceProblem(path, "holds no masks in a known form", _REWRITE)


def _results(path: Path, entries: list[Any]) -> CocoContent:
    masks: dict[str, list[_Mask]] = {}
    for n, entry in enumerate(entries):
        frame = _entry(path, entry, "image_id", n)
        masks.setdefault(str(frame), []).append(_mask(path, entry, entry.get("segmentation"), n))
    scored = any(isinstance(entry, dict) and "score" in entry for entry in entries)
    return CocoContent(masks, has_scores=scored)


def _data_set(path: Path, content: dict[str, Any]) -> CocoContent:
    images = content.get("images", [])
    stems = {str(_entry(path, i, "id", n)): Path(str(i.get("file_name", ""))).stem for n, i in enumerate(images)}
    found = _results(path, content["annotations"])
    categories = content.get("categories") or []
    names = {int(_entry(path, c, "id", n)): str(c.get("name", "")) for n, c in enumerate(categories)}
    masks = {**{image: [] for image in stems}, **found.masks}
    return CocoContent(masks, {k: v for k, v in stems.items() if v}, names or None, found.has_scores)


def _burst(path: Path, frames: list[Any]) -> CocoContent:
    masks: dict[str, list[_Mask]] = {}
    for n, frame in enumerate(frames):
        stem = Path(str(_entry(path, frame, "file_name", n))).stem
        segments = frame.get("segmentations", [])
        masks[stem] = [_mask(path, segment, segment.get("rle"), m, "id") for m, segment in enumerate(segments)]
    return CocoContent(masks, {stem: stem for stem in masks})


def _entry(path: Path, entry: Any, key: str, number: int) -> Any:
    if not isinstance(entry, dict) or key not in entry:
        raise SequenceProblem(path, f"entry {number} has no {key!r}", _REWRITE)
    return entry[key]


def _mask(path: Path, entry: Any, segmentation: Any, number: int, track: str = "track_id") -> _Mask:
    where = f"{path}: mask {number}"
    if segmentation is None:
        raise SequenceProblem(path, f"entry {number} has no mask, only a box", _REWRITE)
    try:
        own = entry.get(track, entry.get("instance_id"))
        return _Mask(
            segmentation,
            int(entry.get("category_id", 0)),
            float(entry.get("score", 1.0)),
            None if own is None else int(own),
            where,
        )
    except (TypeError, ValueError) as error:
        raise SequenceProblem(
            path, f"entry {number} has a class, score or track that is no number", _REWRITE
        ) from error


def open_coco_masks(
    path: Path,
    content: Any,
    size: tuple[int, int],
    names: tuple[str, ...],
    images: FrameSource[ImageArray] | None,
    classes: tuple[str, ...] | None,
    class_names: dict[int, str] | None,
    config: InstanceConfig,
) -> FrameSource[Int32Array]:
    """Return label maps of the masks in a parsed JSON file. Arguments as in ``mask_files.open_mask_files``.

    Raises:
        InputError: If its form is unknown, its frames or classes do not fit, or a mask has another size.
    """
    parsed = parse(path, content)
    moving = _moving(path, parsed, classes, class_names)
    frames = _frames(path, parsed, names)
    by_frame: list[list[_Mask]] = [[] for _ in names]
    for key, masks in parsed.masks.items():
        if key in frames:
            by_frame[frames[key]] += [m for m in masks if moving is None or m.class_id in moving]
    everything = [mask for masks in by_frame for mask in masks]
    if everything and all(mask.track is not None for mask in everything):
        return TrackedMasks(path, by_frame, size, config.min_score)
    labels = CompressedLabels(size)
    grey = images if images is not None else ConstantFrames(np.full((*size, 3), 128, np.uint8), len(names))
    for numbers in associate_instances(_detections(path, by_frame, size), grey, config):
        labels.append(numbers)
    return labels


class TrackedMasks(LazyFrames[Int32Array]):
    """Masks that carry the number of their instance."""

    def __init__(self, path: Path, by_frame: list[list[_Mask]], size: tuple[int, int], min_score: float) -> None:
        self.path, self.by_frame, self.size, self.min_score = path, by_frame, size, min_score
        tracks = sorted({m.track for masks in by_frame for m in masks if m.track is not None})
        # Ids start at 0 in some files, which means static here.
        self.number = {track: track + (1 if tracks[0] <= 0 else 0) - min(tracks[0], 0) for track in tracks}

    def __len__(self) -> int:
        return len(self.by_frame)

    def where(self, frame: int) -> str:
        """Return the file and frame number."""
        return f"{self.path} [frame {frame}]"

    def _read(self, frame: int) -> Int32Array:
        labels = np.zeros(self.size, np.int32)
        for mask in sorted(self.by_frame[frame], key=lambda m: m.score):
            if mask.score >= self.min_score and mask.track is not None:
                labels[_decoded(self.path, mask, self.size)] = self.number[mask.track]
        return labels


def _detections(path: Path, by_frame: list[list[_Mask]], size: tuple[int, int]) -> Iterator[FrameDetections]:
    for masks in by_frame:
        if not masks:
            yield FrameDetections.none(size)
            continue
        yield FrameDetections(
            np.stack([_decoded(path, mask, size) for mask in masks]),
            np.array([mask.class_id for mask in masks], np.int32),
            np.array([mask.score for mask in masks], np.float32),
        )


def _decoded(path: Path, mask: _Mask, size: tuple[int, int]) -> Any:
    array = decode_rle(mask.segmentation, mask.where)
    if array.shape != size:
        raise SequenceProblem(
            path,
            f"has masks of {array.shape[1]} x {array.shape[0]} px, but the images are {size[1]} x {size[0]} px",
            "segment the images that are given here",
        )
    return array


def _moving(
    path: Path, parsed: CocoContent, classes: tuple[str, ...] | None, class_names: dict[int, str] | None
) -> frozenset[int] | None:
    """Return the class numbers that may move; None for all."""
    used = {mask.class_id for masks in parsed.masks.values() for mask in masks}
    named = class_names or parsed.class_names
    if named is None and parsed.has_scores and used <= set(COCO_CLASSES):
        named = COCO_CLASSES
    if classes is None:
        if named is None:
            return None
        plain = {name.lower() for name in named.values()}
        classes = tuple(name for name in MOVABLE_CLASSES if name in plain)
        if not classes:  # Not COCO's words: whoever segmented these chose them.
            return None
    if named is None:
        raise SequenceProblem(path, f"numbers its classes ({some_of(sorted(used))}) without names", "give the names")
    return frozenset(movable_class_ids(named, classes).tolist())


def _frames(path: Path, parsed: CocoContent, names: tuple[str, ...]) -> dict[str, int]:
    """Return the frame of every key of the file: by name, by the number of the frame, or by order."""
    index = {name: frame for frame, name in enumerate(names)}
    by_name = {key: index[parsed.stems.get(key, key)] for key in parsed.masks if parsed.stems.get(key, key) in index}
    if by_name or not parsed.masks:
        return by_name
    numbers = frame_numbers(parsed.masks)
    own = frame_numbers(names)
    if numbers is not None and own is not None and len(set(own)) == len(own) and set(numbers) <= set(own):
        position = {number: frame for frame, number in enumerate(own)}
        return {key: position[number] for key, number in zip(parsed.masks, numbers, strict=True)}
    if len(parsed.masks) == len(names) and numbers is not None:
        order = sorted(zip(numbers, parsed.masks, strict=True))
        return {key: frame for frame, (_, key) in enumerate(order)}
    raise SequenceProblem(
        path,
        f"names frames {some_of(sorted(parsed.masks), 3)}, but the images are {some_of(names, 3)}",
        "call the frames by the names of the images, or number them from 0",
    )
