"""The synthetic scenes that several benchmarks share."""

from __future__ import annotations

from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence

SCENES = {
    "12x1500": (12, 32, 24),
    "30x2000": (30, 29, 23),
    "60x8000": (60, 43, 31),
    "100x17500": (100, 50, 35),
}
"""Frames x tracks: the frames, and the grid of query points that is started every ten of them."""
PRESETS = ("default", "paper")


def scene(name: str, seed: int = 0) -> Sequence:
    """Return a scene with depth maps of 320 x 240, the default noise and flat gray images."""
    frames, columns, rows = SCENES[name]
    return make_synthetic_sequence(
        SyntheticSceneConfig(num_frames=frames, grid_columns=columns, grid_rows=rows, render_images=False, seed=seed)
    )
