"""Cars and a skateboard; a vehicle at rest faces +z and stands on y = 0."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.worlds.people import Path, heading
from benchmarks.worlds.stage import Thing
from benchmarks.worlds.surface import Material, Piece, extruded, frame_of, lathe, slab, turn_x, turn_y
from benchmarks.worlds.textures import Color, bricks, plain, spots
from uni4d_fg.arrays import FloatArray

PAINTS: tuple[Color, ...] = (
    (0.5, 0.06, 0.06), (0.12, 0.2, 0.4), (0.75, 0.75, 0.76), (0.1, 0.11, 0.12), (0.25, 0.36, 0.28), (0.6, 0.55, 0.45)
)  # fmt: skip
"""Of cars."""
WHEEL_M = 0.32
"""Radius of a car's wheels."""


def _wheel(radius: float, width: float) -> list[Piece]:
    """Return a wheel with spokes about the x axis, at the origin."""
    rubber = Material(spots((0.05, 0.05, 0.05), (0.12, 0.12, 0.12), 21, 16), 0.5)
    metal = Material(plain((0.62, 0.63, 0.65), 22, 0.05), 0.5, mirror=0.15)
    half = 0.5 * width
    tyre = lathe([(0, -half), (0.9 * radius, -half), (radius, -0.6 * half), (radius, 0.6 * half), (0.9 * radius, half),
                  (0, half)], (0, 0, 0), rubber, 24)  # fmt: skip
    tip = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    pieces = [tyre.placed(frame_of((0, 0, 0), tip))]
    for i in range(5):
        spoke = slab((width + 0.015, 0.62 * radius, 0.2 * radius), (0.0, 0.33 * radius, 0.0), metal)
        pieces.append(spoke.placed(frame_of((0, 0, 0), turn_x(2 * np.pi * i / 5))))
    return pieces


def car(color: Color, seed: int = 0, long: float = 4.2) -> tuple[list[Piece], list[list[Piece]], FloatArray]:
    """Return the body, four wheels about their own middles, and those middles (4, 3), meters.

    Args:
        color: Of its paint.
        seed: Of its plate.
        long: Length, meters; from 4.6 m on it is a van.
    """
    paint = Material(plain(color, seed, 0.02), 2.0, mirror=0.08)
    glass = Material(plain((0.05, 0.06, 0.07), 31, 0.05), 2.0, mirror=0.3)
    black = Material(plain((0.06, 0.06, 0.06), 32, 0.1), 1.0)
    lamp, tail = Material(plain((0.9, 0.9, 0.85), 33), 1.0, mirror=0.2), Material(plain((0.6, 0.05, 0.05), 34), 1.0)
    plate = Material(bricks((0.9, 0.9, 0.85), (0.05, 0.05, 0.05), (0.9, 0.9, 0.85), 8, 2, seed, 0.0, 0.3, 0.0), 0.5)
    z = 0.5 * long
    roof = -2.05 if long > 4.6 else -1.45
    hull = [(-z, -0.3), (-z, -0.75), (-z + 0.1, -0.92), (z - 1.2, -0.95), (z - 0.15, -0.8), (z, -0.6), (z, -0.3),
            (0.5 * z, -0.2), (-0.5 * z, -0.2)]  # fmt: skip
    cabin = [(-z + 0.12, -0.9), (-z + (0.2 if long > 4.6 else 0.55), roof + 0.04), (-z + 1.0, roof), (z - 1.9, roof),
             (z - 1.15, -0.9)]  # fmt: skip
    top = [(-z + (0.2 if long > 4.6 else 0.6), roof + 0.05), (-z + 1.0, roof - 0.02), (z - 1.9, roof - 0.02),
           (z - 1.85, roof + 0.05)]  # fmt: skip
    pieces = [
        extruded(hull, 1.72, paint, 0.97), extruded(cabin, 1.56, glass, 0.84), extruded(top, 1.36, paint, 1.0),
        slab((1.74, 0.16, 0.12), (0, -0.38, z), black), slab((1.74, 0.16, 0.12), (0, -0.38, -z), black),
        slab((0.5, 0.11, 0.03), (0, -0.55, -z - 0.02), plate), slab((0.5, 0.11, 0.03), (0, -0.5, z + 0.05), plate),
        slab((1.0, 0.12, 0.03), (0, -0.62, z), black),
    ]  # fmt: skip
    for side in (-1.0, 1.0):
        pieces += [
            slab((0.34, 0.13, 0.06), (side * 0.62, -0.68, z - 0.02), lamp),
            slab((0.3, 0.16, 0.05), (side * 0.64, -0.72, -z), tail),
            slab((0.18, 0.12, 0.08), (side * 0.93, -0.98, z - 1.45), paint),
            slab((0.012, 0.55, 0.012), (side * 0.862, -0.62, -0.15), black),
            slab((0.012, 0.55, 0.012), (side * 0.862, -0.62, z - 1.4), black),
        ]
    middles = np.array([[x, -WHEEL_M, d] for d in (z - 0.8, -z + 0.8) for x in (-0.78, 0.78)])
    return pieces, [_wheel(WHEEL_M, 0.2) for _ in range(4)], middles


def parked(color: Color, place: tuple[float, float], yaw: float, seed: int, long: float = 4.2) -> list[Piece]:
    """Return a car that stands at x and z, meters, and faces ``yaw`` rad."""
    pieces, wheels, middles = car(color, seed, long)
    for wheel, middle in zip(wheels, middles, strict=True):
        pieces += [piece.moved(middle) for piece in wheel]
    return [piece.moved((place[0], 0.0, place[1]), yaw) for piece in pieces]


def driving(color: Color, path: Path, distance: Callable[[float], float], seed: int, long: float = 4.2) -> Thing:
    """Return a car on a path with wheels that turn; ``distance`` maps seconds to meters driven."""
    pieces, wheels, middles = car(color, seed, long)
    frame = [0] * len(pieces)
    for i, wheel in enumerate(wheels):
        pieces += wheel
        frame += [i + 1] * len(wheel)

    def poses(time: float) -> FloatArray:
        s = distance(time)
        world, roll = frame_of(path(s), turn_y(heading(path, s, 0.1))), turn_x(s / WHEEL_M)
        return np.stack([world, *(world @ frame_of(middle, roll) for middle in middles)])

    return Thing(pieces, frame, poses)


def skateboard() -> list[Piece]:
    """Return a skateboard that faces +z and stands on y = 0; its deck is 0.11 m high."""
    deck = Material(spots((0.1, 0.1, 0.1), (0.2, 0.2, 0.2), 41, 64), 0.5)
    wheel, metal = Material(plain((0.9, 0.85, 0.6), 42), 0.5), Material(plain((0.5, 0.5, 0.52), 43), 0.5, mirror=0.2)
    pieces = [slab((0.2, 0.015, 0.56), (0, -0.105, 0), deck)]
    for end in (-1.0, 1.0):
        tip = slab((0.19, 0.015, 0.14), (0.0, 0.0, end * 0.07), deck)
        pieces.append(tip.placed(frame_of((0.0, -0.105, end * 0.275), turn_x(-0.35 * end))))
        pieces.append(slab((0.15, 0.03, 0.04), (0, -0.065, end * 0.2), metal))
        pieces += [slab((0.035, 0.054, 0.054), (x, -0.03, end * 0.2), wheel) for x in (-0.08, 0.08)]
    return pieces
