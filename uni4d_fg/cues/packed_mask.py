"""Masks of a bit per pixel, of which those of a whole video are held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray


@dataclass(frozen=True)
class PackedMask:
    """A mask (h, w)."""

    size: tuple[int, int]
    bits: npt.NDArray[np.uint8]

    @classmethod
    def of(cls, mask: BoolArray) -> PackedMask:
        """Pack a mask (h, w)."""
        return cls((mask.shape[0], mask.shape[1]), np.packbits(mask))

    def unpacked(self) -> BoolArray:
        """Return the mask (h, w)."""
        return np.unpackbits(self.bits, count=self.size[0] * self.size[1]).reshape(self.size).view(bool)
