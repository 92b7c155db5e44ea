"""Dogs and cats of rounded limbs that run or walk along a path."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.people import Path, bent, heading
from benchmarks.worlds.stage import Thing
from benchmarks.worlds.surface import Material, Piece, along, ball, frame_of, limb, turn_y
from benchmarks.worlds.textures import plain
from uni4d_fg.arrays import FloatArray


def four_legged(
    coat: Material, path: Path, speed: float, height_m: float, gallop: bool, start_s: float = 0.0, tail_up: float = 0.4
) -> Thing:
    """Return an animal that runs or walks.

    Args:
        coat: Its coat.
        path: Where to, on flat ground.
        speed: Meters per second.
        height_m: Height of the shoulders.
        gallop: Whether fore and hind legs move in pairs and the back bends.
        start_s: Seconds already gone at time 0.
        tail_up: By how much the tail points up, rad.
    """
    h = height_m
    dark = Material(plain((0.05, 0.04, 0.04), 8, 0.05), 0.5)
    parts: list[tuple[int, Piece]] = [
        (0, limb(0.85 * h, 0.2 * h, 0.245 * h, coat)),
        (1, limb(0.38 * h, 0.16 * h, 0.11 * h, coat)),
        (2, ball(0.16 * h, (0.0, 0.0, 0.0), coat, (0.85, 0.85, 1.1))),
        (
            2,
            limb(0.22 * h, 0.1 * h, 0.06 * h, coat).placed(
                along((0.0, 0.03 * h, 0.08 * h), (0.0, 0.07 * h, 1.0), (0, -1, 0))
            ),
        ),
        (2, ball(0.03 * h, (0.0, 0.045 * h, 0.36 * h), dark)),
        *((2, ball(0.022 * h, (s * 0.075 * h, -0.04 * h, 0.14 * h), dark)) for s in (-1, 1)),
        *(
            (2, limb(0.15 * h, 0.055 * h, 0.02 * h, coat, 0.5).moved((s * 0.1 * h, -0.14 * h, -0.02 * h)))
            for s in (-1, 1)
        ),
        (3, limb(0.6 * h, 0.045 * h, 0.02 * h, coat)),
    ]
    for leg in range(4):
        parts += [
            (4 + leg, limb(0.36 * h, 0.1 * h, 0.055 * h, coat)),
            (8 + leg, limb(0.36 * h, 0.05 * h, 0.035 * h, coat)),
        ]
        parts += [(12 + leg, ball(0.055 * h, (0.0, -0.03 * h, 0.02 * h), coat, (1.0, 0.55, 1.3)))]
    stride = (2.4 if gallop else 1.1) * h
    phases = np.array([0.0, 0.25, 0.55, 0.8]) if gallop else np.array([0.0, 0.5, 0.25, 0.75])
    # What a paw goes back while it stands is what the body goes on: it does not slide.
    stand = 0.3 if gallop else 0.6

    def poses(time: float) -> FloatArray:
        s = speed * (time + start_s)
        turn = turn_y(heading(path, s))
        right, _, front = turn.T
        cycle = s / stride
        bound = 0.1 * h * np.sin(2 * np.pi * cycle) if gallop else 0.015 * h * np.sin(4 * np.pi * cycle)
        rock = 0.12 * np.cos(2 * np.pi * cycle) if gallop else 0.0
        middle = path(s) + np.array([0.0, -0.82 * h - bound, 0.0])
        spine = np.cos(rock) * front + np.array([0.0, np.sin(rock), 0.0])
        rump, chest = middle - 0.42 * h * spine, middle + 0.43 * h * spine
        frames = np.empty((16, 4, 4))
        frames[0] = along(rump, chest, (0.0, -1.0, 0.0))
        head = chest + h * (0.34 * front + [0.0, -0.28 + 0.3 * rock, 0.0])
        frames[1] = along(chest + np.array([0.0, -0.05 * h, 0.0]), head, front)
        frames[2] = frame_of(head, turn)
        wag = 0.5 * np.sin(2 * np.pi * 2.2 * time)
        tail = -np.cos(tail_up) * front + [0.0, -np.sin(tail_up), 0.0] + 0.5 * wag * right
        frames[3] = along(rump + np.array([0.0, -0.1 * h, 0.0]), rump + tail, right)
        for leg in range(4):
            fore, side = leg < 2, 1.0 if leg % 2 else -1.0
            hip = (chest - 0.05 * h * spine if fore else rump + 0.04 * h * spine) + side * 0.13 * h * right
            share = float(np.mod(cycle + phases[leg], 1.0))
            if share < stand:
                forth, lift = stride * (0.5 * stand - share), 0.0
            else:
                swing = (share - stand) / (1 - stand)
                forth = stride * stand * (swing - 0.5)
                lift = 0.22 * h * np.sin(np.pi * swing)
            paw = hip + forth * front
            paw[1] = path(s)[1] - lift - 0.01
            # Elbows point back, knees to the front.
            hint = -front if fore else front
            knee, paw = bent(hip, paw + np.array([0.0, -0.02 * h, 0.0]), 0.42 * h, 0.42 * h, hint)
            frames[4 + leg], frames[8 + leg] = along(hip, knee, front), along(knee, paw, front)
            frames[4 + leg][:3, 1] *= 0.42 / 0.36
            frames[8 + leg][:3, 1] *= 0.42 / 0.36
            frames[12 + leg] = frame_of(paw, turn)
        return frames

    return Thing([piece for _, piece in parts], [frame for frame, _ in parts], poses)
