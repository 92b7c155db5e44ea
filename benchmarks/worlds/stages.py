"""Worlds around people who move fast: two dancers, and a skater."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.cameras import Unrest, looking
from benchmarks.worlds.film import World
from benchmarks.worlds.people import Look, Pose, body, look, posed, standing
from benchmarks.worlds.props import bench, curtain, lamp_post
from benchmarks.worlds.rooms import room
from benchmarks.worlds.shading import Light
from benchmarks.worlds.stage import Thing
from benchmarks.worlds.surface import Material, Piece, frame_of, pole, slab, turn_y
from benchmarks.worlds.textures import bricks, cloth, painted, plain, spots, wood
from benchmarks.worlds.vehicles import skateboard
from uni4d_fg.arrays import FloatArray


def dancers() -> World:
    """Return two people who dance in place before a curtain; the camera goes around them on an arc."""
    wall = Material(plain((0.62, 0.58, 0.55), 151), 3.0)
    floor = Material(wood((0.46, 0.3, 0.16), (0.7, 0.52, 0.33), 152, 8), 1.4, mirror=0.03)
    static = room((-6.0, 6.0), (-5.5, 3.6), 4.2, wall, floor)
    velvet = Material(cloth((0.42, 0.08, 0.1), (0.42, 0.08, 0.1), "weave", 8, 153), 1.2)
    static.append(curtain((-4.2, -0.02, 3.2), (4.2, -0.02, 3.2), -3.7, velvet, 34, 0.09, 154))
    rod = Material(plain((0.55, 0.45, 0.2), 155, 0.05), 0.5, mirror=0.1)
    static.append(pole((-4.4, -3.72, 3.2), (4.4, -3.72, 3.2), 0.035, rod))
    case = Material(spots((0.08, 0.08, 0.08), (0.16, 0.16, 0.16), 156, 64), 0.4)
    grille = Material(bricks((0.16, 0.16, 0.17), (0.2, 0.2, 0.2), (0.03, 0.03, 0.03), 32, 32, 157, 0.5, 0.35, 0.1), 0.4)
    for x in (-3.6, 3.5):
        static += [slab((0.55, 1.3, 0.5), (x, -0.65, 2.6), case), slab((0.45, 1.1, 0.02), (x, -0.65, 2.345), grille)]
    chair = Material(wood((0.3, 0.18, 0.1), (0.5, 0.32, 0.18), 158, 4), 0.5)
    for x, yaw in ((-2.5, 2.6), (2.3, 3.5), (1.7, 3.2)):
        parts = [slab((0.42, 0.04, 0.42), (0, -0.45, 0), chair), slab((0.42, 0.3, 0.03), (0, -0.75, -0.2), chair)]
        parts += [slab((0.04, 0.45, 0.04), (a, -0.22, b), chair) for a in (-0.18, 0.18) for b in (-0.18, 0.18)]
        parts += [slab((0.04, 0.45, 0.03), (a, -0.68, -0.2), chair) for a in (-0.18, 0.18)]
        static += [part.moved((x, 0.0, 2.4), yaw) for part in parts]
    static.append(slab((0.02, 0.9, 1.4), (-5.98, -1.8, 0.5), Material(painted(159, strokes=20), 1.4)))
    things = [
        standing(look(21), (-0.62, 0.35), np.pi + 0.35, 160, 0.42, 0.16, 1.9),
        standing(look(24), (0.66, 0.15), np.pi - 0.45, 162, 0.42, 0.13, 2.1),
    ]

    def path(time: float) -> FloatArray:
        angle = np.deg2rad(-13.0 + 10.5 * time)
        return looking((3.7 * np.sin(angle), -1.5, 0.4 - 3.7 * np.cos(angle)), (0.0, -1.02, 0.5))

    light = Light(lamps=((-2.5, -4.0, -1.5), (2.8, -4.0, -0.5)), lamp_color=(6.0, 5.4, 4.8), lamp_radius_m=0.25,
                  ambient_up=(0.3, 0.28, 0.27), ambient_down=(0.24, 0.2, 0.17))  # fmt: skip
    return World(
        "dancers", static, things, Unrest(71, sway_deg=0.35).on(path), light, focal_px=640.0, fps=30.0, frames=70,
        exposure_s=1 / 60, noise=0.014, gain=1.3, kbps=2500, seed=7, tags=("people in place", "arc", "folds"),
    )  # fmt: skip


def _skater(style: Look, start_x: float, z: float, speed: float) -> Thing:
    """Return somebody on a skateboard who goes along +x, sideways to his board, with arms that balance."""
    pieces, frame = body(style)
    board = skateboard()

    def poses(time: float) -> FloatArray:
        x = start_x + speed * time
        place = np.array([x, 0.0, z])
        sway, crouch = 0.1 * np.sin(3.1 * time), 0.16 + 0.05 * np.sin(2.3 * time)
        feet = place + np.array([[-0.2, -0.112, 0.02], [0.2, -0.112, 0.02]])
        pelvis = place + np.array([0.02 * np.sin(4 * time), -0.112 - 0.93 + crouch, 0.06])
        hands = np.array([[-0.42 + sway, 0.1 + sway, 0.08], [0.4 + sway, 0.08 - sway, 0.16]])
        # He faces the camera (-z), so his left is to the right of the image.
        person = posed(Pose(pelvis, np.pi, feet[::-1], hands, (0.0, 0.0), (0.28, 0.5 * sway), -0.7))
        return np.concatenate((person, frame_of(place, turn_y(0.5 * np.pi))[None]))

    return Thing([*pieces, *board], [*frame, *([16] * len(board))], poses)


def skate() -> World:
    """Return a skater who passes near by and fast; the camera turns with him and hardly goes anywhere."""
    ground = Material(spots((0.34, 0.33, 0.32), (0.55, 0.54, 0.52), 171, 16, 0.9, 0.2), 3.0, macro=0.05)
    strip = Material(bricks((0.5, 0.48, 0.46), (0.6, 0.58, 0.55), (0.3, 0.29, 0.28), 3, 6, 172, 0.5, 0.03, 0.06), 2.4)
    static: list[Piece] = [
        slab((60.0, 0.2, 40.0), (0.0, 0.1, 5.0), ground),
        slab((60.0, 0.24, 1.6), (0.0, 0.06, 5.1), strip),
        slab((60.0, 1.0, 0.3), (0.0, -3.1, 6.15), Material(spots((0.55, 0.53, 0.5), (0.7, 0.68, 0.64), 173, 8), 2.0)),
        slab(
            (60.0, 12.0, 6.0),
            (0.0, -3.0, 16.0),
            Material(bricks((0.5, 0.22, 0.15), (0.64, 0.36, 0.24), (0.6, 0.57, 0.52), seed=174), 1.76),
        ),
    ]
    for i in range(8):
        art = Material(painted(930 + i, (0.66, 0.64, 0.6), 45, 12), 3.0)
        static.append(slab((3.0, 2.6, 0.3), (-10.5 + 3.0 * i, -1.3, 6.15), art))
    gray = Material(plain((0.7, 0.69, 0.66), 175, 0.02), 2.0)
    static += [slab((18.0, 2.6, 0.3), (x, -1.3, 6.16), gray) for x in (-21.0, 22.5)]
    dark = Material(plain((0.1, 0.12, 0.15), 176, 0.1), 1.0, mirror=0.3)
    static += [slab((1.3, 1.7, 0.1), (-18.0 + 3.0 * i, -5.8, 13.0), dark) for i in range(13)]
    static += lamp_post((-4.6, 5.4), 4.0) + lamp_post((5.2, 5.4), 4.0) + bench((1.2, 5.5), np.pi, 4)
    iron = Material(plain((0.15, 0.16, 0.17), 177, 0.1), 0.5)
    static += [pole((-8.0 + 1.6 * i, 0, 4.3), (-8.0 + 1.6 * i, -0.8, 4.3), 0.04, iron) for i in range(3)]
    static += [slab((0.6, 0.9, 0.6), (3.6, -0.45, 5.3), Material(painted(940, (0.2, 0.3, 0.25), 10, 3), 1.0))]
    things = [_skater(look(31), -4.3, 2.7, 5.6), standing(look(33), (-1.6, 5.0), np.pi, 178, 0.25)]

    def path(time: float) -> FloatArray:
        x = -4.3 + 5.6 * (time - 0.03)
        return looking((-0.15 + 0.19 * time, -1.45, 0.0), (0.94 * x, -0.95, 2.9))

    return World(
        "skate", static, things, Unrest(81, sway_deg=0.5).on(path), Light((-0.3, -0.7, -0.5)), focal_px=600.0, fps=30.0,
        frames=48, exposure_s=1 / 50, samples=6, seed=8, kbps=3500, tags=("fast pan", "motion blur"),
    )  # fmt: skip
