"""Plane sweep with semi-global aggregation, in C++ where the extension is installed and in NumPy elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.multiview.sweep_numpy import sweep_numpy
from uni4d_fg.results.fusion.pixel_transfer import PixelTransfer


@dataclass(frozen=True)
class Swept:
    """What a sweep finds, (h, w) each."""

    inverse_depth: Float32Array
    """1/m, along the z axis."""
    margin: Float32Array
    """How much dearer the best plane elsewhere is, as a part of the best one's cost: 0 if there are two alike."""
    match: Float32Array
    """Normalized cross-correlation there, -1 to 1."""
    at_end: Float32Array
    """1 where the first or the last plane won, else 0."""


def sweep(
    image: Float32Array,
    others: list[Float32Array],
    transfers: list[PixelTransfer],
    planes: FloatArray,
    config: MultiviewConfig,
    threads: int = 0,
) -> Swept:
    """Find the depth of an image from others.

    Args:
        image: (h, w), 0 to 1, NaN where it is not to be matched.
        others: V images alike.
        transfers: Where each of them sees the image's pixels.
        planes: (D,) inverse depth of the planes, 1/m, evenly spaced and ascending.
        config: Window, penalties and noise.
        threads: Of the C++ version; 0 takes all cores.
    """
    turns, shifts = (np.stack(parts) for parts in zip(*transfers, strict=True))
    core, _ = find_extension()
    settings: dict[str, Any] = {
        "radius": config.window_radius_px,
        "noise": config.image_noise,
        "difference_share": config.difference_share,
        "largest_difference": config.largest_difference,
        "small_step": config.small_step_penalty,
        "large_step": config.large_step_penalty,
        "edge_contrast": config.edge_contrast,
    }
    if core is None:
        plane, cost, rival, match = sweep_numpy(image, np.stack(others), turns, shifts, planes, **settings)
    else:
        plane, cost, rival, match = core.plane_sweep(
            np.ascontiguousarray(image, dtype=np.float64), np.stack(others).astype(np.float64),
            np.ascontiguousarray(turns), np.ascontiguousarray(shifts), np.ascontiguousarray(planes), threads=threads,
            **settings,
        )  # fmt: skip
    step = (planes[-1] - planes[0]) / (len(planes) - 1)
    return Swept(
        (planes[0] + plane * step).astype(np.float32),
        ((rival - cost) / np.maximum(cost, 1.0)).astype(np.float32),
        (1.0 - match / 127.5).astype(np.float32),
        ((plane < 0.75) | (plane > len(planes) - 1.75)).astype(np.float32),
    )
