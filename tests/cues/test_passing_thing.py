"""A large thing that passes a camera that only turns is not taken for the world."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from cues.start_scenes import GUESS, SIZE, K, observed

from uni4d_fg.config.load import load_config
from uni4d_fg.cues.structure import search
from uni4d_fg.cues.structure.first_pair import stands_still
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.motion import structure_from_motion
from uni4d_fg.cues.structure.passing_thing import explains_more, most_left_over, only_seems_to_turn
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, unproject, world_to_camera
from uni4d_fg.progress import SilentReporter
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.stages.observations import Observations

CONFIG = load_config("default", [])
FRAMES, BUS = 40, 300
PASSED = 5.0
"""How far the bus goes, m."""


class Street(NamedTuple):
    """What a camera held by hand before a street sees."""

    observations: Observations
    world_T_cam: np.ndarray
    bus_T_cam: np.ndarray
    """Cameras, seen from the bus."""


def passing(seed: int, points: int = 800, sway: float = 0.11, turn: float = 0.06, cabin: bool = False) -> Street:
    """A street 6 to 16 m away, and a bus 4 m away that passes.

    Args:
        seed: Of points and noise.
        points: Number of those of the street.
        sway: How far the camera moves up and down, m.
        turn: How far it turns, rad.
        cabin: What is seen beside the bus is fixed to the camera.
    """
    rng = np.random.default_rng(seed)
    part = np.linspace(0.0, 1.0, FRAMES)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 1, 3] = sway * np.sin(9 * part)
    poses[:, :3, :3] = se3.so3_exp(turn * np.stack([0.3 * np.sin(8 * part), part, 0.1 * np.sin(6 * part)], axis=1))
    street = unproject(K, rng.uniform((-20, 0), (340, 240), (points, 2)), rng.uniform(6.0, 16.0, points))
    bus = rng.uniform((-8.0, -0.6, 4.0), (0.5, 0.6, 4.4), (BUS, 3))
    seen_from_bus = poses.copy()
    seen_from_bus[:, 0, 3] -= PASSED * part
    rows = []
    for frame in range(FRAMES):
        beside = world_to_camera(np.eye(4) if cabin else poses[frame], street)
        uv = project(K, np.concatenate([beside, world_to_camera(seen_from_bus[frame], bus)]))
        uv += rng.normal(0, 0.15, uv.shape)
        seen = np.flatnonzero((uv > 0).all(axis=1) & (uv[:, 0] < SIZE[1]) & (uv[:, 1] < SIZE[0]))
        rows.append((seen, np.full(len(seen), frame), uv[seen]))
    return Street(observed(rows).with_min_observations(5), poses, seen_from_bus)


def scene_at(street: Street, world_T_cam: np.ndarray) -> GrowingScene:
    """Return what cameras make of all tracks."""
    scene = GrowingScene.empty(
        street.observations, FRAMES, K, CONFIG, free_focal=True, prior_intrinsics=GUESS, should_stop=lambda: False
    )
    scene.world_T_cam, scene.registered[:] = world_T_cam.copy(), True
    scene.triangulate_all()
    scene.limit_px[:] = 0.7
    return scene


def is_passing(street: Street, world_T_cam: np.ndarray, known_focal: bool = False) -> bool:
    """Judge cameras that see the street."""
    rest = most_left_over(scene_at(street, world_T_cam), street.observations, SIZE)
    intrinsics = K if known_focal else GUESS
    return rest is not None and only_seems_to_turn(
        rest, FRAMES, intrinsics, CONFIG.geometric_depth, known_focal=known_focal
    )


@pytest.mark.parametrize("known_focal", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_cameras_of_what_passes_are_told_from_those_of_the_world(seed: int, known_focal: bool) -> None:
    street = passing(seed)
    assert is_passing(street, street.bus_T_cam, known_focal)
    assert not is_passing(street, street.world_T_cam, known_focal)


def test_a_street_that_shows_parallax_leads_to_cameras_of_its_own() -> None:
    street = passing(0, sway=0.8)
    assert not is_passing(street, street.bus_T_cam)


def test_what_is_fixed_to_the_camera_is_not_the_world() -> None:
    """Outside a cabin that hides most of it, the world passes: that the cabin does not turn tells them apart."""
    cabin = passing(0, cabin=True)
    assert not is_passing(cabin, cabin.bus_T_cam)


@pytest.mark.parametrize("points", [300, 800])
def test_what_passes_a_camera_on_a_tripod_is_not_the_world(points: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of what is seen is a bus, and has parallax; the rest stays where it is. No scene is grown of it."""
    tripod = passing(0, points=points, sway=0.0, turn=0.0)
    monkeypatch.setattr(search.Search, "_grown_best", lambda *_: pytest.fail("scenes without baseline converge slowly"))
    settings, still = CONFIG.geometric_depth, tripod.observations.track < points
    assert stands_still(tripod.observations.select(still), FRAMES, settings)
    assert not stands_still(tripod.observations.select(~still), FRAMES, settings)
    observations = tripod.observations
    assert structure_from_motion(observations, FRAMES, SIZE, GUESS, CONFIG, SilentReporter(), lambda: False) is None


def test_what_most_of_the_tracks_agree_with_is_the_world() -> None:
    street = passing(0, points=150)
    assert not is_passing(street, street.bus_T_cam)


def test_what_a_thing_leaves_over_is_the_world_if_it_explains_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start from what passes may win: then the scene that is grown from the rest is taken."""
    street = passing(0, sway=0.8)
    of_bus, of_street = (scene_at(street, poses) for poses in (street.bus_T_cam, street.world_T_cam))
    assert explains_more(of_street, of_bus, street.observations, SIZE)
    assert not explains_more(of_bus, of_street, street.observations, SIZE)
    grown = search.Search._grown

    def bus_first(one: search.Search, used: Observations, intrinsics: np.ndarray, free: bool) -> object:
        found = grown(one, used, intrinsics, free)
        return found if found is None or len(used) < len(street.observations) else replace(found, scene=of_bus)

    monkeypatch.setattr(search.Search, "_grown", bus_first)
    config = load_config("default", ["input.intrinsics=fixed", f"geometric_depth.max_tracks={10**6}"])
    found = structure_from_motion(street.observations, FRAMES, SIZE, K, config, SilentReporter(), lambda: False)
    assert found is not None
    right = evaluate_trajectory(found.world_T_cam, street.world_T_cam)
    assert right.ate_m < 0.01 * np.ptp(street.world_T_cam[:, 1, 3])
    assert evaluate_trajectory(found.world_T_cam, street.bus_T_cam).ate_m > 10 * right.ate_m


def test_a_rest_that_cannot_be_solved_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    street = passing(0, sway=0.8)
    grown = search.Search._grown

    def failing(one: search.Search, used: Observations, intrinsics: np.ndarray, free: bool) -> object:
        if len(used) < len(street.observations):
            raise SolverError("singular")
        return grown(one, used, intrinsics, free)

    monkeypatch.setattr(search.Search, "_grown", failing)
    monkeypatch.setattr(search, "most_left_over", lambda scene, used, size: used.select(used.frame < FRAMES - 1))
    config = load_config("default", [f"geometric_depth.max_tracks={10**6}"])
    assert structure_from_motion(street.observations, FRAMES, SIZE, GUESS, config, SilentReporter(), lambda: False)


@pytest.mark.slow
def test_without_another_scene_the_camera_only_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    street = passing(0, sway=0.6)

    def found() -> object:
        return structure_from_motion(street.observations, FRAMES, SIZE, GUESS, CONFIG, SilentReporter(), lambda: False)

    assert found() is not None
    monkeypatch.setattr(search, "most_left_over", lambda scene, used, size: used)
    monkeypatch.setattr(search, "explains_more", lambda *_: False)
    assert found() is not None
    monkeypatch.setattr(search, "only_seems_to_turn", lambda *_, **__: True)
    assert found() is None
