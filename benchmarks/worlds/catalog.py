"""All worlds by name."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.worlds import crowds, outdoors, revisited, rooms, stages, streets
from benchmarks.worlds.film import World

WORLDS: dict[str, Callable[[], World]] = {
    make.__name__: make
    for make in (
        streets.street_walk, streets.dash, rooms.table_orbit, rooms.living_room, outdoors.park_dog, outdoors.drone,
        stages.dancers, crowds.stairs_portrait, stages.skate, crowds.market, revisited.selfie, revisited.follow,
        revisited.runner, revisited.tripod, revisited.arc_car, revisited.big_dog, revisited.helix, streets.scooter,
    )
}  # fmt: skip
"""Functions that build them."""
