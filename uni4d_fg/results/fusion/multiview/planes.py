"""Which planes of inverse depth to try: the range that the landmarks span, in steps that the images can tell apart."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.results.fusion.pixel_transfer import PixelTransfer

_SPAN = (0.01, 0.99)
"""Quantiles of the landmarks' inverse depth: single ones may be wrong."""
_FARTHEST = 0.02
"""The first plane's inverse depth is at least this part of the last one's."""


def choose_planes(
    depth: FloatArray, transfers: list[PixelTransfer], size: tuple[int, int], config: MultiviewConfig
) -> FloatArray:
    """Return inverse depths, evenly spaced and ascending, (D,) 1/m.

    Args:
        depth: (N,) depth of the landmarks that the frame sees, m.
        transfers: Where the views see the frame's pixels, at working size.
        size: (h, w), px.
        config: Margin and number of planes.
    """
    low, high = np.quantile(1.0 / depth, _SPAN)
    margin = config.range_margin * (high - low)
    last = high + margin + 0.05 * high
    first = max(low - margin, _FARTHEST * last)
    travel = max(_travel(transfer, size, first, last) for transfer in transfers)
    count = int(np.clip(np.ceil(travel / config.plane_step_px) + 1, config.min_planes, config.max_planes))
    return np.linspace(first, last, count)


def _travel(transfer: PixelTransfer, size: tuple[int, int], first: float, last: float) -> float:
    """Return how far a pixel moves in another view between two planes: the median over a grid, px."""
    u, v = np.meshgrid(np.linspace(0, size[1] - 1, 5), np.linspace(0, size[0] - 1, 5))
    turned = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ transfer.turn.T
    ends = []
    for rho in (first, last):
        x = turned + rho * transfer.shift
        ends.append(x[:, :2] / np.maximum(x[:, 2:], 1e-3))
    return float(np.median(np.linalg.norm(ends[1] - ends[0], axis=1)))
