"""What a segmenter found in one frame, and which of its classes may move."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, Int32Array
from uni4d_fg.errors import InputError

MOVABLE_CLASSES = (
    "person",
    "bicycle",
    "car",
    "motorcycle",
    "airplane",
    "bus",
    "train",
    "truck",
    "boat",
    "bird",
    "cat",
    "dog",
    "horse",
    "sheep",
    "cow",
    "elephant",
    "bear",
    "zebra",
    "giraffe",
)
"""Classes that move by themselves, in the words of COCO: the default of what may move.

Add what is carried or thrown in a given video ("sports ball", "suitcase").
"""


@dataclass(frozen=True)
class FrameDetections:
    """The things that a segmenter found in one frame. They may overlap, and their order means nothing."""

    masks: BoolArray
    """(N, H, W): True where thing n is."""
    class_ids: Int32Array
    """(N,): class of each, in the numbering of whatever found it."""
    scores: Float32Array
    """(N,): confidence of each, 0 to 1; 1 where the segmenter gives none."""

    def __post_init__(self) -> None:
        if self.masks.ndim != 3 or self.masks.dtype != np.bool_:
            raise ValueError(f"masks must be bool (N, H, W), not {self.masks.dtype} {self.masks.shape}")
        for name in ("class_ids", "scores"):
            if getattr(self, name).shape != (len(self.masks),):
                raise ValueError(f"{name} must have shape ({len(self.masks)},), not {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.masks)

    @classmethod
    def none(cls, size: tuple[int, int]) -> FrameDetections:
        """Return the detections of a frame (height, width) in which nothing was found."""
        return cls(np.zeros((0, *size), bool), np.zeros(0, np.int32), np.zeros(0, np.float32))

    def keep(self, which: BoolArray | Int32Array) -> FrameDetections:
        """Return those that ``which`` (a mask or indices) selects."""
        return FrameDetections(self.masks[which], self.class_ids[which], self.scores[which])


def movable_class_ids(names: Iterable[str] | dict[int, str], movable: Iterable[str]) -> Int32Array:
    """Return the numbers of the classes that may move.

    Args:
        names: All class names of a segmenter: a list in the order of their numbers from 0, or number to name.
        movable: Names of those that may move; case, underscores and spaces at the ends do not matter.

    Returns:
        (M,) sorted class numbers.

    Raises:
        InputError: If one of ``movable`` is no class of the segmenter; the message lists those there are.
    """
    numbered = names if isinstance(names, dict) else dict(enumerate(names))
    known: dict[str, list[int]] = {}
    for number, name in numbered.items():
        known.setdefault(_plain_name(name), []).append(int(number))
    wanted = [_plain_name(name) for name in movable]
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise InputError(
            f"no class is called {', '.join(map(repr, unknown))}; choose from {', '.join(sorted(known)) or 'none'}"
        )
    return np.array(sorted({number for name in wanted for number in known[name]}), np.int32)


def _plain_name(name: str) -> str:
    return " ".join(str(name).replace("_", " ").lower().split())
