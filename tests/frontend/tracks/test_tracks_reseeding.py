"""New points where an image has none left between two grids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.arrays import ImageArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.frontend.tracks.reseeding import corners_of_empty_cells

HEIGHT, WIDTH, CELL = 96, 128, 16
GRID = TrackingConfig(
    grid_columns=12, grid_rows=9, query_interval=10, margin_px=6, max_drift_px=1.5, reseed_spacing=None
)
RESEEDED = GRID.model_copy(update={"reseed_spacing": CELL / (WIDTH / 12)})


def noise(height: int, width: int, seed: int = 0, grain: int = 5) -> ImageArray:
    """Smooth texture with something to hold on to everywhere."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(30, 225, (height // grain + 3, width // grain + 3))
    y, x = np.arange(height) / grain, np.arange(width) / grain
    row, column = y.astype(int), x.astype(int)
    fy, fx = ((1 - np.cos(np.pi * (v - v.astype(int)))) / 2 for v in (y, x))
    top = coarse[row][:, column] * (1 - fx) + coarse[row][:, column + 1] * fx
    bottom = coarse[row + 1][:, column] * (1 - fx) + coarse[row + 1][:, column + 1] * fx
    return np.rint(top * (1 - fy[:, None]) + bottom * fy[:, None]).astype(np.uint8)


def pan(frames: int, speed: int) -> ImageArray:
    """A camera that pans to the right over a wall, whole pixels per frame."""
    wall = noise(HEIGHT, WIDTH + speed * frames, grain=16)
    return np.stack([wall[:, speed * t : speed * t + WIDTH] for t in range(frames)])


def empty_cells(tracks: object, frame: int) -> int:
    """Cells away from the border in which no track is seen."""
    seen = tracks.uv[tracks.visible[:, frame], frame]
    count, _, _ = np.histogram2d(
        seen[:, 1] + 0.5, seen[:, 0] + 0.5, bins=(np.arange(0, HEIGHT + 1, CELL), np.arange(0, WIDTH + 1, CELL))
    )
    return int((count[1:-1, 1:-1] == 0).sum())


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), number=st.integers(0, 60), side=st.integers(4, 40))
def test_one_point_per_empty_cell_at_its_best_corner(seed: int, number: int, side: int) -> None:
    config = GRID.model_copy(update={"reseed_spacing": side / (WIDTH / 12), "reseed_quality": 0.0})
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, (WIDTH - 1, HEIGHT - 1), (number, 2)).astype(np.float32)
    new = corners_of_empty_cells(noise(HEIGHT, WIDTH, seed), points, config)
    cell_of = [tuple(p) for p in (np.r_[points, new] // side).astype(int).tolist()]
    old_cells = {tuple(p) for p in ((points + 0.5) // side).astype(int).tolist()}
    new_cells = cell_of[number:]
    assert len(set(new_cells)) == len(new)
    assert not old_cells & set(new_cells)
    assert ((new >= 6) & (new <= (WIDTH - 1 - 6, HEIGHT - 1 - 6))).all()
    inner = {
        (column, row)
        for row in range(HEIGHT // side + 1)
        for column in range(WIDTH // side + 1)
        if column * side + side > 8 and row * side + side > 8 and column * side < WIDTH - 8 and row * side < HEIGHT - 8
    }
    assert inner - old_cells <= set(new_cells)


def test_corners_are_found_and_flat_cells_stay_empty() -> None:
    image = np.full((64, 64), 100, np.uint8)
    image[20:28, 36:44] = 200
    new = corners_of_empty_cells(
        image, np.zeros((0, 2), np.float32), RESEEDED.model_copy(update={"reseed_quality": 0.1})
    )
    corners = np.array([(36, 20), (43, 20), (36, 27), (43, 27)])
    assert 1 <= len(new) <= 4
    assert (np.linalg.norm(new[:, None] - corners, axis=2).min(axis=1) < 3).all()
    assert len(corners_of_empty_cells(np.full((64, 64), 9, np.uint8), np.zeros((0, 2), np.float32), RESEEDED)) == 0


@pytest.mark.parametrize("size", [(2, 2), (5, 40), (12, 13)])
def test_images_smaller_than_a_cell(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8)
    assert corners_of_empty_cells(image, np.zeros((0, 2), np.float32), RESEEDED).shape[1] == 2


def test_what_comes_into_view_is_tracked_between_grids() -> None:
    frames, speed = 12, 16
    images = pan(frames, speed)
    without, reseeded = (track_grid(ArrayFrames(images), config) for config in (GRID, RESEEDED))
    # The backward sweep brings the grid of frame 10 back; what is seen around frame 5 only has no grid point.
    assert sum(empty_cells(without, t) for t in range(2, 10)) > 30
    assert sum(empty_cells(reseeded, t) for t in range(2, 10)) == 0
    new = ~np.isin(reseeded.query_frame, (0, 10))
    assert new.sum() > 10
    # The old tracks are there, the same: new ones guide them, which only changes where their search begins.
    assert (reseeded.visible[~new] == without.visible).mean() > 0.99
    both = reseeded.visible[~new] & without.visible
    np.testing.assert_allclose(reseeded.uv[~new][both], without.uv[both], atol=0.02)
    assert (np.diff(reseeded.query_frame) >= 0).all()
    rows = np.flatnonzero(new)
    assert reseeded.visible[rows, reseeded.query_frame[rows]].all()
    before = reseeded.visible[rows, np.maximum(reseeded.query_frame[rows] - 1, 0)]
    after = reseeded.visible[rows, np.minimum(reseeded.query_frame[rows] + 1, frames - 1)]
    assert before.any()
    assert after.any()
    first = reseeded.uv[rows, reseeded.query_frame[rows]]
    for t in range(frames):
        truth = first - np.stack((speed * (t - reseeded.query_frame[rows]), np.zeros(len(rows))), axis=1)
        error = np.linalg.norm(reseeded.uv[rows, t] - truth, axis=1)[reseeded.visible[rows, t]]
        assert error.size == 0 or np.median(error) < 0.1


def test_nothing_changes_where_no_cell_is_empty() -> None:
    images = np.repeat(pan(1, 0), 8, axis=0)
    without, reseeded = (track_grid(ArrayFrames(images), config) for config in (GRID, RESEEDED))
    np.testing.assert_array_equal(reseeded.uv, without.uv)
    np.testing.assert_array_equal(reseeded.query_frame, without.query_frame)


def test_a_cut_is_survived() -> None:
    """After a cut no old point lives on; with new points the second shot has tracks at once, not at the next grid."""
    images = np.concatenate([np.repeat(noise(HEIGHT, WIDTH, seed)[None], 4, axis=0) for seed in (1, 2)])
    without, reseeded = (track_grid(ArrayFrames(images), config) for config in (GRID, RESEEDED))
    assert without.visible[:, 4:].sum() == 0
    assert (reseeded.visible[:, 4:].sum(axis=0) > 20).all()
