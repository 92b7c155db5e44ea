"""Worlds indoors: a table from near by, and a living room."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.animals import four_legged
from benchmarks.worlds.cameras import Unrest, looking, smooth
from benchmarks.worlds.film import World
from benchmarks.worlds.people import straight
from benchmarks.worlds.props import cup, picture, potted_plant, sofa, striped
from benchmarks.worlds.shading import Light
from benchmarks.worlds.stage import Thing
from benchmarks.worlds.surface import Material, Piece, along, ball, cards, frame_of, lathe, limb, pole, slab, turn_y
from benchmarks.worlds.textures import cloth, leaf, painted, plain, random_color, spots, wood
from uni4d_fg.arrays import FloatArray

_FROM_ABOVE, _FROM_BELOW = (0.34, 0.33, 0.31), (0.30, 0.28, 0.26)


def room(
    wide: tuple[float, float], deep: tuple[float, float], height: float, wall: Material, floor: Material
) -> list[Piece]:
    """Return walls, floor and ceiling between x ``wide`` and z ``deep``, meters, with skirting boards."""
    x, z = 0.5 * sum(wide), 0.5 * sum(deep)
    w, d = wide[1] - wide[0], deep[1] - deep[0]
    white = Material(plain((0.9, 0.9, 0.88), 81), 2.0)
    pieces = [slab((w, 0.1, d), (x, 0.05, z), floor), slab((w, 0.1, d), (x, -height - 0.05, z), white)]
    pieces += [
        slab((0.1, height, d), (e + 0.05 * s, -0.5 * height, z), wall) for e, s in zip(wide, (-1, 1), strict=True)
    ]
    pieces += [
        slab((w, height, 0.1), (x, -0.5 * height, e + 0.05 * s), wall) for e, s in zip(deep, (-1, 1), strict=True)
    ]
    pieces += [slab((0.03, 0.09, d), (e, -0.045, z), white) for e in wide]
    return [*pieces, *(slab((w, 0.09, 0.03), (x, -0.045, e), white) for e in deep)]


def _hand(skin: Material, sleeve: Material) -> list[Piece]:
    """Return a right hand at the origin that points along +z with a forearm behind it; its palm faces -x."""
    pieces = [
        limb(0.085, 0.032, 0.04, skin, 0.5).placed(along((0.0, 0.0, -0.085), (0.0, 0.0, 0.0), (1, 0, 0))),
        limb(0.24, 0.05, 0.032, sleeve).placed(along((0.06, -0.06, -0.32), (0.0, 0.0, -0.09), (1, 0, 0))),
        limb(0.34, 0.062, 0.052, sleeve).placed(along((0.22, -0.32, -0.54), (0.06, -0.06, -0.32), (1, 0, 0))),
    ]
    for i in range(4):
        y = -0.033 + 0.022 * i
        knuckle, tip = (-0.012, y, 0.045), (-0.062, y, 0.066)
        pieces.append(limb(0.05, 0.011, 0.01, skin).placed(along((0.006, y, -0.005), knuckle, (1, 0, 0))))
        pieces.append(limb(0.05, 0.01, 0.009, skin).placed(along(knuckle, tip, (1, 0, 0))))
    thumb = along((-0.02, -0.03, -0.06), (-0.082, -0.02, 0.0), (0, 1, 0))
    return [*pieces, limb(0.08, 0.014, 0.011, skin).placed(thumb)]


def table_orbit() -> World:
    """Return a table from near by: cups, boxes, a vase with stems, and a hand that moves a cup."""
    top = -0.74
    rng = np.random.default_rng(82)
    wall, floor = Material(plain((0.78, 0.76, 0.7), 83), 3.0), Material(wood(seed=84), 1.2)
    static = room((-2.6, 2.6), (-2.8, 1.35), 2.6, wall, floor)
    board = Material(wood((0.38, 0.22, 0.11), (0.66, 0.44, 0.25), 85, 5), 1.0)
    static += [slab((1.5, 0.04, 0.95), (0.0, top + 0.02, 0.05), board)]
    static += [slab((0.07, 0.7, 0.07), (x, -0.35, z), board) for x in (-0.68, 0.68) for z in (-0.36, 0.46)]
    runner = Material(cloth((0.55, 0.18, 0.16), (0.85, 0.8, 0.7), "plaid", 6, 86), 0.5)
    static += [slab((0.42, 0.004, 0.95), (-0.02, top - 0.002, 0.05), runner)]
    china = Material(plain((0.88, 0.88, 0.85), 87, 0.01), 0.5, mirror=0.04)
    dots = Material(cloth((0.2, 0.35, 0.6), (0.9, 0.9, 0.85), "dots", 8, 88), 0.16, mirror=0.03)
    green = Material(spots((0.22, 0.4, 0.3), (0.4, 0.58, 0.44), 89, 16), 0.3, mirror=0.03)
    static += cup((-0.36, top, -0.12), 0.042, 0.09, dots) + cup((0.12, top, 0.22), 0.045, 0.085, green)
    static += cup((0.46, top, 0.3), 0.04, 0.1, china)
    static += [
        lathe(
            [(0, 0), (0.09, 0), (0.13, -0.015), (0.125, -0.02), (0.085, -0.008), (0, -0.006)],
            (-0.36, top + 0.001, 0.28),
            china,
            32,
        )
    ]
    static += [ball(0.04, (-0.39 + 0.07 * i, top - 0.045, 0.27 + 0.03 * (i % 2)), Material(spots(
        (0.6, 0.1, 0.06), (0.85, 0.55, 0.15), 90 + i, 8, 0.7, 0.3), 0.25)) for i in range(2)]  # fmt: skip
    boxes = [((0.2, 0.26, 0.07), (0.32, 0.42), 0.3), ((0.16, 0.09, 0.12), (-0.55, 0.36), -0.4),
             ((0.12, 0.14, 0.12), (-0.58, -0.12), 0.5), ((0.24, 0.035, 0.17), (0.42, -0.24), 0.25)]  # fmt: skip
    for i, (size, (x, z), yaw) in enumerate(boxes):
        print_of = Material(painted(900 + i, random_color(rng, 0.3, 0.85), 24, 8), 0.5)
        static.append(slab(size, (x, top - 0.5 * size[1] - 0.001, z), print_of, yaw))
    book = Material(painted(905, (0.2, 0.3, 0.5), 10, 6), 0.4)
    static.append(slab((0.21, 0.025, 0.15), (0.43, top - 0.0495, -0.23), book, 0.45))
    vase = Material(cloth((0.15, 0.3, 0.42), (0.75, 0.78, 0.72), "stripes", 14, 91), 0.3, mirror=0.05)
    outline = [(0, 0), (0.045, 0), (0.07, -0.06), (0.06, -0.13), (0.03, -0.19), (0.038, -0.22), (0.033, -0.22)]
    static.append(lathe([*outline, (0.024, -0.19), (0, -0.12)], (-0.12, top, 0.34), vase, 32))
    stem = Material(plain((0.3, 0.38, 0.16), 92, 0.1), 0.3)
    tips = []
    for i in range(9):
        angle, far = 0.7 * i, 0.05 + 0.17 * rng.random()
        tip = np.array([-0.12 + far * np.cos(angle), top - 0.38 - 0.16 * rng.random(), 0.34 + far * np.sin(angle)])
        static.append(pole((-0.12, top - 0.15, 0.34), tip, 0.0028, stem, 6))
        petal = Material(plain(random_color(rng, (0.6, 0.2, 0.2), (0.95, 0.7, 0.6)), 93, 0.05), 0.2, leafy=True)
        static.append(cards(tip + rng.normal(0, 0.013, (26, 3)), 0.016, petal, rng))
        share = rng.uniform(0.45, 0.9, (5, 1))
        tips.append((np.array([-0.12, top - 0.15, 0.34]) * (1 - share) + tip * share) + rng.normal(0, 0.012, (5, 3)))
    static.append(cards(np.concatenate(tips), 0.028, Material(leaf(seed=3), 0.5, leafy=True), rng))

    def grip(time: float) -> FloatArray:
        # In to the cup from the right, away with it to the left, and back.
        come, go = (float(smooth((time - a) / b)) for a, b in ((0.1, 0.6), (1.75, 0.5)))
        away = ((1.0 - come) + go) * np.array([0.3, -0.12, 0.1])
        result: FloatArray = cup_place(time) + turn @ np.array([0.052, -0.05, -0.03]) + away
        return result

    def cup_place(time: float) -> FloatArray:
        carry = float(smooth((time - 0.8) / 0.8))
        return np.array([0.2 - 0.26 * carry, top - 0.05 * np.sin(np.pi * carry), -0.03 - 0.05 * carry])

    skin = Material(spots((0.8, 0.6, 0.48), (0.72, 0.5, 0.4), 94, 8, 0.7, 0.2), 0.2)
    sleeve = Material(cloth((0.2, 0.26, 0.4), (0.75, 0.75, 0.7), "stripes", 16, 95), 0.6)
    red = Material(cloth((0.7, 0.15, 0.12), (0.9, 0.82, 0.7), "stripes", 10, 96), 0.2, mirror=0.03)
    turn = turn_y(-1.9)
    things = [
        Thing.rigid(_hand(skin, sleeve), lambda t: frame_of(grip(t), turn)),
        Thing.rigid(cup((0, 0, 0), 0.04, 0.095, red), lambda t: frame_of(cup_place(t))),
    ]

    def path(time: float) -> FloatArray:
        angle = np.deg2rad(-30.0 + 60.0 * time / 2.4)
        near = 1.12 - 0.05 * np.sin(1.3 * time)
        return looking(
            (near * np.sin(angle), -1.28 + 0.06 * np.sin(1.1 * time), 0.1 - near * np.cos(angle)), (0.0, -0.78, 0.12)
        )

    lamps = ((0.9, -2.45, -1.2), (-1.4, -2.45, -0.4))
    light = Light(lamps=lamps, lamp_color=(2.2, 2.0, 1.75), ambient_up=_FROM_ABOVE, ambient_down=_FROM_BELOW)
    return World(
        "table_orbit", static, things, Unrest(31, sway_m=0.008).on(path), light, focal_px=760.0, fps=24.0, frames=58,
        exposure_s=1 / 60, noise=0.013, gain=1.2, seed=3, tags=("near", "thin", "plain wall", "hand"),
    )  # fmt: skip


def living_room() -> World:
    """Return a walk sideways through a room with plain walls and ceiling, a cat and a door that opens."""
    rng = np.random.default_rng(101)
    wall = Material(plain((0.74, 0.77, 0.74), 102), 3.0)
    floor = Material(wood((0.45, 0.3, 0.17), (0.66, 0.5, 0.32), 103), 1.0)
    static = room((-3.6, 3.6), (-2.6, 2.3), 2.6, wall, floor)
    fabric = Material(cloth((0.36, 0.38, 0.42), (0.36, 0.38, 0.42), "weave", 8, 104), 0.9)
    static += sofa((-0.7, 1.75), np.pi, fabric, striped(105))
    rug = Material(cloth((0.55, 0.25, 0.2), (0.8, 0.7, 0.52), "plaid", 5, 106), 1.6)
    static += [slab((2.3, 0.012, 1.5), (-0.5, -0.006, 0.55), rug)]
    board = Material(wood((0.28, 0.17, 0.09), (0.5, 0.33, 0.18), 107, 4), 0.7)
    static += [slab((0.9, 0.035, 0.5), (-0.6, -0.42, 0.95), board)]
    static += [slab((0.05, 0.4, 0.05), (x, -0.2, z), board) for x in (-1.0, -0.2) for z in (0.75, 1.15)]
    static += cup((-0.45, -0.4375, 0.9), 0.04, 0.09, Material(plain((0.8, 0.5, 0.2), 108), 0.5))
    static += [slab((0.22, 0.03, 0.28), (-0.82, -0.453, 0.96), Material(painted(109, strokes=12), 0.4), 0.3)]
    static += picture((-1.7, -2.0, 2.28), (0.7, 0.0, 0.0), 0.5, 110) + picture(
        (-0.65, -1.95, 2.28), (0.5, 0.0, 0.0), 0.62, 111
    )
    static += picture((0.25, -1.85, 2.28), (0.45, 0.0, 0.0), 0.4, 112)
    static += picture((-3.58, -1.9, 0.0), (0.0, 0.0, 0.9), 0.6, 113)
    static += potted_plant((0.95, 1.85), 1.35, 114)
    # Shelves with books.
    shelf = Material(wood((0.6, 0.5, 0.36), (0.75, 0.65, 0.5), 115, 4), 0.8)
    static += [slab((1.3, 0.03, 0.3), (2.3, -0.08 - 0.42 * i, 2.1), shelf) for i in range(5)]
    static += [slab((0.03, 1.8, 0.3), (x, -0.9, 2.1), shelf) for x in (1.64, 2.96)]
    for row in range(4):
        x = 1.68
        while x < 2.85:
            thick, tall = rng.uniform(0.018, 0.05), rng.uniform(0.2, 0.33)
            spine = Material(plain(random_color(rng, 0.1, 0.85), int(rng.integers(4)) + 116, 0.05), 0.5)
            if rng.random() < 0.85:
                static.append(
                    slab((thick, tall, 0.2), (x + 0.5 * thick, -0.095 - 0.42 * row - 0.5 * tall, 2.06), spine)
                )
            x += thick + 0.002
    iron = Material(plain((0.15, 0.15, 0.16), 120), 0.5)
    shade = Material(plain((0.9, 0.84, 0.7), 121, 0.02), 0.6, leafy=True)
    static += [
        pole((-2.35, 0, 1.9), (-2.35, -1.5, 1.9), 0.012, iron),
        lathe([(0, 0), (0.15, 0), (0.15, -0.02), (0, -0.02)], (-2.35, 0, 1.9), iron),
    ]
    static += [lathe([(0, -1.4), (0.2, -1.38), (0.13, -1.68), (0, -1.68)], (-2.35, 0.0, 1.9), shade)]
    fur = Material(spots((0.2, 0.14, 0.09), (0.62, 0.47, 0.32), 122, 8, 0.75, 0.5, 2), 0.5)
    # A door in the left wall swings open before a dark hall.
    white, hall = Material(plain((0.88, 0.87, 0.84), 123), 1.5), Material(plain((0.16, 0.15, 0.14), 124, 0.1), 2.0)
    static.append(slab((0.02, 2.02, 0.86), (-3.6, -1.01, 1.42), hall))
    static += [slab((0.1, 2.1, 0.07), (-3.6, -1.05, z), white) for z in (0.96, 1.88)]
    static.append(slab((0.1, 0.08, 0.99), (-3.6, -2.06, 1.42), white))
    leaf_of = [slab((0.04, 2.0, 0.84), (0.0, -1.01, -0.42), white), slab((0.1, 0.02, 0.12), (0.0, -1.0, -0.75), iron)]
    leaf_of += [slab((0.05, 0.6, 0.56), (0.0, y, -0.42), white) for y in (-0.55, -1.45)]

    def door(time: float) -> FloatArray:
        return frame_of((-3.57, 0.0, 1.85), turn_y(-0.15 - 0.95 * float(smooth((time - 0.3) / 1.5))))

    things = [
        Thing.rigid(leaf_of, door),
        four_legged(fur, straight((1.2, 0.5), (-2.0, 0.3)), 0.55, 0.24, False, 0.0, 1.0),
    ]

    def path(time: float) -> FloatArray:
        x = -1.3 + 0.85 * time
        return looking((x, -1.45, -2.1 + 0.05 * time), (0.55 * x - 0.1, -1.08, 1.6))

    lamps = ((-0.5, -2.5, 0.2), (1.9, -2.5, -1.0))
    light = Light(lamps=lamps, lamp_color=(2.6, 2.4, 2.1), ambient_up=_FROM_ABOVE, ambient_down=_FROM_BELOW)
    return World(
        "living_room", static, things, Unrest(41, step_hz=1.7, step_m=0.012).on(path), light, focal_px=480.0, fps=24.0,
        frames=60, exposure_s=1 / 50, noise=0.015, gain=1.5, seed=4, tags=("plain walls", "sideways", "indoor"),
    )  # fmt: skip
