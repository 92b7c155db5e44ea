"""Masks in COCO's JSON: result files, data-set files and BURST's, with run lengths."""

from __future__ import annotations

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
from uni4d_fg.cues.rle import decode_rle, rle_size
from uni4d_fg.frontend.sequence.frames import ConstantFrames, LazyFrames
from uni4d_fg.frontend.sequence.layout import frame_numbers
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of

_MAX_CLASS, _MAX_TRACK = 2**31, 2**62
_MAX_MASKS = 1000
"""Masks of one frame above which they are refused: joining them over time takes minutes a frame."""

_REWRITE = "write it as COCO results: a list of {image_id, category_id, score, segmentation: {size, counts}}"


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
        frame = _name(path, entry, "image_id", n)
        masks.setdefault(str(frame), []).append(_mask(path, entry, entry.get("segmentation"), n))
    scored = any(isinstance(entry, dict) and "score" in entry for entry in entries)
    return CocoContent(masks, has_scores=scored)


def _data_set(path: Path, content: dict[str, Any]) -> CocoContent:
    images, categories = _listed(path, content, "images"), _listed(path, content, "categories")
    stems = {_name(path, i, "id", n): Path(str(i.get("file_name") or "")).stem for n, i in enumerate(images)}
    found = _results(path, content["annotations"])
    names = {_whole(path, c, "id", n): str(c.get("name") or "") for n, c in enumerate(categories)}
    masks = {**{image: [] for image in stems}, **found.masks}
    return CocoContent(masks, {k: v for k, v in stems.items() if v}, names or None, found.has_scores)


def _burst(path: Path, frames: list[Any]) -> CocoContent:
    masks: dict[str, list[_Mask]] = {}
    for n, frame in enumerate(frames):
        stem = Path(_name(path, frame, "file_name", n)).stem
        segments = _listed(path, frame, "segmentations")
        masks[stem] = [
            _mask(path, segment, _entry(path, segment, "rle", m), m, "id") for m, segment in enumerate(segments)
        ]
    return CocoContent(masks, {stem: stem for stem in masks})


def _entry(path: Path, entry: Any, key: str, number: int) -> Any:
    if not isinstance(entry, dict) or entry.get(key) is None:
        raise SequenceProblem(path, f"entry {number} has no {key!r}", _REWRITE)
    return entry[key]


def _name(path: Path, entry: Any, key: str, number: int) -> str:
    """Return a name or number of an entry as text."""
    value = _entry(path, entry, key, number)
    if not isinstance(value, str | int) or isinstance(value, bool):
        raise SequenceProblem(path, f"entry {number} has a {key!r} that is no name or whole number", _REWRITE)
    return str(value)


def _whole(path: Path, entry: Any, key: str, number: int, default: int | None = None, limit: int = _MAX_CLASS) -> int:
    """Return a whole number of an entry, also where it is written as text."""
    value = default if default is not None and entry.get(key) is None else _entry(path, entry, key, number)
    try:
        if isinstance(value, bool) or abs(int(value)) >= limit or float(value) != int(value):
            raise ValueError(value)
        return int(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise SequenceProblem(path, f"entry {number} has a {key!r} that is no whole number", _REWRITE) from error


def _listed(path: Path, content: dict[str, Any], key: str) -> list[Any]:
    """Return a list of an entry; empty where it has none."""
    value = content.get(key)
    if value is not None and not isinstance(value, list):
        raise SequenceProblem(path, f"has {key!r} that is no list", _REWRITE)
    return value or []


def _mask(path: Path, entry: Any, segmentation: Any, number: int, track: str = "track_id") -> _Mask:
    where = f"{path}: mask {number}"
    if segmentation is None:
        raise SequenceProblem(path, f"entry {number} has no mask, only a box", _REWRITE)
    if not isinstance(entry, dict):
        raise SequenceProblem(path, f"entry {number} is no mask", _REWRITE)
    name = track if entry.get(track) is not None else "instance_id"
    own = None if entry.get(name) is None else _whole(path, entry, name, number, limit=_MAX_TRACK)
    score = entry.get("score")
    if score is not None and (isinstance(score, bool) or not isinstance(score, int | float) or not 0 <= score <= 1e6):
        raise SequenceProblem(path, f"entry {number} has a score that is no number", _REWRITE)
    return _Mask(
        segmentation, _whole(path, entry, "category_id", number, 0), 1.0 if score is None else float(score), own, where
    )


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
    crowded = max(range(len(names)), key=lambda frame: len(by_frame[frame]), default=0)
    if names and len(by_frame[crowded]) > _MAX_MASKS:
        raise SequenceProblem(
            path,
            f"has {len(by_frame[crowded])} masks in frame {names[crowded]}, more than {_MAX_MASKS}",
            "leave out those of low score",
        )
    everything = [mask for masks in by_frame for mask in masks]
    if everything and all(mask.track is not None for mask in everything):
        return TrackedMasks(path, by_frame, size, config.min_score)
    labels = CompressedLabels(size)
    gray = images if images is not None else ConstantFrames(np.full((*size, 3), 128, np.uint8), len(names))
    for numbers in associate_instances(_detections(path, by_frame, size), gray, config):
        labels.append(numbers)
    return labels


class TrackedMasks(LazyFrames[Int32Array]):
    """Masks that carry the number of their instance."""

    def __init__(self, path: Path, by_frame: list[list[_Mask]], size: tuple[int, int], min_score: float) -> None:
        self.path, self.by_frame, self.size, self.min_score = path, by_frame, size, min_score
        tracks = sorted({m.track for masks in by_frame for m in masks if m.track is not None})
        # Ids start at 0 in some files, which means static here.
        shift = (1 if tracks[0] <= 0 else 0) - min(tracks[0], 0)
        small = tracks[-1] + shift < 2**31
        self.number = {track: track + shift if small else place for place, track in enumerate(tracks, start=1)}

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
    found = rle_size(mask.segmentation, mask.where)
    if found != size:
        raise SequenceProblem(
            path,
            f"has masks of {found[1]} x {found[0]} px, but the images are {size[1]} x {size[0]} px",
            "segment the images that are given here",
        )
    return decode_rle(mask.segmentation, mask.where)


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
