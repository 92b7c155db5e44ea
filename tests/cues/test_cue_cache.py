"""Cues on disk are believed only if they are undamaged, and made again otherwise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.config.geometric_depth import AffineDepthConfig
from uni4d_fg.cues.affine_depth import align_affine
from uni4d_fg.cues.cache import FloatMaps, FrameCache
from uni4d_fg.cues.network_makers import labels_are_stored, store_labels, store_maps
from uni4d_fg.cues.packed_maps import rounded
from uni4d_fg.errors import DegenerateProblemError, InputError
from uni4d_fg.files import save_npy, save_npz
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.progress import SilentReporter

SIZE = (5, 7)


def flipped(path: Path, place: int = -30) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def test_a_flipped_bit_in_a_map_is_noticed_and_the_map_made_again(tmp_path: Path, rng: np.random.Generator) -> None:
    maps = [rng.random(SIZE, np.float32) for _ in range(3)]

    def stored() -> FloatMaps:
        return store_maps(ArrayFrames(np.stack(maps)), SIZE, tmp_path, "maps", SilentReporter(), lambda: False)

    first = stored()
    whole = first.paths[1].read_bytes()
    cache = FrameCache(tmp_path)
    for damage in (
        lambda path: flipped(path, len(whole) // 2),
        lambda path: path.write_bytes(whole[:-3]),
        lambda path: path.write_bytes(b""),
    ):
        damage(first.paths[1])
        assert not cache.has_map("000001", SIZE)
        assert cache.has_map("000002", SIZE)
        np.testing.assert_array_equal(stored()[1], rounded(maps[1]))
        assert first.paths[1].read_bytes() == whole
    flipped(first.paths[0], len(whole) // 2)
    with pytest.raises(InputError, match=r"000000\.map\.npz: not a readable"):
        first[0]
    np.testing.assert_array_equal(first[2], rounded(maps[2]))
    save_npz(first.paths[2], planes=np.zeros((2, *SIZE), np.uint8))
    assert not cache.has_map("000002", SIZE)
    save_npy(tmp_path / "old.npy", maps[0])
    np.testing.assert_array_equal(FloatMaps((tmp_path / "old.npy",), SIZE)[0], maps[0])


def test_damaged_masks_are_made_again(tmp_path: Path, rng: np.random.Generator) -> None:
    labels = [rng.integers(0, 5, SIZE).astype(np.int32) for _ in range(3)]
    masks = store_labels(iter(labels), 3, SIZE, tmp_path, "masks", SilentReporter())
    assert labels_are_stored(tmp_path, 3, SIZE)
    assert not labels_are_stored(tmp_path, 3, (7, 5))
    flipped(masks.paths[1])
    assert not labels_are_stored(tmp_path, 3, SIZE)
    again = store_labels(iter(labels), 3, SIZE, tmp_path, "masks", SilentReporter())
    for found, wanted in zip(again, labels, strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("value", [0.0, 1.0, 1e-30, np.nan])
def test_maps_that_are_the_same_everywhere_are_one_clear_error(value: float, rng: np.random.Generator) -> None:
    frames, count = 3, 60
    uv = rng.uniform(1, 30, (count, frames, 2)).astype(np.float32)
    tracks = Tracks(uv, np.ones((count, frames), bool), np.zeros(count, np.int32))
    depth = rng.uniform(1, 5, (count, frames)).astype(np.float32)
    maps = ArrayFrames(np.full((frames, 32, 40), value, np.float32))
    with pytest.raises(DegenerateProblemError, match="relative depth"):
        align_affine(maps, tracks, depth, AffineDepthConfig())
