"""The focal length of a camera that only turns."""

from __future__ import annotations

import numpy as np
import pytest
from cues.start_scenes import SIZE, observed
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.structure.rotation_focal import focal_of_rotations
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, unproject, world_to_camera
from uni4d_fg.slam.stages.observations import Observations

FRAMES = 24
GUESS = np.array([320.0, 320.0, 159.5, 119.5])


def turning(focal: float, turns: np.ndarray, seed: int = 0, noise_px: float = 0.2, moving: int = 0) -> Observations:
    """What a camera sees that turns by rotation vectors (T, 3); some tracks move on their own."""
    rng = np.random.default_rng(seed)
    intrinsics = np.array([focal, focal, 159.5, 119.5])
    reach = 320 + 1.2 * focal * float(np.abs(turns).max())
    points = unproject(intrinsics, rng.uniform((-reach, -reach), (320 + reach, 240 + reach), (3000, 2)), np.ones(3000))
    drift = np.zeros_like(points)
    drift[:moving] = rng.normal(0, 8.0 / focal, (moving, 3))
    rows = []
    for frame, turn in enumerate(turns):
        pose = np.eye(4)
        pose[:3, :3] = se3.so3_exp(turn[None])[0]
        uv = project(intrinsics, world_to_camera(pose, points + frame / FRAMES * drift))
        uv += rng.normal(0, noise_px, uv.shape)
        seen = np.flatnonzero((uv > 0).all(axis=1) & (uv[:, 0] < SIZE[1]) & (uv[:, 1] < SIZE[0]))
        rows.append((seen, np.full(len(seen), frame), uv[seen]))
    return observed(rows).with_min_observations(2)


def pan(degrees: float) -> np.ndarray:
    part = np.linspace(0.0, 1.0, FRAMES)
    return np.radians(np.stack([1.5 * np.sin(5 * part), degrees * part, 0.5 * np.sin(3 * part)], axis=1))


@settings(max_examples=12, deadline=None)
@given(factor=st.floats(0.6, 2.5), seed=st.integers(0, 100), moving=st.sampled_from([0, 600]))
@example(factor=2.5, seed=10, moving=600)  # 2.4 % off, the farthest that was seen
def test_a_pan_tells_the_focal_length(factor: float, seed: int, moving: int) -> None:
    focal = factor * max(SIZE)
    # Half the field of view, whatever that is.
    degrees = float(np.degrees(np.arctan(0.5 * SIZE[1] / focal)))
    observations = turning(focal, pan(degrees), seed, moving=moving)
    found = focal_of_rotations(observations, FRAMES, SIZE, GUESS, GeometricDepthConfig())
    assert found is not None
    assert found.focal == pytest.approx(focal, rel=0.03)
    assert abs(np.log(found.focal / focal)) < 3.0 * found.sigma


@pytest.mark.parametrize("degrees", [0.0, 0.05])
def test_a_camera_that_hardly_turns_tells_none(degrees: float) -> None:
    turns = pan(degrees) * (degrees > 0.0)
    turns[:, [0, 2]] = 0.0
    observations = turning(400.0, turns)
    assert focal_of_rotations(observations, FRAMES, SIZE, GUESS, GeometricDepthConfig()) is None


def test_a_turn_about_the_optical_axis_tells_none() -> None:
    turns = np.zeros((FRAMES, 3))
    turns[:, 2] = np.radians(np.linspace(0.0, 20.0, FRAMES))
    assert focal_of_rotations(turning(400.0, turns), FRAMES, SIZE, GUESS, GeometricDepthConfig()) is None


def test_two_frames_tell_too_little() -> None:
    turns = np.zeros((2, 3))
    turns[1, 1] = 0.2
    assert focal_of_rotations(turning(300.0, turns), 2, SIZE, GUESS, GeometricDepthConfig()) is None
