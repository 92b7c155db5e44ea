"""Worlds with thin things and people on the way: a staircase, and a market."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.cameras import Unrest, looking
from benchmarks.worlds.film import World
from benchmarks.worlds.people import look, straight, walker
from benchmarks.worlds.props import facade, glass, picture, potted_plant, striped
from benchmarks.worlds.shading import Light
from benchmarks.worlds.surface import Material, Piece, ball, pole, quad, sheet, slab
from benchmarks.worlds.textures import bricks, painted, pebbles, plain, random_color, scaled, spots, wood
from uni4d_fg.arrays import FloatArray

_TREAD, _RISE, _STEPS = 0.30, 0.165, 17


def stairs_portrait() -> World:
    """Return a climb up a staircase with a railing, in portrait format; somebody comes down."""
    wall = Material(plain((0.8, 0.77, 0.7), 181), 3.0)
    stone = Material(spots((0.5, 0.49, 0.47), (0.72, 0.7, 0.67), 182, 32, 0.8, 0.25), 1.2)
    oak = Material(wood((0.4, 0.25, 0.13), (0.62, 0.43, 0.25), 183, 4), 0.6)
    tiles = Material(bricks((0.2, 0.2, 0.22), (0.84, 0.82, 0.78), (0.4, 0.39, 0.37), 4, 4, 184, 0.0, 0.03, 0.05), 1.6)
    red = Material(bricks((0.5, 0.22, 0.15), (0.64, 0.36, 0.24), (0.6, 0.57, 0.52), seed=185), 1.76)
    end, top = _TREAD * _STEPS, -_RISE * _STEPS
    static: list[Piece] = [
        slab((6.0, 0.1, 14.0), (1.6, 0.05, 3.0), tiles),
        slab((0.2, 7.0, 16.0), (-0.95, -3.0, 3.0), wall), slab((0.2, 7.0, 16.0), (4.2, -3.0, 3.0), red),
        slab((6.0, 7.0, 0.2), (1.6, -3.0, end + 2.6), wall), slab((6.0, 7.0, 0.2), (1.6, -3.0, -3.2), wall),
        slab((6.0, 0.1, 16.0), (1.6, -6.2, 3.0), Material(plain((0.88, 0.88, 0.86), 186), 2.0)),
        slab((5.1, 0.25, 2.5), (1.65, top + 0.125, end + 1.25), stone),
    ]  # fmt: skip
    iron = Material(plain((0.1, 0.1, 0.11), 187, 0.1), 0.5)
    for i in range(_STEPS):
        z, y = _TREAD * i, -_RISE * (i + 1)
        static.append(slab((1.75, 0.045, _TREAD + 0.03), (0.025, y + 0.0225, z + 0.5 * _TREAD - 0.015), stone))
        static.append(slab((1.7, _RISE, 0.03), (0.0, y + 0.5 * _RISE + 0.02, z + 0.02), oak))
        static += [pole((0.8, y, z + d), (0.8, y - 0.92, z + d), 0.011, iron, 8)
                   for d in (0.08, 0.23)]  # fmt: skip
        static.append(slab((1.7, 0.12, 0.12), (0.0, y + 0.12, z + 0.2), wall))
    static.append(pole((0.8, -1.02, -0.1), (0.8, top - 1.02, end - 0.1), 0.028, oak))
    static.append(slab((0.08, 1.2, 0.08), (0.8, -0.6, -0.12), oak))
    static += [
        pole((0.8 + 0.15 * i, top, end + 0.1), (0.8 + 0.15 * i, top - 0.95, end + 0.1), 0.011, oak, 8)
        for i in range(22)
    ]
    static.append(pole((0.8, top - 0.97, end + 0.1), (4.1, top - 0.97, end + 0.1), 0.028, oak))
    for i, z in enumerate((0.7, 1.9, 3.1, 4.2)):
        y = -_RISE / _TREAD * z - 2.05
        static += picture((-0.838, y, z), (0.0, 0.0, 0.55), 0.45 + 0.1 * (i % 2), 950 + i)
    static += picture((-0.5, top - 2.0, end + 2.47), (0.9, 0.0, 0.0), 0.7, 956)
    static.append(quad((0.9, top - 2.1, end + 2.48), (1.3, 0.0, 0.0), (0.0, 1.2, 0.0), glass(0.4)))
    white = Material(plain((0.9, 0.9, 0.88), 188), 1.0)
    static += [slab((1.4, 0.08, 0.1), (1.55, top - y, end + 2.47), white) for y in (0.9, 2.1)]
    static += [slab((0.06, 1.2, 0.08), (x, top - 1.5, end + 2.47), white) for x in (0.9, 1.55, 2.2)]
    static += [p.moved((0.0, top, 0.0)) for p in potted_plant((3.2, end + 1.9), 1.3, 189)]
    static += potted_plant((2.4, 1.2), 1.5, 190)
    slope = _RISE / _TREAD

    def ground(x: float, z: float) -> float:
        return float(-_RISE * np.clip(np.floor(z / _TREAD) + 1, 0, _STEPS))

    def down(s: float) -> FloatArray:
        z = 4.35 - s
        return np.array([-0.32, -slope * np.clip(z + 0.5 * _TREAD, 0.0, end) + 0.03, z])

    # A step of the walk is one tread; feet come down on the middle of treads.
    things = [walker(look(41), down, 0.72, 0.0, _TREAD, ground, 0.3)]

    def path(time: float) -> FloatArray:
        z = -1.1 + 0.75 * time
        rise = slope * np.log1p(np.exp(6 * (z + 0.1))) / 6
        return looking((0.3 + 0.03 * z, -1.55 - rise, z), (0.12, -1.55 - rise - 0.95, z + 3.6))

    light = Light(lamps=((1.6, -4.9, 0.6), (2.2, -5.0, 5.9)), lamp_color=(6.0, 5.6, 5.0), lamp_radius_m=0.3,
                  ambient_up=(0.36, 0.35, 0.34), ambient_down=(0.3, 0.28, 0.26))  # fmt: skip
    return World(
        "stairs_portrait", static, things, Unrest(91, step_hz=1.6).on(path), light, width=480, height=854,
        focal_px=720.0, fps=24.0, frames=60, exposure_s=1 / 60, noise=0.014, gain=1.1, kbps=2200, seed=9,
        tags=("portrait", "stairs", "thin", "plain wall"),
    )  # fmt: skip


def _stall(place: tuple[float, float], size: tuple[float, float], cover: Material, seed: int) -> list[Piece]:
    """Return a market stall: four posts, a sagging cover, a table with crates and what is in them."""
    rng = np.random.default_rng(seed)
    x, z = place
    wide, deep = size
    iron = Material(plain((0.6, 0.61, 0.62), 191, 0.05), 0.5)
    board = Material(wood((0.45, 0.33, 0.2), (0.7, 0.55, 0.38), seed % 5, 5), 0.8)
    pieces = [
        pole((x + a * wide, 0.0, z + b * deep), (x + a * wide, -2.15 - 0.25 * (b > 0), z + b * deep), 0.02, iron)
        for a in (-0.5, 0.5)
        for b in (-0.5, 0.5)
    ]
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 13), np.linspace(-0.5, 0.5, 9))
    sag = 0.16 * (1 - (2 * u) ** 2) * (1 - (2 * v) ** 2) + 0.015 * np.sin(19 * u + seed)
    top = np.stack((x + (wide + 0.3) * u, -2.3 - 0.25 * v + sag, z + (deep + 0.4) * v), axis=-1)
    pieces.append(sheet(top, cover))
    front = np.stack(
        (top[0], top[0] + np.stack((np.zeros(13), 0.22 + 0.03 * np.sin(np.arange(13) * 1.6), np.zeros(13)), axis=-1))
    )
    pieces.append(sheet(front, cover))
    pieces.append(slab((wide - 0.2, 0.04, 0.9), (x, -0.8, z), board))
    drape = np.linspace(-0.5, 0.5, 40)
    rows = [
        np.stack((x + (wide - 0.15) * drape, np.full(40, y), z - 0.47 + 0.02 * np.sin(40 * drape + seed)), axis=-1)
        for y in (-0.8, -0.1)
    ]
    pieces.append(sheet(np.stack(rows), Material(plain(random_color(rng, 0.15, 0.8), 192, 0.03), 1.0)))
    for i in range(int(wide / 0.5)):
        cx = x - 0.5 * wide + 0.4 + 0.5 * i
        pieces.append(slab((0.42, 0.13, 0.5), (cx, -0.885, z - 0.1), board))
        hue = rng.uniform(0.2, 0.9, 3) * rng.choice(
            [[1.0, 0.3, 0.15], [1.0, 0.75, 0.2], [0.4, 0.8, 0.25], [0.7, 0.2, 0.5]]
        )
        fruit = Material(spots(scaled(hue, 0.7), scaled(hue, 1.2), 193, 8, 0.7, 0.25), 0.4)
        for _ in range(22):
            px, pz = rng.uniform(-0.17, 0.17), rng.uniform(-0.2, 0.2)
            pieces.append(ball(rng.uniform(0.035, 0.05), (cx + px, -0.97 - 0.03 * rng.random(), z - 0.1 + pz), fruit))
    sign = Material(painted(970 + seed, random_color(rng, 0.4, 0.9), 6, 10), 0.6)
    return [*pieces, slab((0.6, 0.35, 0.02), (x + 0.2 * wide, -1.75, z - 0.5 * deep), sign)]


def market() -> World:
    """Return a walk through a market: many thin posts, plain covers, five people who cross."""
    cobbles = Material(pebbles((0.42, 0.4, 0.38), (0.6, 0.57, 0.53), (0.2, 0.19, 0.17), 900, 201), 2.4, macro=0.06)
    plaster = Material(plain((0.82, 0.74, 0.58), 202, 0.02), 3.0)
    red = Material(bricks((0.5, 0.2, 0.14), (0.64, 0.34, 0.22), (0.62, 0.58, 0.52), seed=203), 1.76, macro=0.05)
    static: list[Piece] = [slab((90.0, 0.2, 110.0), (0.0, 0.1, 30.0), cobbles)]
    for i, (start, end, floors, wall) in enumerate([(-12, 6, 3, red), (6, 20, 4, plaster), (20, 44, 3, red)]):
        static += facade(-9.5, start, end, floors, wall, 210 + i) + facade(
            9.5, start, end, floors, plaster if i % 2 else red, 220 + i, -1.0
        )
    static += [p.moved((0.0, 0.0, 46.0), 0.5 * np.pi) for p in facade(0.0, -16, 16, 4, plaster, 230)]
    white, blue, scarlet = (0.85, 0.84, 0.8), (0.2, 0.36, 0.6), (0.75, 0.2, 0.16)
    covers = [Material(plain(color, 204 + i), 2.0, leafy=True) for i, color in enumerate((white, blue, scarlet))]
    covers.insert(2, striped(206, 6))
    number = 0
    for row, z in enumerate((5.2, 9.2, 13.6, 18.5, 24.0)):
        for side in (-1.0, 1.0):
            number += 1
            static += _stall((side * (3.0 + 0.25 * (row % 2)), z), (2.6, 1.9), covers[(number + row) % 4], number)
    static += _stall((6.6, 11.0), (2.4, 1.8), covers[0], 20) + _stall((-6.8, 7.5), (2.4, 1.8), covers[3], 21)
    iron = Material(plain((0.14, 0.15, 0.15), 208, 0.1), 0.5)
    for x, z in ((-1.25, 3.4), (1.35, 7.2), (-1.3, 11.4), (1.25, 16.0)):
        static += [pole((x, 0, z), (x, -3.2, z), 0.028, iron)]
    # Strings of pennants across the way.
    flag = [Material(plain(c, 209), 1.0, leafy=True) for c in ((0.8, 0.2, 0.15), (0.9, 0.8, 0.2), (0.2, 0.5, 0.75))]
    for a, b in (((-1.25, 3.4), (1.35, 7.2)), ((1.35, 7.2), (-1.3, 11.4)), ((-1.3, 11.4), (1.25, 16.0))):
        share = np.linspace(0, 1, 13)
        line = np.stack(
            (a[0] + share * (b[0] - a[0]), -3.15 + 0.9 * share * (1 - share), a[1] + share * (b[1] - a[1])), axis=-1
        )
        for i in range(12):
            p, q = line[i], line[i + 1]
            static.append(pole(p, q, 0.004, iron, 6))
            r = p + 0.55 * (q - p)
            static.append(quad(p, 0.55 * (r - p), (0.0, 0.2, 0.0), flag[i % 3]))
    things = [
        walker(look(51), straight((-4.5, 7.1), (5.0, 7.25)), 1.15, 0.9),
        walker(look(52), straight((3.6, 11.35), (-4.0, 11.5)), 1.2, 0.7),
        walker(look(53), straight((0.65, 14.0), (0.5, 0.0)), 1.1),
        walker(look(54), straight((-0.5, 5.2), (-0.35, 40.0)), 0.9, 0.3),
        walker(look(55), straight((-3.0, 16.0), (6.0, 15.8)), 1.25),
    ]

    def path(time: float) -> FloatArray:
        z = -0.6 + 0.85 * time
        return looking((0.1 - 0.04 * time, -1.6, z), (0.15 * np.sin(0.8 * time), -1.42, z + 7.0))

    return World(
        "market", static, things, Unrest(95, step_hz=1.8).on(path), Light((-0.45, -0.8, -0.3)), focal_px=660.0,
        fps=20.0, frames=60, exposure_s=1 / 80, seed=10, tags=("thin posts", "crowd", "plain covers"),
    )  # fmt: skip
