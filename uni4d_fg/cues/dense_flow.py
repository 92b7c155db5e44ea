"""Dense optical flow between two frames, and arrays warped by it (OpenCV's DIS)."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, ImageArray


def working_scale(size: tuple[int, int], longer_side_px: int) -> float:
    """Return by how much an image of (height, width) shrinks so that its longer side is at most that; never above 1."""
    return min(1.0, longer_side_px / max(size))


def shrunk_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return (height, width) of a shrunk image, at least 16 px each."""
    return max(16, round(size[0] * scale)), max(16, round(size[1] * scale))


def shrink(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    """Return an image (H, W, 3) or (H, W) averaged to (height, width) ``size``."""
    if image.shape[:2] == size:
        return image
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA))


def shrunk_gray(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    """Return an RGB image as gray levels of (height, width) ``size``."""
    return np.asarray(cv2.cvtColor(shrink(image, size), cv2.COLOR_RGB2GRAY))


class DenseFlow:
    """Flow between gray images of one size; one object serves a whole video.

    Args:
        fine: Follow small and fast things too, at twice the time.
    """

    def __init__(self, fine: bool = True) -> None:
        preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM if fine else cv2.DISOPTICAL_FLOW_PRESET_FAST
        self._solver = cv2.DISOpticalFlow.create(preset)

    def between(self, source: ImageArray, target: ImageArray) -> Float32Array:
        """Return (H, W, 2) px: pixel u of ``source`` is at ``u + flow`` in ``target``. Both are (H, W) uint8."""
        return np.asarray(self._solver.calc(source, target, None), np.float32)


def warp_back(values: npt.NDArray[np.float32], flow: Float32Array, outside: float = 0.0) -> Float32Array:
    """Return what ``values`` (H, W) or (H, W, C) hold at ``u + flow(u)``, bilinearly; ``outside`` beyond the image."""
    height, width = values.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.asarray(
        cv2.remap(
            values,
            columns + flow[..., 0],
            rows + flow[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(outside,) * 4,
        ),
        np.float32,
    )
