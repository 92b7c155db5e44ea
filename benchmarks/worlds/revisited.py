"""Places of other worlds, seen by other cameras, with others who move: nothing was chosen by these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.worlds.animals import four_legged
from benchmarks.worlds.cameras import Unrest, looking
from benchmarks.worlds.crowds import market
from benchmarks.worlds.film import World
from benchmarks.worlds.outdoors import drone, park_dog
from benchmarks.worlds.people import look, straight, walker
from benchmarks.worlds.rooms import living_room
from benchmarks.worlds.streets import street_walk
from benchmarks.worlds.surface import Material
from benchmarks.worlds.textures import spots
from uni4d_fg.arrays import FloatArray


def selfie() -> World:
    """Return somebody who walks along a street with a camera before his chest; another one walks away."""
    things = [
        walker(look(61), straight((0.28, 23.25), (0.28, 0.0)), 1.1),
        walker(look(62), straight((-1.1, 31.0), (-1.1, 60.0)), 1.2),
    ]

    def path(time: float) -> FloatArray:
        z = 22.0 - 1.1 * time
        return looking((0.1, -1.6, z), (0.15, -1.5, z + 12.0))

    return replace(
        street_walk(), name="selfie", things=things, camera=Unrest(111, step_hz=1.8).on(path), focal_px=600.0, fps=24.0,
        seed=21, tags=("near", "goes along", "panes"),
    )  # fmt: skip


def follow() -> World:
    """Return a walk behind somebody who keeps his distance, cut off by the lower border."""

    def path(time: float) -> FloatArray:
        z = -3.0 + 1.35 * time
        return looking((0.3 - 0.1 * time, -1.55, z), (-0.2, -1.2, z + 6.0))

    return replace(
        park_dog(), name="follow", things=[walker(look(63), straight((0.0, -0.2), (-0.6, 20.0)), 1.35)],
        camera=Unrest(113, step_hz=1.8).on(path), focal_px=680.0, seed=22, tags=("forward", "goes along", "grass"),
    )  # fmt: skip


def runner() -> World:
    """Return a ride sideways beside somebody who runs before trees."""

    def path(time: float) -> FloatArray:
        x = -5.0 + 2.9 * time
        return looking((x + 0.3, -1.45, 2.0), (x + 0.5, -1.1, 7.0))

    return replace(
        park_dog(), name="runner", things=[walker(look(65), straight((-5.2, 6.2), (20.0, 6.6)), 2.9, 0.0, 0.95)],
        camera=Unrest(119, step_hz=2.6, step_m=0.03).on(path), focal_px=650.0, frames=56, seed=25,
        tags=("sideways", "goes along", "leaves"),
    )  # fmt: skip


def tripod() -> World:
    """Return a market from a tripod: no camera motion tells depth."""

    def path(time: float) -> FloatArray:
        return looking((0.1, -1.6, -0.6), (0.1, -1.42, 6.0))

    unrest = Unrest(115, sway_m=0.0005, sway_deg=0.02, tremor_deg=0.01)
    return replace(market(), name="tripod", camera=unrest.on(path), seed=23, tags=("no parallax", "crowd"))


def arc_car() -> World:
    """Return an arc of 95 degrees around a parked car; nothing moves, and much of it mirrors."""

    def path(time: float) -> FloatArray:
        angle = np.deg2rad(-150.0 + 38.0 * time)
        return looking((2.75 + 4.2 * np.sin(angle), -1.5, 14.4 + 4.2 * np.cos(angle)), (2.75, -0.7, 14.4))

    return replace(
        street_walk(), name="arc_car", things=[], camera=Unrest(117, step_hz=1.7).on(path), focal_px=640.0, fps=24.0,
        seed=24, tags=("nothing moves", "panes", "arc"),
    )  # fmt: skip


def big_dog() -> World:
    """Return a room from near by with a dog that walks in a circle, and a door that opens."""
    world = living_room()
    fur = Material(spots((0.12, 0.1, 0.08), (0.75, 0.66, 0.52), 122, 8, 0.75, 0.5, 2), 0.6)

    def around(s: float) -> FloatArray:
        angle = s / 0.75
        return np.array([0.2 + 0.75 * np.cos(angle), 0.0, -0.1 + 0.45 * np.sin(angle)])

    def path(time: float) -> FloatArray:
        x = 1.3 - 0.7 * time
        return looking((x, -1.35, -2.25 + 0.1 * time), (0.3 * x + 0.1, -0.75, 0.6))

    return replace(
        world, name="big_dog", things=[world.things[0], four_legged(fur, around, 0.8, 0.5, False, 0.0, 0.9)],
        camera=Unrest(121, step_hz=1.5, step_m=0.012).on(path), focal_px=520.0, seed=26,
        tags=("plain walls", "dog", "turns"),
    )  # fmt: skip


def helix() -> World:
    """Return roofs from a drone that goes around them while it sinks."""
    middle = np.array([3.0, 0.0, 52.0])

    def path(time: float) -> FloatArray:
        angle = np.deg2rad(20.0 + 22.0 * time)
        return looking(middle + np.array([30 * np.sin(angle), 3.0 * time - 30.0, -30 * np.cos(angle)]), middle)

    unrest = Unrest(123, sway_m=0.03, sway_deg=0.25, tremor_deg=0.015)
    return replace(drone(), name="helix", camera=unrest.on(path), frames=48, seed=27, tags=("arc", "small things"))
