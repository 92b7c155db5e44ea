"""Configuration of networks that make cues."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.base import Section, setting


class NetworkConfig(Section):
    """Networks run by ONNX Runtime; what a network takes and gives stands in its model card."""

    provider: Literal["cpu", "cuda"] = setting("cpu", "Where networks run; 'cuda' needs onnxruntime-gpu.", basic=True)
    threads: int | None = setting(None, "Threads of a network; null: the cores that the process may use.", ge=1)
    grid_columns: int = setting(50, "Query points per row of a point tracker.", ge=2, le=400, basic=True)
    grid_rows: int = setting(50, "Query points per column of a point tracker.", ge=2, le=400, basic=True)
    query_interval: int = setting(10, "A point tracker starts a new grid every this many frames.", ge=1, basic=True)
    margin_px: float = setting(8.0, "Distance of the outermost query points from the image border, px.", ge=0)
    min_observations: int = setting(3, "Tracks seen in fewer frames are not kept.", ge=1)
