"""Depth as OpenEXR, read back by the reader of other programs' files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.pipeline.benchmark.methods.exr import read_exr
from uni4d_fg.results.export.exr import exr_bytes
from uni4d_fg.results.run import Run


def test_every_depth_map_comes_back_bit_for_bit(source: Run, exported: Callable[..., tuple[Path, object]]) -> None:
    folder, _ = exported("exr")
    paths = sorted((folder / "depth").iterdir())
    assert len(paths) == source.num_frames
    for path, depth in zip(paths, source.need_depth("test"), strict=True):
        found = read_exr(path.read_bytes(), path.name)
        np.testing.assert_array_equal(found, np.where(depth > 0.0, depth, 0.0))
        assert path.stat().st_size < depth.nbytes


@pytest.mark.parametrize("shape", [(1, 1), (16, 7), (33, 20)])
def test_blocks_of_any_size_come_back(shape: tuple[int, int], rng: np.random.Generator) -> None:
    # Noise does not get smaller, and is stored as it is; a plane does.
    for depth in (rng.random(shape), np.full(shape, 2.5), np.arange(np.prod(shape)).reshape(shape)):
        single = depth.astype(np.float32)
        np.testing.assert_array_equal(read_exr(exr_bytes(single), "a.exr"), single)
