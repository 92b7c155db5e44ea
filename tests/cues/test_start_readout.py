"""A rolling shutter that tracks alone tell, before it is taken for a lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cues.start_scenes import GUESS, SIZE, K, TrackedScene

from uni4d_fg.config.load import load_config
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.motion import Structure, structure_from_motion
from uni4d_fg.cues.structure.readout import at_one_time, is_told_still
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.progress import SilentReporter
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.lens.readout_search import least_readout
from uni4d_fg.slam.lens.rolling_shutter import Axis, Readout
from uni4d_fg.slam.stages.observations import Observations

CONFIG = load_config("default", [])
FRAMES, POINTS = 24, 500


def pose_at(time: np.ndarray) -> np.ndarray:
    """A hand-held camera that moves to the right, at times (N,) in frames; (N, 4, 4)."""
    part = time / (FRAMES - 1)
    shake = [np.sin(2 * np.pi * (time / period + phase)) for period, phase in ((11.0, 0.1), (13.0, 0.4), (9.0, 0.8))]
    turn = np.stack([0.02 * part, -0.25 * part, 0.03 * part], axis=1) + 0.03 * np.stack(shake, axis=1)
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    poses[:, :3, :3] = se3.so3_exp(turn)
    poses[:, :3, 3] = part[:, None] * np.array([1.4, 0.1, 0.2]) + 0.01 * np.stack(shake[::-1], axis=1)
    return poses


def read_by(readout: Readout, seed: int = 0, noise_px: float = 0.15) -> TrackedScene:
    """What such a camera sees of a room, read row by row (or at once)."""
    rng = np.random.default_rng(seed)
    room = np.stack([rng.uniform(-4, 5, POINTS), rng.uniform(-2.5, 2.5, POINTS), rng.uniform(2.0, 7.0, POINTS)], axis=1)
    track, frame = (part.ravel() for part in np.meshgrid(np.arange(POINTS), np.arange(FRAMES), indexing="ij"))
    time = frame.astype(float)
    for _ in range(4):  # a row is read when the point is in it
        x = world_to_camera(pose_at(time), room[track])
        uv = project(K, x)
        time = frame + readout.delay(np.clip(uv, 0, (SIZE[1] - 1, SIZE[0] - 1)), SIZE)
    uv = uv + rng.normal(0, noise_px, uv.shape)
    seen = (x[:, 2] > 0.3) & (uv > 0).all(axis=1) & (uv < (SIZE[1] - 1, SIZE[0] - 1)).all(axis=1)
    count = int(seen.sum())
    observations = Observations(track[seen], frame[seen], uv[seen], np.full(count, np.nan), np.ones(count))
    return TrackedScene(
        observations.with_min_observations(3), pose_at(np.arange(FRAMES, dtype=float)), np.zeros(POINTS, bool)
    )


def found(scene: TrackedScene, any_camera: bool = True) -> tuple[Structure, float]:
    """The structure, and its turns from frame to frame against the truth, degrees."""
    structure = structure_from_motion(
        scene.observations, FRAMES, SIZE, GUESS, CONFIG, SilentReporter(), lambda: False, with_doubts=False,
        any_camera=any_camera,
    )  # fmt: skip
    assert structure is not None
    turns = evaluate_trajectory(structure.world_T_cam, scene.world_T_cam).rpe_rotation_deg
    assert turns is not None
    return structure, turns


@pytest.mark.parametrize(
    ("part", "axis"), [pytest.param(0.5, "rows", marks=pytest.mark.slow), (-0.4, "rows"), (0.5, "columns")]
)
def test_how_images_are_read_is_found_from_tracks(part: float, axis: Axis) -> None:
    scene = read_by(Readout(part, axis))
    structure, turns = found(scene)
    assert structure.readout is not None
    assert structure.readout.axis == axis
    assert structure.readout.seconds == pytest.approx(part, abs=0.06)
    assert structure.camera.lens.is_pinhole
    assert structure.intrinsics[0] == pytest.approx(K[0], rel=0.01)
    _, without = found(scene, any_camera=False)
    assert turns < min(0.4 * without, 0.03)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_images_that_are_read_at_once_are_not_taken_for_others(seed: int) -> None:
    structure, turns = found(read_by(Readout(0.0), seed))
    assert structure.readout is None
    assert turns < 0.02


@pytest.mark.slow
def test_readouts_beyond_what_a_shutter_takes_are_not_believed() -> None:
    structure, _ = found(read_by(Readout(1.6)))
    assert structure.readout is None


def test_a_search_that_cannot_be_solved_leaves_the_scene_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise SolverError("singular")

    scene = read_by(Readout(0.5))
    monkeypatch.setattr("uni4d_fg.cues.structure.search.find_readout", fails)
    structure, _ = found(scene)
    assert structure.readout is None
    plain, _ = found(scene, any_camera=False)
    assert structure.sigma_px <= 1.1 * plain.sigma_px


@pytest.mark.parametrize(("true", "is_told"), [(0.5, True), (0.0, False)])
def test_a_readout_is_asked_for_again_with_tracks_that_were_moved(
    true: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it was not there, moving the tracks has made them worse."""
    readout, grown = Readout(0.5), list[GrowingScene]()

    def taken(scene: GrowingScene, *_: object) -> None:
        grown.append(scene)

    scene = read_by(Readout(true))
    moved = at_one_time(scene.observations, readout, SIZE)
    monkeypatch.setattr("uni4d_fg.cues.structure.search.find_readout", taken)
    found(replace(scene, observations=moved))
    assert is_told_still(grown[0], moved, readout, SIZE) == is_told


@pytest.mark.parametrize("least", [0.0, 0.13, -0.47, 0.85])
def test_the_least_of_a_parabola_is_found(least: float) -> None:
    asked: list[float] = []

    def energy(part: float) -> float:
        asked.append(part)
        return (part - least) ** 2

    assert least_readout(energy) == pytest.approx(least, abs=0.02)
    assert len(set(asked)) == len(asked) <= 9


def test_the_least_lies_within_what_a_shutter_takes() -> None:
    assert least_readout(lambda part: -part) == 1.0
    assert least_readout(lambda part: part) == -1.0


def test_tracks_are_moved_along_the_parabola_of_three_frames() -> None:
    time = np.arange(6.0)
    place = np.stack([100 + 8 * time + 0.5 * time**2, 80 - 3 * time + time**2], axis=1)
    seen = np.array([0, 1, 2, 3, 5])  # the last one alone
    observations = Observations(
        np.zeros(5, int), seen, place[seen].copy(), np.full(5, np.nan), np.ones(5)
    ).with_min_observations(1)
    readout = Readout(0.5)
    delay = readout.delay(place[seen], SIZE)[:, None]
    moved = at_one_time(observations, readout, SIZE).uv
    # Seen ``delay`` after its time: with constant acceleration, where it was that long ago.
    velocity, acceleration = np.stack([8 + seen, -3 + 2 * seen], axis=1), np.array([1.0, 2.0])
    exact = place[seen] - delay * velocity + 0.5 * delay**2 * acceleration
    np.testing.assert_allclose(moved[1:3], exact[1:3], atol=1e-9)
    np.testing.assert_allclose(moved[[0, 3]], (place[seen] - delay * np.diff(place, axis=0)[[0, 1, 2, 2, 4]])[[0, 3]])
    np.testing.assert_array_equal(moved[4], place[5])
    still = replace(readout, seconds=0.0)
    np.testing.assert_array_equal(at_one_time(observations, still, SIZE).uv, place[seen])
