"""The ground: found among points, told from a table, and what interpolated depth makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.ground_plane import Ground, Plane, find_ground
from uni4d_fg.cues.interpolated_depth import InterpolatedDepths, SparseInverseDepth, ground_contact
from uni4d_fg.geometry.camera import project
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

INTRINSICS = np.array([200.0, 200.0, 159.5, 119.5])
SIZE = (240, 320)
HEIGHT = 1.5


def cameras(pitch: float = 0.2, count: int = 5) -> FloatArray:
    """Cameras that go forward 1.5 m above the ground and look down by ``pitch``; world y is down, z forward."""
    out = np.tile(np.eye(4), (count, 1, 1))
    c, s = np.cos(pitch), np.sin(pitch)
    out[:, :3, :3] = [[1, 0, 0], [0, c, s], [0, -s, c]]
    out[:, 2, 3] = 0.1 * np.arange(count)
    return out


def scene(rng: np.random.Generator, floor: int, wall: int, noise: float = 0.004) -> FloatArray:
    """Points of a floor (y = HEIGHT) from 2 to 6 m, and of a wall that stands on it at 6 m."""
    on_floor = np.stack([rng.uniform(-2, 2, floor), np.full(floor, HEIGHT), rng.uniform(2, 6, floor)], axis=1)
    on_wall = np.stack([rng.uniform(-2, 2, wall), rng.uniform(-1.5, HEIGHT, wall), np.full(wall, 6.0)], axis=1)
    points = np.concatenate([on_floor, on_wall])
    return points * (1 + rng.normal(0, noise, (len(points), 1)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("pitch", [0.0, 0.5])
def test_the_floor_is_found_beside_a_wall_with_more_points(seed: int, pitch: float) -> None:
    points = scene(np.random.default_rng(seed), 120, 500)
    plane = find_ground(points, np.linalg.norm(points, axis=1), cameras(pitch))
    assert plane is not None
    assert np.degrees(np.arccos(-plane.normal[1])) < 1.0
    assert plane.normal @ cameras()[0, :3, 3] - plane.offset == pytest.approx(HEIGHT, rel=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_a_floor_with_few_of_the_points_is_found_whatever_their_order(seed: int) -> None:
    """Seven percent, as where a room is seen over a table: of a million threes of points 360 are of the floor."""
    rng = np.random.default_rng(seed)
    clutter = rng.uniform([-2.0, -1.5, 2.0], [2.0, HEIGHT, 6.0], size=(3300, 3))
    points = np.concatenate([scene(rng, 500, 3200), clutter])[rng.permutation(7000)]
    plane = find_ground(points, np.linalg.norm(points, axis=1), cameras(0.4))
    assert plane is not None
    assert np.degrees(np.arccos(-plane.normal[1])) < 1.0
    assert plane.normal @ cameras()[0, :3, 3] - plane.offset == pytest.approx(HEIGHT, rel=0.03)


def test_a_wall_alone_has_no_ground() -> None:
    points = scene(np.random.default_rng(0), 0, 500)
    assert find_ground(points, np.linalg.norm(points, axis=1), cameras()) is None


def test_a_few_points_have_no_ground() -> None:
    points = scene(np.random.default_rng(0), 30, 0)
    assert find_ground(points, np.linalg.norm(points, axis=1), cameras()) is None


def test_a_ceiling_is_not_the_ground() -> None:
    points = scene(np.random.default_rng(0), 300, 0) * [1, -1, 1]
    assert find_ground(points, np.linalg.norm(points, axis=1), cameras()) is None


@pytest.mark.parametrize("lens", [Lens(), Lens("SIMPLE_RADIAL", (-0.1,))])
def test_inverse_depth_of_the_ground_is_that_of_its_points(lens: Lens) -> None:
    poses, camera = cameras(0.3), CameraModel(INTRINSICS, lens)
    ground = Ground(Plane(np.array([0.0, -1.0, 0.0]), -HEIGHT), poses, camera)
    points = scene(np.random.default_rng(0), 50, 0, noise=0.0)
    x = (points - poses[2, :3, 3]) @ poses[2, :3, :3]
    uv = camera.real(project(INTRINSICS, x), np.full(len(x), 2))
    np.testing.assert_allclose(ground.inverse_depth(uv, 2), 1.0 / x[:, 2], rtol=1e-6)
    above = np.array([[160.0, -400.0]])
    np.testing.assert_array_equal(Ground(ground.plane, poses, CameraModel(INTRINSICS)).inverse_depth(above, 2), 0.0)


@pytest.mark.parametrize(("below", "through"), [(0, False), (5, False), (40, True)])
def test_a_table_is_told_by_what_is_seen_beyond_it(below: int, through: bool) -> None:
    rng = np.random.default_rng(0)
    poses = cameras(0.6, 1)
    table = scene(rng, 300, 0) * [0.2, 0.3, 0.3]  # 0.45 m below the camera
    floor = scene(rng, below, 0) if below else np.zeros((0, 3))
    points = np.concatenate([table, floor])
    x = points @ poses[0, :3, :3]
    n = np.arange(len(x))
    seen = Observations(n, np.zeros(len(x), np.int64), project(INTRINSICS, x), 1.0 / x[:, 2], np.ones(len(x)))
    ground = Ground(Plane(np.array([0.0, -1.0, 0.0]), -0.3 * HEIGHT), poses, CameraModel(INTRINSICS))
    assert ground.seen_through(seen, 1.0 / x[:, 2]) is through


def test_depth_below_the_points_continues_on_the_ground_and_things_stand_there() -> None:
    poses, config = cameras(0.2, 1), GeometricDepthConfig()
    wall = scene(np.random.default_rng(0), 0, 400, noise=0.0)
    wall = wall[wall[:, 1] < 0.5]  # its lowest points are a meter above the ground
    x = wall @ poses[0, :3, :3]
    points = SparseInverseDepth(project(INTRINSICS, x), 1.0 / x[:, 2])
    ground = Ground(Plane(np.array([0.0, -1.0, 0.0]), -HEIGHT), poses, CameraModel(INTRINSICS))
    depths = InterpolatedDepths((points,), SIZE, config, ground=ground)
    row = 200
    exact = 1.0 / ground.inverse_depth(np.array([[160.0, float(row)]]), 0)[0]
    assert exact == pytest.approx(2.54, abs=0.05)
    assert depths[0][row, 160] == pytest.approx(exact, rel=0.03)
    assert InterpolatedDepths((points,), SIZE, config)[0][row, 160] > 5.0
    np.testing.assert_allclose(depths[0][60], InterpolatedDepths((points,), SIZE, config)[0][60], rtol=1e-6)
    mask = np.zeros(SIZE, np.int32)
    mask[80 : row + 1, 150:170] = 1
    assert 1.0 / ground_contact(mask, depths.static(0), config)[1] == pytest.approx(exact, rel=0.05)
