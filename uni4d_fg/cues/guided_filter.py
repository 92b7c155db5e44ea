"""Edge-preserving smoothing: values are shared within surfaces of like color (He, Sun and Tang 2013)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array


def guided_filter(guide: Float32Array, values: Float32Array, radius_px: int, contrast: float) -> Float32Array:
    """Smooth ``values`` so that their edges are those of ``guide``.

    In every window the result is the affine function of the guide's color that is nearest to the values.

    Args:
        guide: (h, w, 3), 0 to 1.
        values: (h, w).
        radius_px: Half side of the window.
        contrast: Standard deviation of the guide below which a window counts as one surface.
    """
    window = (2 * radius_px + 1, 2 * radius_px + 1)

    def mean(array: npt.NDArray[np.floating]) -> Float32Array:
        return np.asarray(cv2.boxFilter(array, -1, window), np.float32)

    mean_guide, mean_values = mean(guide), mean(values)
    covariance = mean(guide * values[..., None]) - mean_guide * mean_values[..., None]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    aa, ab, ac, bb, bc, cc = (
        mean(guide[..., i] * guide[..., j]) - mean_guide[..., i] * mean_guide[..., j] + (contrast**2 if i == j else 0)
        for i, j in pairs
    )
    # The inverse of a symmetric 3x3 matrix by its adjugate: this is the whole cost of the filter.
    inverse = (bb * cc - bc * bc, ac * bc - ab * cc, ab * bc - ac * bb)
    determinant = aa * inverse[0] + ab * inverse[1] + ac * inverse[2]
    x, y, z = (covariance[..., i] for i in range(3))
    slope = (
        np.stack(
            (
                inverse[0] * x + inverse[1] * y + inverse[2] * z,
                inverse[1] * x + (aa * cc - ac * ac) * y + (ab * ac - aa * bc) * z,
                inverse[2] * x + (ab * ac - aa * bc) * y + (aa * bb - ab * ab) * z,
            ),
            axis=2,
        )
        / np.maximum(determinant, 1e-12)[..., None]
    )
    offset = mean_values - sum_colors(slope * mean_guide)
    result: Float32Array = sum_colors(mean(slope) * guide) + mean(offset)
    return result


def sum_colors(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the sum (h, w) over the colors of (h, w, 3): NumPy takes ten times as long to add up three numbers."""
    return np.asarray(cv2.transform(image, np.ones((1, 3))))
