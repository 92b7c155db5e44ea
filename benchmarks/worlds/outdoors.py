"""Worlds under the sky: a dog in a park, and roofs from a drone."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.animals import four_legged
from benchmarks.worlds.cameras import Unrest, looking
from benchmarks.worlds.film import World
from benchmarks.worlds.people import look, straight, walker
from benchmarks.worlds.props import bench, bush, tree
from benchmarks.worlds.shading import Light
from benchmarks.worlds.stage import Thing
from benchmarks.worlds.streets import asphalt, white_lines
from benchmarks.worlds.surface import Material, Piece, ball, extruded, frame_of, pole, slab, turn_x
from benchmarks.worlds.textures import bricks, cloth, grass, pebbles, plain, scaled, spots
from benchmarks.worlds.vehicles import PAINTS, driving, parked
from uni4d_fg.arrays import FloatArray
from uni4d_fg.geometry.se3 import so3_exp


def park_dog() -> World:
    """Return a lawn with trees; the camera turns after a dog that chases a ball, and hardly goes anywhere itself."""
    lawn = Material(grass(seed=131), 1.7, macro=0.1)
    sand = Material(pebbles((0.62, 0.54, 0.42), (0.75, 0.68, 0.55), (0.42, 0.36, 0.28), 5000, 132), 1.6, macro=0.06)
    static: list[Piece] = [
        slab((160.0, 0.2, 160.0), (0.0, 0.1, 40.0), lawn),
        slab((90.0, 0.02, 2.2), (0.0, 0.0, 10.5), sand, 0.06),
    ]
    forms = [tree((0.0, 0.0), 6.0 + 1.2 * i, 1.9 + 0.25 * i, 500 + i, 3400, 0.12) for i in range(4)]
    rng = np.random.default_rng(133)
    spots_of = [
        (-9.0, 13.5), (-4.2, 15.5), (1.5, 13.0), (6.5, 14.5), (11.5, 13.0), (-13.0, 19.0), (-7.0, 22.0), (-1.5, 20.0),
        (4.0, 21.0), (9.0, 20.0), (15.0, 18.5), (19.0, 24.0), (-19.0, 25.0), (-3.0, 29.0), (7.0, 30.0), (13.5, 29.0),
    ]  # fmt: skip
    for i, (x, z) in enumerate(spots_of):
        static += [piece.moved((x, 0.0, z), float(rng.uniform(0, 6))) for piece in forms[i % 4]]
    for i in range(24):
        static.append(bush((-46.0 + 4.0 * i, -1.2, 36.0 + rng.uniform(-2, 2)), (2.8, 2.2, 1.5), 600 + i, 1300, 0.16))
    static += bench((3.2, 8.9), np.pi + 0.1, 2) + bench((-6.0, 9.0), np.pi - 0.1, 3)
    wooden = Material(spots((0.25, 0.2, 0.15), (0.45, 0.38, 0.3), 134, 16, 0.8, 0.3, 8), 0.5)
    static += [pole((-8.0 + 2.0 * i, 0.2, 7.6), (-8.0 + 2.0 * i, -0.75, 7.6), 0.045, wooden) for i in range(9)]
    fur = Material(spots((0.3, 0.2, 0.1), (0.75, 0.58, 0.38), 135, 8, 0.8, 0.4), 0.6)

    def run(s: float) -> FloatArray:
        return np.array([-4.4 + s, 0.0, 5.6 + 0.7 * np.sin(0.55 * s)])

    skin = Material(cloth((0.85, 0.16, 0.1), (0.9, 0.88, 0.8), "stripes", 4, 136), 0.7)

    def thrown(time: float) -> FloatArray:
        # It bounces on ahead of the dog.
        height = 1.3 * np.exp(-0.45 * time) * abs(np.sin(np.pi * (0.25 + time / 0.85)))
        return frame_of(
            (-2.3 + 3.7 * time, -0.11 - height, 5.1 + 0.5 * time), so3_exp(np.array([2.0, 0.0, 9.0]) * time)
        )

    things = [
        Thing.rigid([ball(0.11, (0.0, 0.0, 0.0), skin)], thrown),
        four_legged(fur, run, 4.0, 0.52, True, 0.0, 0.5),
        walker(look(14), straight((9.0, 10.9), (-9.0, 10.0)), 1.2),
    ]

    def path(time: float) -> FloatArray:
        dog = run(4.0 * (time - 0.08))
        position = (-0.35 + 0.22 * time, -1.5, 0.1 * time)
        return looking(position, (0.92 * dog[0], -0.75, dog[2] + 0.3))

    return World(
        "park_dog", static, things, Unrest(51, sway_deg=0.6).on(path), Light((0.4, -0.72, -0.45)), focal_px=720.0,
        fps=30.0, frames=64, exposure_s=1 / 100, seed=5, tags=("pan", "grass", "leaves", "dog"),
    )  # fmt: skip


def _house(place: tuple[float, float], size: tuple[float, float, float], yaw: float, seed: int) -> list[Piece]:
    """Return a house with a gable roof, chimney and windows."""
    rng = np.random.default_rng(seed)
    wide, tall, deep = size
    tone = rng.uniform(0.75, 1.05)
    wall = Material(plain((0.82 * tone, 0.77 * tone, 0.68 * tone), seed % 3, 0.02), 3.0)
    shade = [(0.5, 0.22, 0.14), (0.36, 0.34, 0.34), (0.45, 0.3, 0.2)][seed % 3]
    bright, joint = (scaled(shade, f) for f in (1.35, 0.5))
    tiles = Material(bricks(shade, bright, joint, 16, 24, 140 + seed % 3, 0.5, 0.12, 0.12), 4.0, macro=0.06)
    dark = Material(plain((0.12, 0.14, 0.17), 141, 0.1), 1.0, mirror=0.25)
    red = Material(bricks((0.5, 0.2, 0.14), (0.64, 0.34, 0.22), (0.62, 0.58, 0.52), seed=65), 1.76)
    rise = 0.36 * deep
    pieces = [slab((wide, tall, deep), (0, -0.5 * tall, 0), wall)]
    pieces.append(
        extruded(
            [(-0.5 * deep - 0.5, -tall + 0.2), (0.0, -tall - rise), (0.5 * deep + 0.5, -tall + 0.2)], wide + 0.8, tiles
        )
    )
    pieces.append(slab((0.7, 1.6, 0.7), (0.3 * wide, -tall - 0.85 * rise, 0.12 * deep), red))
    for i in range(3):
        x = (i - 1) * 0.3 * wide
        pieces += [
            slab((1.1, 1.3, 0.1), (x, -h, s * 0.5 * deep), dark) for s in (-1, 1) for h in (1.6, 4.2) if h < tall
        ]
        if rng.random() < 0.5:
            # A window in the roof lies on its slope.
            slope = turn_x(-np.arctan2(rise, 0.5 * deep))
            frame = frame_of((x, -tall - 0.5 * rise - 0.08, -0.25 * deep), slope)
            pieces.append(slab((0.9, 0.12, 1.2), (0, 0, 0), dark).placed(frame))
    return [piece.moved((place[0], 0.0, place[1]), yaw) for piece in pieces]


def drone() -> World:
    """Return a flight over roofs, gardens and roads with cars, from 25 m high."""
    rng = np.random.default_rng(142)
    field = Material(grass((0.16, 0.25, 0.09), (0.46, 0.55, 0.25), 143), 6.0, macro=0.15)
    walkway = Material(
        bricks((0.52, 0.5, 0.47), (0.62, 0.6, 0.56), (0.34, 0.33, 0.31), 6, 12, 144, 0.5, 0.05, 0.06), 4.0
    )
    static: list[Piece] = [slab((400.0, 0.2, 400.0), (0.0, 0.12, 80.0), field)]
    for z in (8.0, 52.0, 96.0, 140.0):
        static += [slab((400.0, 0.2, 9.5), (0, 0.09, z), walkway), slab((400.0, 0.2, 6.5), (0, 0.08, z), asphalt())]
    static += [
        slab((9.5, 0.2, 400.0), (3.0, 0.085, 80.0), walkway),
        slab((6.5, 0.2, 400.0), (3.0, 0.07, 80.0), asphalt()),
    ]
    white = white_lines()
    for z in (8.0, 52.0, 96.0):
        static += [
            slab((2.2, 0.02, 0.14), (-60.0 + 5.5 * i, -0.025, z), white) for i in range(24) if abs(-63.0 + 5.5 * i) > 4
        ]
    static += [slab((0.14, 0.02, 2.2), (3.0, -0.035, -10 + 5.5 * i), white) for i in range(26)]
    number = 0
    for row, z in enumerate((-4.0, 20.0, 40.0, 64.0, 84.0, 108.0, 128.0)):
        for x in (-52.0, -37.0, -22.0, -9.0, 15.5, 30.0, 45.0, 60.0):
            number += 1
            size = (rng.uniform(8.5, 11.0), float(rng.choice([3.2, 5.8])), rng.uniform(7.0, 9.0))
            yaw = float(rng.choice([0.0, 0.0, 0.5 * np.pi])) + rng.normal(0, 0.03)
            static += _house((x + rng.uniform(-1, 1), z + rng.uniform(-1, 1)), size, yaw, number)
            back = z + (7.0 if row % 2 else -7.0)
            static.append(bush((x + 6.8, -0.6, z), (0.5, 0.7, 4.0), 700 + number, 900, 0.13))
            if rng.random() < 0.6:
                static += tree(
                    (x + rng.uniform(-4, 4), back), rng.uniform(4, 6.5), rng.uniform(1.3, 1.9), 800 + number, 900, 0.2
                )
            if rng.random() < 0.4:
                static += parked(PAINTS[number % 6], (x + 5.6, z - 1.0), 0.0, number)
    things = [
        driving(PAINTS[0], straight((-38.0, 50.4), (60.0, 50.4)), lambda t: 9.0 * t, 1),
        driving(PAINTS[2], straight((30.0, 53.6), (-60.0, 53.6)), lambda t: 8.0 * t, 2),
        driving(PAINTS[1], straight((1.4, 75.0), (1.4, 0.0)), lambda t: 7.0 * t, 3, 4.9),
        driving(PAINTS[5], straight((4.6, 18.0), (4.6, 160.0)), lambda t: 8.0 * t, 4),
    ]

    def path(time: float) -> FloatArray:
        z = 6.5 * time
        return looking(
            (-1.5 + 0.6 * time, -25.0 - 0.2 * time, z), (-0.5 + 0.6 * time, -25.0 + 21.0 - 0.2 * time, z + 30.0)
        )

    unrest = Unrest(61, sway_m=0.03, sway_deg=0.25, tremor_deg=0.015)
    return World(
        "drone", static, things, unrest.on(path), Light((0.6, -0.7, 0.2), haze_m=2500.0), width=1280, height=720,
        focal_px=1000.0, fps=24.0, frames=40, exposure_s=1 / 200, noise=0.007, kbps=5000, seed=6,
        tags=("from above", "forward", "cars"),
    )  # fmt: skip
