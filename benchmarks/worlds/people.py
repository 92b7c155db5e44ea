"""People of rounded limbs: they walk with feet that do not slide, or stand and move arms and legs.

A person at rest faces +z, has x to the right and stands on y = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.cameras import smooth, wander
from benchmarks.worlds.stage import Thing
from benchmarks.worlds.surface import Material, Piece, along, ball, frame_of, limb, slab, turn_x, turn_y
from benchmarks.worlds.textures import Color, cloth, plain, random_color, scaled, spots
from uni4d_fg.arrays import FloatArray

Path = Callable[[float], FloatArray]
"""Maps meters walked to a place (3,) on the ground; between steps where there are stairs."""
Ground = Callable[[float, float], float]
"""Maps x and z to the height y of the ground, meters."""

_THIGH, _SHIN, _UPPER_ARM, _FOREARM = 0.45, 0.45, 0.29, 0.26
_ANKLE, _HIP, _TORSO = 0.08, 0.93, 0.50
_HIP_SIDE, _SHOULDER_SIDE, _SHOULDER_DROP = 0.095, 0.20, 0.07


@dataclass(frozen=True)
class Look:
    """Clothes and size."""

    shirt: Material
    trousers: Material
    skin: Color = (0.78, 0.58, 0.46)
    hair: Color = (0.16, 0.11, 0.08)
    height: float = 1.0
    """Factor of a height of 1.75 m."""


def look(seed: int) -> Look:
    """Return random clothes: some plain, some with a pattern."""
    rng = np.random.default_rng(1000 + seed)
    first, second = (random_color(rng, 0.08, 0.85) for _ in range(2))
    kind = str(rng.choice(["weave", "stripes", "plaid", "dots"]))
    shirt = Material(cloth(first, second, kind, int(rng.integers(6, 16)), seed), 1.2)
    dark = random_color(rng, (0.06, 0.06, 0.12), (0.35, 0.35, 0.41))
    trousers = Material(cloth(dark, dark, "weave", 8, seed + 1), 1.0)
    tone = rng.uniform(0.45, 1.05)
    skin = (0.8 * tone, 0.6 * tone, 0.48 * tone)
    return Look(shirt, trousers, skin, scaled((1.0, 0.75, 0.5), rng.uniform(0.05, 0.4)), rng.uniform(0.92, 1.06))


def body(style: Look) -> tuple[list[Piece], list[int]]:
    """Return the limbs and which frame carries each: see :func:`posed` for the order of frames."""
    shirt, trousers = style.shirt, style.trousers
    skin = Material(spots(style.skin, scaled(style.skin, 0.9), 3, 8, 0.7, 0.12), 0.5)
    hair = Material(spots(style.hair, scaled(style.hair, 1.6), 4, 32, 0.9, 0.3, 8), 0.4)
    shoe = Material(plain((0.12, 0.11, 0.12), 5, 0.05), 0.5)
    parts: list[tuple[int, Piece]] = [
        (0, limb(0.08, 0.15, 0.14, trousers, 0.68).moved((0.0, -0.07, 0.0))),
        (1, limb(0.40, 0.15, 0.195, shirt, 0.62)),
        (1, limb(0.10, 0.16, 0.08, shirt, 0.7).moved((0.0, 0.42, 0.0))),
        (2, limb(0.16, 0.06, 0.055, skin)),
        (3, ball(0.105, (0.0, 0.0, 0.0), skin, (0.82, 1.15, 0.95))),
        (3, ball(0.112, (0.0, -0.025, -0.018), hair, (0.86, 1.08, 0.92))),
        (3, ball(0.02, (0.0, 0.02, 0.105), skin, (0.8, 1.4, 1.0))),
        *((3, ball(0.012, (side * 0.034, -0.012, 0.096), shoe)) for side in (-1, 1)),
    ]
    for side in (0, 1):
        parts += [
            (4 + side, limb(_UPPER_ARM, 0.052, 0.042, shirt)),
            (6 + side, limb(_FOREARM, 0.043, 0.032, skin)),
            (8 + side, limb(0.09, 0.035, 0.04, skin, 0.6)),
            (10 + side, limb(_THIGH, 0.095, 0.062, trousers)),
            (12 + side, limb(_SHIN - 0.02, 0.06, 0.045, trousers)),
            (14 + side, slab((0.095, 0.055, 0.26), (0.0, _ANKLE - 0.0275, 0.055), shoe)),
            (
                14 + side,
                limb(0.13, 0.05, 0.042, shoe).placed(along((0.0, 0.03, -0.03), (0.0, 0.045, 0.12), (0, -1, 0))),
            ),
        ]
    return [piece for _, piece in parts], [frame for frame, _ in parts]


def bent(
    start: FloatArray, target: FloatArray, first: float, second: float, hint: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the joint and the end of two bones from ``start`` to ``target``; the joint lies towards ``hint``."""
    way = target - start
    far = float(np.linalg.norm(way))
    reach = min(max(far, abs(first - second) + 0.02), 0.999 * (first + second))
    unit = way / max(far, 1e-9)
    on = (first**2 - second**2 + reach**2) / (2 * reach)
    off = np.sqrt(max(first**2 - on**2, 0.0))
    aside = hint - (hint @ unit) * unit
    aside /= max(float(np.linalg.norm(aside)), 1e-9)
    return start + on * unit + off * aside, start + reach * unit


@dataclass(frozen=True)
class Pose:
    """Where the ends of a body are."""

    pelvis: FloatArray
    """(3,) middle of the hips, meters."""
    yaw: float
    """Where the body faces, rad."""
    feet: FloatArray
    """(2, 3) points on the ground below the ankles, left first, meters."""
    hands: FloatArray
    """(2, 3) relative to the shoulders, along right, down and forward, meters at height 1."""
    pitch: tuple[float, float] = (0.0, 0.0)
    """By how much toes point down, rad."""
    lean: tuple[float, float] = (0.03, 0.0)
    """Lean of the trunk to the front and to the right, rad."""
    head: float = 0.0
    """Turn of the head to the right, rad."""
    height: float = 1.0


def posed(pose: Pose) -> FloatArray:
    """Return the frames (16, 4, 4) of a body's parts.

    They are pelvis, trunk, neck, head, then left and right of upper arms, forearms, hands, thighs, shins and feet.
    """
    k = pose.height
    turn = turn_y(pose.yaw)
    right, down, front = turn.T
    frames = np.empty((16, 4, 4))
    up = np.array([np.sin(pose.lean[1]), -1.0, np.sin(pose.lean[0])])
    up = turn @ (up / np.linalg.norm(up))
    chest = pose.pelvis + k * _TORSO * up
    frames[0] = frame_of(pose.pelvis, turn)
    frames[1] = along(pose.pelvis, chest, front)
    frames[2] = along(chest, chest + up, front)
    frames[3] = frame_of(chest + k * 0.21 * up + 0.01 * front, turn_y(pose.yaw + pose.head))
    for i, side in enumerate((-1.0, 1.0)):
        shoulder = chest - k * _SHOULDER_DROP * up + side * k * _SHOULDER_SIDE * right
        reach = k * (turn @ pose.hands[i])
        elbow, wrist = bent(
            shoulder, shoulder + reach, k * _UPPER_ARM, k * _FOREARM, -0.7 * front + 0.5 * side * right + 0.4 * down
        )
        frames[4 + i], frames[6 + i] = along(shoulder, elbow, front), along(elbow, wrist, front)
        frames[8 + i] = along(wrist, 2 * wrist - elbow, front)
        hip = pose.pelvis + side * k * _HIP_SIDE * right
        ankle = pose.feet[i] + [0.0, -k * _ANKLE, 0.0]
        knee, ankle = bent(hip, ankle, k * _THIGH, k * _SHIN, front + 0.08 * side * right)
        frames[10 + i], frames[12 + i] = along(hip, knee, front), along(knee, ankle, front)
        frames[14 + i] = frame_of(ankle, turn @ turn_x(pose.pitch[i]))
    frames[:, :3, :3] *= k
    return frames


def straight(start: tuple[float, float], end: tuple[float, float]) -> Path:
    """Return the path from one (x, z) towards another on flat ground."""
    a, b = np.array([start[0], 0.0, start[1]]), np.array([end[0], 0.0, end[1]])
    unit = (b - a) / np.linalg.norm(b - a)
    return lambda s: a + s * unit


def heading(path: Path, s: float, reach: float = 0.05) -> float:
    """Return the yaw, rad, of a path between ``reach`` meters before and after a place on it."""
    ahead = path(s + reach) - path(s - reach)
    return float(np.arctan2(ahead[0], ahead[2]))


def flat(x: float, z: float) -> float:
    """Return the height of flat ground."""
    return 0.0


def walker(
    style: Look, path: Path, speed: float, start_s: float = 0.0, step_m: float = 0.62, ground: Ground = flat,
    swing: float = 0.5,
) -> Thing:  # fmt: skip
    """Return somebody who walks along a path.

    Args:
        style: Clothes.
        path: Where to.
        speed: Meters per second.
        start_s: Seconds already walked at time 0.
        step_m: Length of a step.
        ground: Height of what feet stand on.
        swing: Amplitude of the arms, rad.
    """
    k = style.height
    pieces, frame = body(style)

    def poses(time: float) -> FloatArray:
        s = speed * (time + start_s)
        yaw = heading(path, s)
        right = turn_y(yaw)[:, 0]
        feet, pitch = np.empty((2, 3)), [0.0, 0.0]
        for i, side in enumerate((-1.0, 1.0)):
            offset = step_m * i
            planted = np.floor((s - offset + 0.5 * step_m) / (2 * step_m)) * 2 * step_m + offset
            # The foot stands while the body passes over it, and swings while the other one stands.
            share = float(np.clip((s - planted - 0.5 * step_m) / step_m, 0.0, 1.0))
            ends = []
            for place in (planted, planted + 2 * step_m):
                point = path(place) + side * k * _HIP_SIDE * right
                point[1] = ground(point[0], point[2])
                ends.append(point)
            feet[i] = ends[0] + smooth(share) * (ends[1] - ends[0])
            feet[i, 1] -= 0.09 * np.sin(np.pi * share) + 0.5 * share * (1 - share) * abs(ends[1][1] - ends[0][1])
            pitch[i] = 0.6 * float(np.sin(np.pi * share)) * (1 - 1.6 * share)
        phase = np.pi * s / step_m
        pelvis = path(s) + np.array([0.0, -k * _HIP + 0.018 - 0.018 * np.cos(2 * phase), 0.0])
        pelvis += 0.015 * np.cos(phase) * -right
        angle = swing * np.sin(phase - 0.5 * np.pi) * np.array([-1.0, 1.0]) + 0.1
        hands = np.stack((0.05 * np.array([-1.0, 1.0]), 0.52 * np.cos(angle), 0.52 * np.sin(angle)), axis=-1)
        return posed(Pose(pelvis, yaw, feet, hands, (pitch[0], pitch[1]), height=k))

    return Thing(pieces, frame, poses)


def standing(
    style: Look, place: tuple[float, float], yaw: float, seed: int, arms: float = 0.35, steps: float = 0.0,
    tempo_hz: float = 0.8, ground_y: float = 0.0,
) -> Thing:  # fmt: skip
    """Return somebody who stays in place and gestures or dances.

    Args:
        style: Clothes.
        place: x and z, meters.
        yaw: Where to face, rad.
        seed: Seed of the movements.
        arms: How far hands move, meters.
        steps: How high feet are lifted in turn, meters; 0 for somebody who just stands.
        tempo_hz: Beats per second.
        ground_y: Height of the ground, meters.
    """
    k = style.height
    pieces, frame = body(style)
    arm = wander(seed, 0.5 * tempo_hz, 1.2 * tempo_hz, 6, 4)
    turn = wander(seed + 1, 0.15 * tempo_hz, 0.5 * tempo_hz, 3, 4)
    foot = np.array([[-0.14, 0.0, 0.02], [0.14, 0.0, -0.02]])

    def poses(time: float) -> FloatArray:
        beat = np.pi * tempo_hz * time
        lift = steps * np.maximum(np.array([np.sin(beat), -np.sin(beat)]), 0.0) ** 0.7
        slow = turn(time)
        facing = yaw + 0.12 * float(slow[0]) * (1 + 3 * (steps > 0))
        feet = foot.copy()
        feet[:, 1] = -lift
        feet[:, 2] += 1.3 * lift
        feet[:, 0] += 0.4 * lift * [-1.0, 1.0]
        feet = feet @ turn_y(yaw).T + [place[0], ground_y, place[1]]
        sway = turn_y(yaw) @ np.array([-0.6 * (lift[1] - lift[0]), 0.0, 0.0])
        dip = 0.10 * steps * (1.0 - np.cos(2 * beat)) + 0.008
        pelvis = (
            np.array([place[0], ground_y - k * _HIP + dip, place[1]]) + sway + [0.01 * slow[1], 0.0, 0.01 * slow[2]]
        )
        move = arm(time).reshape(2, 3)
        hands = np.array([[-0.12, 0.22, 0.24], [0.12, 0.22, 0.24]])
        hands = hands + arms * move * [[0.5, 0.75, 0.45]]
        hands[0, 0], hands[1, 0] = min(hands[0, 0], 0.12), max(hands[1, 0], -0.12)
        # Hands stay in front of the trunk.
        hands[:, 2] = np.maximum(hands[:, 2], 0.1 - 0.4 * np.minimum(np.abs(hands[:, 0]), 0.3))
        return posed(
            Pose(pelvis, facing, feet, hands, (0.0, 0.0), (0.04, 0.06 * float(slow[1])), 0.25 * float(slow[2]), k)
        )

    return Thing(pieces, frame, poses)
