"""Things of streets, gardens and rooms that stand still."""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks.worlds.surface import Material, Piece, Point, ball, cards, lathe, pole, quad, sheet, slab
from benchmarks.worlds.textures import Color, cloth, leaf, painted, plain, random_color, spots, wood

Place = tuple[float, float]
"""x and z on the ground, meters."""


def glass(mirror: float = 0.35) -> Material:
    """Return a window pane: dark, and it mirrors what is before it."""
    return Material(plain((0.08, 0.1, 0.12), 51, 0.1), 2.0, mirror=mirror)


def bark() -> Material:
    """Return the bark of trees."""
    return Material(spots((0.14, 0.1, 0.07), (0.42, 0.34, 0.25), 52, 16, 0.85, 0.3, 8), 0.8)


def tree(place: Place, height: float, crown: float, seed: int, leaves: int = 3500, size: float = 0.11) -> list[Piece]:
    """Return a tree.

    Args:
        place: Where its trunk stands.
        height: Height of the top, meters.
        crown: Radius of the crown, meters.
        seed: Seed.
        leaves: How many.
        size: Half the length of a leaf, meters.
    """
    rng = np.random.default_rng(seed)
    x, z = place
    fork = np.array([x, -(height - 1.7 * crown), z])
    wooden, radius = bark(), 0.03 * height**0.8
    pieces = [pole((x, 0.3, z), fork, radius, wooden, 12)]
    clusters = []
    for _ in range(9):
        way = rng.standard_normal(3) * (1.0, 0.6, 1.0) + (0.0, -0.9, 0.0)
        tip = fork + (0.75 * crown + 0.3 * crown * rng.random()) * way / np.linalg.norm(way)
        pieces.append(pole(fork + np.array([0.0, 0.2, 0.0]), tip, 0.4 * radius, wooden, 8))
        clusters.append(tip)
    clusters.append(fork - (0.0, crown, 0.0))
    center = np.asarray(clusters)[rng.integers(0, len(clusters), leaves)]
    spread = rng.standard_normal((leaves, 3))
    spread /= np.linalg.norm(spread, axis=-1, keepdims=True)
    place_of = center + spread * (0.5 * crown * rng.random((leaves, 1)) ** 0.45)
    hue = rng.uniform(-0.05, 0.08)
    green = Material(leaf((0.12 + hue, 0.27, 0.06), (0.4 + hue, 0.55, 0.16), int(rng.integers(3))), 2.0, leafy=True)
    return [*pieces, cards(place_of, size, green, rng)]


def bush(center: Point, radius: Point, seed: int,
         leaves: int = 1500, size: float = 0.06) -> Piece:  # fmt: skip
    """Return an ellipsoid of leaves with half axes ``radius``, meters."""
    rng = np.random.default_rng(seed)
    way = rng.standard_normal((leaves, 3))
    way *= rng.random((leaves, 1)) ** 0.3 / np.linalg.norm(way, axis=-1, keepdims=True)
    place = np.asarray(center) + way * np.asarray(radius)
    place[:, 1] = np.minimum(place[:, 1], -0.02)
    return cards(place, size, Material(leaf(seed=seed % 4), 2.0, leafy=True), rng)


def facade(
    x: float, start: float, end: float, floors: int, wall: Material, seed: int, facing: float = 1.0
) -> list[Piece]:
    """Return a house whose front lies in the plane of an x and faces +x or -x (``facing`` 1 or -1).

    Args:
        x: Plane of the front, meters.
        start: Least z, meters.
        end: Largest z, meters.
        floors: How many floors of 3.2 m.
        wall: Material of the wall.
        seed: Seed of doors and windows.
        facing: Side of the street.
    """
    rng = np.random.default_rng(seed)
    height, middle, wide = 3.2 * floors + 0.6, 0.5 * (start + end), end - start
    frames: list[Color] = [(0.86, 0.85, 0.82), (0.3, 0.24, 0.2), (0.25, 0.33, 0.3)]
    white = Material(plain(frames[int(rng.integers(3))], 53, 0.03), 1.0)
    stone = Material(spots((0.5, 0.48, 0.44), (0.68, 0.66, 0.6), 54, 16), 1.5)
    door = Material(wood((0.2, 0.12, 0.08), (0.38, 0.2, 0.12), int(rng.integers(5)), 5), 1.2)
    pieces = [
        slab((8.0, height, wide), (x - 4.0 * facing, -0.5 * height, middle), wall),
        slab((0.3, 0.25, wide), (x, -height + 0.1, middle), stone),
        slab((0.1, 0.7, wide - 0.02), (x, -0.35, middle), stone),
    ]
    count = max(int(wide / 2.4), 1)
    doorway = int(rng.integers(count))
    for floor in range(floors):
        for i in range(count):
            z, low = start + (i + 0.5) * wide / count, -1.0 - 3.2 * floor
            if floor == 0 and i == doorway:
                pieces += [slab((0.12, 2.2, 1.0), (x, -1.1, z), door), slab((0.3, 0.15, 1.4), (x, -2.35, z), stone)]
                pieces += [slab((0.16, 0.04, 0.12), (x + 0.05 * facing, -1.05, z + 0.38), white)]
                pieces += [slab((0.9, 0.16, 1.3), (x, -0.08, z), stone)]
                continue
            half, high = 0.55, 1.6
            pieces.append(quad((x + 0.02 * facing, low - high, z - half), (0, 0, 2 * half), (0, high, 0), glass()))
            for side in (-1.0, 1.0):
                pieces.append(slab((0.14, high + 0.14, 0.08), (x, low - 0.5 * high, z + side * half), white))
            pieces += [
                slab((0.14, 0.08, 2 * half), (x, low - high, z), white),
                slab((0.10, 0.06, 2 * half), (x, low - 0.62 * high, z), white),
                slab((0.10, high, 0.05), (x, low - 0.5 * high, z), white),
                slab((0.34, 0.08, 2 * half + 0.3), (x, low + 0.04, z), stone),
            ]
            if floor > 0 and rng.random() < 0.25:
                pieces.append(bush((x + 0.2 * facing, low - 0.15, z), (0.14, 0.14, 0.5), seed + i, 250, 0.035))
    return pieces


def lamp_post(place: Place, height: float = 4.2, reach: float = 0.0) -> list[Piece]:
    """Return a street lamp whose arm reaches ``reach`` meters along x."""
    iron = Material(plain((0.13, 0.15, 0.14), 55, 0.15), 0.5)
    shade = Material(plain((0.85, 0.85, 0.8), 56), 1.0)
    x, z = place
    pieces = [pole((x, 0, z), (x, -height, z), 0.055, iron), pole((x, 0, z), (x, -0.9, z), 0.085, iron)]
    if reach:
        pieces.append(pole((x, -height, z), (x + reach, -height - 0.2, z), 0.04, iron))
    return [*pieces, ball(0.17, (x + reach, -height - 0.15, z), shade, (1.0, 0.8, 1.0))]


def bench(place: Place, yaw: float, seed: int = 0) -> list[Piece]:
    """Return a park bench that faces ``yaw`` rad."""
    board = Material(wood((0.3, 0.18, 0.09), (0.55, 0.36, 0.2), seed, 4), 0.7)
    iron = Material(plain((0.12, 0.12, 0.12), 57, 0.1), 0.5)
    pieces = [slab((1.6, 0.035, 0.09), (0, -0.45, -0.2 + 0.11 * i), board) for i in range(4)]
    pieces += [slab((1.6, 0.09, 0.03), (0, -0.62 - 0.13 * i, -0.28 - 0.03 * i), board) for i in range(3)]
    for x in (-0.65, 0.65):
        pieces += [slab((0.05, 0.45, 0.05), (x, -0.22, z), iron) for z in (-0.2, 0.14)]
        pieces.append(pole((x, -0.4, -0.24), (x, -0.98, -0.38), 0.025, iron))
    return [piece.moved((place[0], 0.0, place[1]), yaw) for piece in pieces]


def picture(corner: Point, side: Point, down: float, seed: int) -> list[Piece]:
    """Return a framed picture on a wall: its corner, its upper edge and its height, meters."""
    color = np.random.default_rng(seed).uniform(0.2, 0.9, 3)
    art = Material(
        painted(seed, (float(color[0]), float(color[1]), float(color[2])), 30, 2), float(np.linalg.norm(side))
    )
    rail = Material(wood((0.15, 0.09, 0.05), (0.3, 0.2, 0.1), seed % 5, 4), 0.5)
    a = np.asarray(corner, dtype=np.float64)
    b, drop = a + np.asarray(side), np.array([0.0, down, 0.0])
    edges = [(a, b), (b, b + drop), (a + drop, b + drop), (a, a + drop)]
    return [quad(corner, side, (0.0, down, 0.0), art), *(pole(p, q, 0.022, rail, 8) for p, q in edges)]


def curtain(
    start: Point, end: Point, top_y: float, material: Material, folds: int,
    deep: float, seed: int = 0,
) -> Piece:  # fmt: skip
    """Return a curtain with folds between two points on the floor, up to a height, meters."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0.0, 1.0, 12 * folds)
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    front = np.cross(b - a, [0.0, 1.0, 0.0])
    front /= np.linalg.norm(front)
    phase = 2 * np.pi * folds * share + 1.2 * np.sin(5 * share + rng.uniform(0, 6))
    strong = 0.6 + 0.4 * np.sin(2 * np.pi * 1.7 * share + rng.uniform(0, 6))
    rows = []
    for down in np.linspace(0.0, 1.0, 8):
        wave = deep * (0.6 + 0.4 * down) * strong * np.sin(phase + 0.3 * down)
        line = a + share[:, None] * (b - a) + wave[:, None] * front
        line[:, 1] = top_y + down * (a[1] - top_y)
        rows.append(line)
    return sheet(np.stack(rows), material)


def potted_plant(place: Place, height: float, seed: int) -> list[Piece]:
    """Return a plant in a pot with stems and long leaves."""
    rng = np.random.default_rng(seed)
    x, z = place
    clay = Material(spots((0.45, 0.22, 0.14), (0.68, 0.38, 0.25), 58, 16), 0.5)
    green = Material(leaf((0.08, 0.25, 0.08), (0.3, 0.52, 0.18), 2), 1.0, leafy=True)
    stem = Material(plain((0.25, 0.35, 0.15), 59, 0.1), 0.5)
    outline = [(0.0, 0.0), (0.13, 0.0), (0.19, -0.34), (0.21, -0.34), (0.21, -0.4), (0.17, -0.4), (0.16, -0.34)]
    pot = lathe([*outline, (0.0, -0.34)], (x, 0.0, z), clay)
    pieces = [pot]
    leaves = []
    for _ in range(16):
        angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.42)
        tip = np.array(
            [x + far * np.cos(angle), -0.35 - (height - 0.35) * rng.uniform(0.5, 1.0), z + far * np.sin(angle)]
        )
        pieces.append(pole((x, -0.33, z), tip, 0.007, stem, 6))
        share = rng.uniform(0.5, 1.05, (9, 1))
        leaves.append(np.array([x, -0.33, z]) * (1 - share) + tip * share + rng.normal(0, 0.05, (9, 3)))
    return [*pieces, cards(np.concatenate(leaves), 0.1, green, rng)]


def cup(center: Point, radius: float, height: float, material: Material) -> list[Piece]:
    """Return a cup that stands at a point, with a handle."""
    x, y, z = center
    r, t = radius, 0.004
    profile = [
        (0, 0),
        (0.8 * r, 0),
        (r, -0.3 * height),
        (r, -height),
        (r - t, -height),
        (r - t, -0.35 * height),
        (0, -0.08 * height),
    ]
    pieces = [lathe([(a, b) for a, b in profile], center, material, 28)]
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 7)
    ring = np.stack(
        (x + 0.95 * r + 0.45 * r * np.cos(angle), y - 0.55 * height + 0.3 * height * np.sin(angle), np.full(7, z)),
        axis=-1,
    )
    pieces += [pole(a, b, 0.006, material, 8) for a, b in itertools.pairwise(ring)]
    return pieces


def sofa(place: Place, yaw: float, material: Material, pillow: Material) -> list[Piece]:
    """Return a sofa for three that faces ``yaw`` rad."""
    dark = Material(wood((0.12, 0.08, 0.05), (0.25, 0.16, 0.1), 1, 4), 0.5)
    pieces = [slab((2.0, 0.24, 0.85), (0, -0.24, 0), material), slab((2.0, 0.5, 0.22), (0, -0.58, -0.34), material)]
    pieces += [slab((0.2, 0.5, 0.85), (x, -0.37, 0), material) for x in (-1.02, 1.02)]
    pieces += [slab((0.6, 0.14, 0.62), (x, -0.42, 0.08), material) for x in (-0.61, 0.0, 0.61)]
    pieces += [ball(0.22, (x, -0.66, -0.12), pillow, (1.0, 0.9, 0.45)) for x in (-0.7, 0.66)]
    pieces += [slab((0.06, 0.12, 0.06), (x, -0.06, z), dark) for x in (-0.9, 0.9) for z in (-0.35, 0.35)]
    return [piece.moved((place[0], 0.0, place[1]), yaw) for piece in pieces]


def striped(seed: int, bands: int = 8) -> Material:
    """Return striped cloth of random colors."""
    rng = np.random.default_rng(seed)
    first, second = (random_color(rng) for _ in range(2))
    return Material(cloth(first, second, "stripes", bands, seed), 1.6)
