"""Search where points are expected, against the search of every point through the whole pyramid."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.tracks import guided_search, optical_flow
from uni4d_fg.frontend.tracks.guided_search import move_points
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.frontend.tracks.optical_flow import comes_back, find

HEIGHT, WIDTH = 180, 240
CONFIG = TrackingConfig(grid_columns=24, grid_rows=18, query_interval=50, reseed_spacing=None)

Move = Callable[[ImageArray, ImageArray, Float32Array, Float32Array], tuple[BoolArray, Float32Array]]


def by_pyramid(
    source: ImageArray, target: ImageArray, points: Float32Array, velocity: Float32Array
) -> tuple[BoolArray, Float32Array]:
    """Move points as if nothing were known of them."""
    return move_points(source, target, points, np.full_like(velocity, np.nan), CONFIG)


def guided(
    source: ImageArray, target: ImageArray, points: Float32Array, velocity: Float32Array
) -> tuple[BoolArray, Float32Array]:
    return move_points(source, target, points, velocity, CONFIG)


def noise(seed: int, contrast: float = 45.0, grain: float = 2.5) -> np.ndarray:
    """Smooth texture of three times the size of an image."""
    values = np.random.default_rng(seed).normal(size=(3 * HEIGHT, 3 * WIDTH)).astype(np.float32)
    smooth = cv2.GaussianBlur(values, (0, 0), grain)
    return smooth * (contrast / smooth.std())


def view(world: np.ndarray, position: np.ndarray) -> np.ndarray:
    """The part of a texture that a camera at a position sees, px, from its middle."""
    matrix = np.float32([[1, 0, -WIDTH - position[0]], [0, 1, -HEIGHT - position[1]]])
    return np.asarray(cv2.warpAffine(world, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC))


def gray(values: np.ndarray) -> ImageArray:
    return np.asarray(np.clip(np.rint(values + 128), 0, 255), np.uint8)


BLOCK = np.array([70.0, 50.0, 170.0, 130.0])
"""Left, top, right and bottom of a moving thing at its start, px."""


def shaken(steps: np.ndarray, thing: np.ndarray) -> ImageArray:
    """A shaken camera, (T - 1, 2) px a step, and a thing that moves through the image by (T - 1, 2) px of its own."""
    world, own = noise(1), noise(2)
    camera = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
    block = camera + np.concatenate((np.zeros((1, 2)), np.cumsum(thing, axis=0)))
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    images = []
    for background, front in zip(camera, block, strict=True):
        left, top, right, bottom = BLOCK + np.tile(front, 2)
        inside = (u >= left) & (u < right) & (v >= top) & (v < bottom)
        images.append(gray(np.where(inside, view(own, -front), view(world, -background))))
    return np.stack(images)


def follow(images: ImageArray, move: Move) -> tuple[BoolArray, np.ndarray]:
    """Return which grid points are still followed in the last image, and where all of them were (K, T, 2)."""
    u, v = np.meshgrid(np.linspace(12, WIDTH - 13, 30), np.linspace(12, HEIGHT - 13, 24))
    points = np.stack((u, v), axis=-1).reshape(-1, 2).astype(np.float32)
    where = np.full((len(points), len(images), 2), np.nan)
    where[:, 0] = points
    alive, velocity = np.arange(len(points)), np.full_like(points, np.nan)
    for t in range(1, len(images)):
        kept, moved = move(images[t - 1], images[t], points, velocity)
        velocity, points, alive = moved - points[kept], moved, alive[kept]
        where[alive, t] = points
    return np.isin(np.arange(len(where)), alive), where


@pytest.mark.parametrize("jerk_px", [0.0, 3.0, 12.0])
def test_no_point_is_lost_however_jerky_the_motion(jerk_px: float) -> None:
    rng = np.random.default_rng(0)
    steps, thing = rng.uniform(-jerk_px, jerk_px, (8, 2)), 0.5 * rng.uniform(-jerk_px, jerk_px, (8, 2))
    steps += (1.5, -0.5) - steps.mean(axis=0)
    thing += (1.0, 1.0) - thing.mean(axis=0)
    images = shaken(steps, thing)
    (slow, slow_where), (fast, fast_where) = follow(images, by_pyramid), follow(images, guided)
    start = fast_where[:, 0]
    on_thing = ((start > BLOCK[:2] + 12) & (start < BLOCK[2:] - 12)).all(axis=1)
    camera, block = (np.concatenate((np.zeros((1, 2)), np.cumsum(way, axis=0))) for way in (steps, steps + thing))
    path = start[:, None] + np.where(on_thing[:, None, None], block, camera)
    in_image = ((path > 14) & (path < (WIDTH - 15, HEIGHT - 15))).all(axis=(1, 2))
    free = ~((path > BLOCK[:2] + block - 14) & (path < BLOCK[2:] + block + 14)).all(axis=2).any(axis=1)
    for group in (on_thing & in_image, free & in_image):
        assert group.sum() > 30
        assert fast[group].mean() >= slow[group].mean() - 0.01
        assert fast[group].mean() > 0.95
        for where, kept in ((slow_where, slow), (fast_where, fast)):
            error = np.linalg.norm(where[kept & group] - path[kept & group], axis=2)[:, -1]
            assert np.median(error) < 0.1
            assert np.quantile(error, 0.99) < 0.5
    both = slow & fast
    apart = np.linalg.norm(slow_where[both, -1] - fast_where[both, -1], axis=1)
    assert np.quantile(apart, 0.95) < 0.05


def test_most_points_spare_the_pyramid(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = {"pyramid": 0, "near": 0}

    def counted(
        source: ImageArray, target: ImageArray, points: Float32Array, guess: Float32Array | None, config: TrackingConfig
    ) -> tuple[Float32Array, BoolArray]:
        searched["pyramid" if guess is None else "near"] += len(points)
        return find(source, target, points, guess, config)

    monkeypatch.setattr(guided_search, "find", counted)
    steps = np.random.default_rng(1).uniform(-8, 8, (8, 2))
    tracks = track_grid(ArrayFrames(shaken(steps, np.zeros((8, 2)))), CONFIG)
    assert tracks.visible.mean() > 0.5
    assert searched["pyramid"] < 0.35 * searched["near"]


def replaced(seed: int) -> tuple[ImageArray, ImageArray, Float32Array]:
    """Two images of which the second shows something else of the same kind everywhere, and points of the first."""
    # Weak contrast: the windows do not differ enough to tell.
    first, second = gray(noise(seed, contrast=6.0)[:HEIGHT, :WIDTH]), gray(noise(99, contrast=6.0)[:HEIGHT, :WIDTH])
    u, v = np.meshgrid(np.arange(20, WIDTH - 20, 6), np.arange(20, HEIGHT - 20, 6))
    return first, second, np.stack((u, v), axis=-1).reshape(-1, 2).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_match_is_caught_though_it_lies_where_it_is_expected(seed: int) -> None:
    source, target, points = replaced(seed)
    expected = np.zeros_like(points)
    moved, found = find(source, target, points, points + expected, CONFIG)
    matched = np.flatnonzero(found & (np.linalg.norm(moved - points, axis=1) <= 3.0))
    assert len(matched) > 30  # all of them wrong
    told = comes_back(source, target, points[matched], moved[matched], expected[matched], CONFIG)
    assert told.mean() < 0.2
    kept, _ = guided(source, target, points, expected)
    assert kept.mean() < 0.07


def test_the_check_does_not_begin_where_the_point_came_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search back that began at the point itself would hardly leave it."""
    guesses: list[Float32Array] = []
    flow = optical_flow._flow

    def noted(source: ImageArray, target: ImageArray, points: Float32Array, guess: Float32Array | None, *rest, **more):
        if guess is not None:
            guesses.append(guess.copy())
        return flow(source, target, points, guess, *rest, **more)

    monkeypatch.setattr(optical_flow, "_flow", noted)
    image = gray(noise(3)[:HEIGHT, :WIDTH])
    points = np.float32([[60, 60], [100, 80]])
    expected = np.float32([[1.0, -2.0], [0.5, 0.0]])
    moved = points + np.float32([[1.5, -2.0], [0.5, 2.5]])
    comes_back(image, image, points, moved, expected, CONFIG)
    np.testing.assert_allclose(guesses[0], moved - expected)


def test_a_guide_is_not_told_of_by_itself() -> None:
    points = np.float32([[0, 0], [0, 0], [10, 0], [0, 10], [10, 10]])
    values = np.zeros((5, 2), np.float32)
    values[0] = 100.0
    others = guided_search._median_of_others(points, values)
    assert (others[0] == 0).all()
    np.testing.assert_array_equal(
        guided_search._median_around(
            np.float32([[1, 1]]), points, np.float32([[1, 5], [2, 4], [3, 3], [9, 9], [9, 9]])
        ),
        [[2, 4]],
    )


@pytest.mark.parametrize("number", [0, 1, 3, 40])
def test_few_points_and_new_ones(number: int) -> None:
    image = gray(noise(5)[:HEIGHT, :WIDTH])
    points = np.random.default_rng(number).uniform(30, 150, (number, 2)).astype(np.float32)
    velocity = np.zeros_like(points)
    velocity[::2] = np.nan
    kept, moved = guided(image, image, points, velocity)
    assert kept.all()
    np.testing.assert_allclose(moved, points, atol=0.02)
