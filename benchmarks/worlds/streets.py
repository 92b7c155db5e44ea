"""Worlds of roads: a walk along houses, and a drive."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.cameras import Unrest, looking
from benchmarks.worlds.film import World
from benchmarks.worlds.people import look, straight, walker
from benchmarks.worlds.props import bush, facade, lamp_post, tree
from benchmarks.worlds.shading import Light
from benchmarks.worlds.surface import Material, Piece, extruded, pole, slab
from benchmarks.worlds.textures import bricks, grass, pebbles, plain, random_color, spots
from benchmarks.worlds.vehicles import PAINTS, driving, parked
from uni4d_fg.arrays import FloatArray


def asphalt() -> Material:
    """Return a road."""
    return Material(spots((0.2, 0.2, 0.21), (0.44, 0.44, 0.44), 61, 16, 0.95, 0.2), 3.0, macro=0.06)


def white_lines() -> Material:
    """Return the paint of lines on roads."""
    return Material(spots((0.62, 0.62, 0.6), (0.88, 0.88, 0.86), 62, 16), 1.5)


def _street() -> list[Piece]:
    """Return a street between houses with mirroring panes, parked cars and lamps; its pavement is at y = 0."""
    paving = bricks((0.5, 0.48, 0.45), (0.64, 0.61, 0.56), (0.28, 0.27, 0.25), 4, 8, 63, 0.5, 0.035, 0.06, 0.09)
    curb = Material(spots((0.45, 0.45, 0.44), (0.62, 0.62, 0.6), 64, 16), 1.0)
    red = Material(bricks((0.5, 0.2, 0.14), (0.64, 0.34, 0.22), (0.62, 0.58, 0.52), seed=65), 1.76, macro=0.05)
    yellow = Material(bricks((0.66, 0.52, 0.32), (0.75, 0.64, 0.45), (0.5, 0.46, 0.4), seed=66), 1.76, macro=0.05)
    plaster = Material(plain((0.8, 0.76, 0.66), 67, 0.02), 3.0, macro=0.03)
    blue = Material(plain((0.55, 0.64, 0.72), 68, 0.02), 3.0, macro=0.03)
    static: list[Piece] = [
        slab((12.0, 0.2, 130.0), (-4.4, 0.1, 40.0), Material(paving, 2.4, macro=0.05)),
        slab((0.16, 0.26, 130.0), (1.66, 0.13, 40.0), curb),
        slab((7.4, 0.2, 130.0), (5.4, 0.22, 40.0), asphalt()),
        slab((0.16, 0.26, 130.0), (9.1, 0.13, 40.0), curb),
        slab((12.0, 0.2, 130.0), (15.2, 0.1, 40.0), Material(paving, 2.4, macro=0.05)),
        slab((60.0, 20.0, 1.0), (5.0, -8.0, 103.0), yellow),
    ]
    static += [slab((0.12, 0.01, 2.0), (5.4, 0.12, 1.0 + 5 * i), white_lines()) for i in range(20)]
    # Houses of different widths; those at the far end are as tall as the street is long.
    left = [(-14, -3, 3, plaster), (-3, 5.5, 3, red), (5.5, 13, 4, plaster), (13, 22, 3, yellow), (22, 34, 4, red),
            (34, 48, 3, blue), (48, 66, 4, yellow), (66, 100, 3, red)]  # fmt: skip
    right = [(-14, 2, 4, yellow), (2, 10, 3, blue), (10, 20, 4, red), (20, 29, 3, plaster), (29, 42, 4, yellow),
             (42, 60, 3, red), (60, 100, 4, blue)]  # fmt: skip
    for i, (start, end, floors, wall) in enumerate(left):
        static += facade(-2.3, start, end, floors, wall, 100 + i)
    for i, (start, end, floors, wall) in enumerate(right):
        static += facade(12.2, start, end, floors, wall, 200 + i, -1.0)
    for i, z in enumerate((3.2, 9.0, 14.4, 21.5, 27.0, 33.0, 44.0)):
        static += [
            p.moved((0, 0.12, 0)) for p in parked(PAINTS[i % 6], (2.75, z), 0.02 * (-1) ** i, i, 4.9 if i == 3 else 4.2)
        ]
    for i, z in enumerate((1.0, 7.5, 13.0, 24.0, 31.0, 40.0)):
        static += [p.moved((0, 0.12, 0)) for p in parked(PAINTS[(i + 2) % 6], (8.0, z), np.pi, 10 + i)]
    for z in (6.4, 18.0, 30.0, 42.0):
        static += lamp_post((1.3, z), 4.4, 0.8)
    static += tree((1.1, 12.0), 5.2, 1.5, 5, 2600, 0.08) + tree((1.1, 25.0), 5.6, 1.6, 6, 2600, 0.08)
    iron = Material(plain((0.1, 0.12, 0.11), 69, 0.1), 0.5)
    static += [pole((1.42, 0, z), (1.42, -0.95, z), 0.045, iron) for z in (2.6, 4.3, 8.2, 10.1)]
    static += [slab((0.5, 0.9, 0.5), (-1.95, -0.45, 8.6), Material(plain((0.12, 0.25, 0.16), 70, 0.08), 1.0))]
    static += [
        bush((-1.95, -0.55, 4.9), (0.28, 0.35, 0.28), 71, 900, 0.04),
        slab((0.5, 0.4, 0.5), (-1.95, -0.2, 4.9), curb),
    ]
    return static


def street_walk() -> World:
    """Return a walk on the pavement of a street, with three people."""
    static = _street()
    things = [
        walker(look(1), straight((-1.0, 9.6), (-1.05, 0.0)), 1.35),
        walker(look(2), straight((0.45, 15.5), (0.55, 0.0)), 1.2, 0.4),
        walker(look(4), straight((0.1, 4.4), (-0.1, 30.0)), 1.05, 0.2),
    ]

    def path(time: float) -> FloatArray:
        z = 1.3 * time
        return looking((-0.35 + 0.03 * z, -1.58, z), (-0.25, -1.5, z + 12.0))

    return World(
        "street_walk", static, things, Unrest(11, step_hz=1.9).on(path), Light((0.55, -0.75, -0.35)), focal_px=690.0,
        fps=20.0, frames=60, exposure_s=1 / 90, seed=1, tags=("panes", "forward", "people"),
    )  # fmt: skip


def scooter() -> World:
    """Return a ride on a scooter at 7 m/s behind a van that is as fast, past people on the pavement."""

    def van_at(s: float) -> FloatArray:
        on_pavement: FloatArray = straight((5.5, 9.0), (5.5, 100.0))(s)
        return on_pavement + np.array([0.0, 0.12, 0.0])

    things = [
        driving((0.8, 0.8, 0.78), van_at, lambda t: 7.0 * t + 0.3 * np.sin(1.3 * t), 4, 4.9),
        walker(look(1), straight((-0.6, 22.0), (-0.7, 0.0)), 1.35),
        walker(look(4), straight((0.3, 9.0), (0.2, 40.0)), 1.1, 0.2),
    ]

    def path(time: float) -> FloatArray:
        z = 7.0 * time
        x = 5.1 + 0.25 * np.sin(0.9 * time)
        return looking((x, -1.4, z), (x + 0.15 * np.cos(0.9 * time), -1.2, z + 14.0))

    unrest = Unrest(22, sway_m=0.008, sway_deg=0.3, tremor_deg=0.08)
    return World(
        "scooter", _street(), things, unrest.on(path), Light((0.4, -0.8, -0.3)), focal_px=600.0, fps=20.0, frames=50,
        exposure_s=1 / 200, seed=22, tags=("forward", "same speed", "people"),
    )  # fmt: skip


def dash() -> World:
    """Return a drive straight on at 10 m/s behind another car, with two that come the other way."""
    field = Material(grass((0.2, 0.26, 0.1), (0.52, 0.55, 0.26), 72), 3.5, macro=0.12)
    gravel = Material(pebbles((0.45, 0.42, 0.38), (0.62, 0.58, 0.52), (0.25, 0.23, 0.2), 2500, 73), 1.6)
    zinc = Material(spots((0.5, 0.52, 0.54), (0.64, 0.66, 0.68), 74, 8, 0.7, 0.2), 1.0)
    static: list[Piece] = [
        slab((900.0, 0.2, 900.0), (0.0, 0.17, 380.0), field),
        slab((11.0, 0.2, 500.0), (0.0, 0.13, 200.0), gravel),
        slab((7.6, 0.2, 500.0), (0.0, 0.1, 200.0), asphalt()),
    ]
    static += [slab((0.13, 0.02, 500.0), (x, 0.002, 200.0), white_lines()) for x in (-3.55, 3.55)]
    static += [slab((0.13, 0.02, 3.0), (0.0, 0.002, 4.0 + 7.5 * i), white_lines()) for i in range(50)]
    for x in (4.9, -4.9):
        static += [slab((0.03, 0.12, 400.0), (x, y, 180.0), zinc) for y in (-0.55, -0.72)]
        static += [slab((0.05, 0.08, 400.0), (x + 0.02 * np.sign(x), -0.635, 180.0), zinc)]
        static += [slab((0.07, 0.75, 0.1), (x + 0.06 * np.sign(x), -0.37, 2.0 * i), zinc) for i in range(90)]
    reflector = Material(plain((0.88, 0.88, 0.86), 75), 1.0)
    static += [slab((0.1, 0.95, 0.06), (x, -0.47, 10.0 + 25 * i), reflector) for i in range(9) for x in (-5.4, 5.4)]
    rng = np.random.default_rng(76)
    forms = [tree((0.0, 0.0), 7.0 + i, 2.1 + 0.2 * i, 300 + i, 2600, 0.17) for i in range(4)]
    for i in range(46):
        side, z = (-1) ** i, 4.0 + 4.6 * i + rng.uniform(-1.5, 1.5)
        where = (side * rng.uniform(7.5, 13.0), 0.0, z)
        static += [piece.moved(where, float(rng.uniform(0, 6))) for piece in forms[int(rng.integers(4))]]
    static += [bush((side * rng.uniform(6.3, 7.5), -0.5, 6.0 + 7 * i), (0.8, 0.7, 1.2), 400 + i, 900, 0.09)
               for i in range(16) for side in (-1, 1)]  # fmt: skip
    roof = Material(bricks((0.45, 0.18, 0.12), (0.56, 0.28, 0.18), (0.2, 0.1, 0.08), 8, 16, 77), 3.0)
    for i in range(14):
        x, z = rng.uniform(22, 90) * (-1) ** i, rng.uniform(60, 230)
        wide, deep, tall = rng.uniform(8, 13), rng.uniform(8, 12), rng.uniform(3.5, 6.0)
        wall = Material(plain(random_color(rng, (0.6, 0.5, 0.4), (0.9, 0.85, 0.8)), 78 + i % 3, 0.02), 3.0)
        static += [slab((wide, tall, deep), (x, -0.5 * tall, z), wall)]
        gable = [(-0.5 * deep - 0.4, -tall), (0.0, -tall - 0.4 * deep), (0.5 * deep + 0.4, -tall)]
        static += [extruded(gable, wide + 0.6, roof).moved((x, 0.0, z))]
        dark = Material(plain((0.1, 0.12, 0.14), 79, 0.05), 1.0, mirror=0.2)
        static += [slab((1.1, 1.3, deep + 0.06), (x + k * wide / 4, -1.7, z), dark) for k in (-1.2, 0.0, 1.2)]
    hill = Material(spots((0.16, 0.25, 0.13), (0.36, 0.44, 0.26), 80, 8, 0.8), 60.0)
    for i in range(5):
        ridge = extruded([(-60.0, 0.2), (0.0, -26.0 - 8 * (i % 3)), (60.0, 0.2)], 300.0, hill, 0.4)
        static.append(ridge.moved((-380.0 + 190 * i, 0.0, 520.0 + 30 * (i % 2))))
    things = [
        driving(
            (0.55, 0.08, 0.07), straight((1.9, 13.0), (1.9, 100.0)), lambda t: 10.3 * t + 0.25 * np.sin(1.1 * t), 1
        ),
        driving((0.75, 0.76, 0.78), straight((-1.9, 62.0), (-1.9, 0.0)), lambda t: 12.0 * t, 2),
        driving((0.14, 0.22, 0.45), straight((-1.85, 92.0), (-1.85, 0.0)), lambda t: 11.0 * t, 3, 4.9),
    ]

    def path(time: float) -> FloatArray:
        z = 10.0 * time
        x = 1.85 + 0.08 * np.sin(0.5 * time)
        return looking((x, -1.28, z), (x + 0.1, -1.15, z + 30.0))

    unrest = Unrest(21, sway_m=0.006, sway_deg=0.12, tremor_deg=0.05)
    return World(
        "dash", static, things, unrest.on(path), Light((-0.5, -0.7, 0.25), haze_m=700.0), focal_px=640.0, fps=15.0,
        frames=60, exposure_s=1 / 150, seed=2, tags=("forward", "little parallax", "same speed"),
    )  # fmt: skip
