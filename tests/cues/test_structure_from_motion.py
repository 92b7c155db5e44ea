"""Two views, triangulation and selection of tracks on points with a known answer."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.cues.structure import triangulation
from uni4d_fg.cues.structure.selection import picture_cells, spread_tracks
from uni4d_fg.cues.structure.triangulation import RayBundle, inverse_depth_sigma, sound, triangulate
from uni4d_fg.cues.structure.two_view import fit_rotation, parallax, relative_pose
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.slam.stages.observations import Observations

K = np.array([300.0, 300.0, 159.5, 119.5])


def views(rng: np.random.Generator, second: np.ndarray, count: int = 200, noise_px: float = 0.3) -> tuple:
    """Points in front of a camera at the origin, and their pixels in it and in ``second``."""
    points = np.stack([rng.uniform(-1, 1, count), rng.uniform(-0.8, 0.8, count), rng.uniform(1.5, 4, count)], axis=1)
    uv = [
        project(K, world_to_camera(pose, points)) + rng.normal(0, noise_px, (count, 2)) for pose in (np.eye(4), second)
    ]
    return points, *uv


def moved(rotation: tuple[float, ...], translation: tuple[float, ...]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = se3.so3_exp(np.array(rotation)), translation
    return pose


def test_pure_rotation_has_no_parallax_even_with_a_wrong_focal_length(rng: np.random.Generator) -> None:
    _, first, second = views(rng, moved((0.05, 0.3, 0.02), (0.0, 0.0, 0.0)))
    wrong = K * np.array([1.3, 1.3, 1.0, 1.0])
    assert parallax(first, second, K, known_focal=True).median < 0.7
    assert parallax(first, second, wrong, known_focal=False).median < 1.0
    assert parallax(first, second, wrong, known_focal=False).upper < 1.5
    assert parallax(first, second, wrong, known_focal=True).median > 1.5


def test_translation_has_parallax(rng: np.random.Generator) -> None:
    _, first, second = views(rng, moved((0.0, 0.1, 0.0), (0.3, 0.0, 0.0)))
    assert parallax(first, second, K, known_focal=False).median > 4.0


def test_along_a_wall_only_what_stands_before_it_has_parallax(rng: np.random.Generator) -> None:
    """A camera that is moved along a wall that fills two thirds of the picture, and turned to stay with it."""
    pose = moved((0.0, 0.05, 0.0), (0.35, 0.0, 0.0))
    points, first, _ = views(rng, pose)
    wall = rng.random(len(points)) < 0.67
    points[wall] *= (6.5 / points[wall, 2])[:, None]
    second = project(K, world_to_camera(pose, points)) + rng.normal(0, 0.2, first.shape)
    found = parallax(first, second, K, known_focal=False)
    assert found.median < 2.0
    assert found.upper > 4.0


def test_rotation_is_found_among_outliers(rng: np.random.Generator) -> None:
    pose = moved((0.03, -0.1, 0.05), (0.0, 0.0, 0.0))
    _, first, second = views(rng, pose)
    second[:60] += rng.uniform(10, 40, (60, 2))
    turn = fit_rotation(first, second, K)
    assert np.degrees(np.linalg.norm(se3.so3_log((turn @ pose[:3, :3])[None]))) < 0.3


def test_relative_pose_is_found_among_outliers_and_is_repeatable(rng: np.random.Generator) -> None:
    pose = moved((0.02, 0.1, -0.03), (0.3, -0.05, 0.1))
    _, first, second = views(rng, pose)
    second[:60] = rng.uniform(0, 300, (60, 2))
    found = relative_pose(first, second, K, 1.5, 5000, 0.5)
    again = relative_pose(first, second, K, 1.5, 5000, 0.5)
    assert found is not None
    assert again is not None
    np.testing.assert_array_equal(found.first_T_second, again.first_T_second)
    error = found.first_T_second[:3, :3].T @ pose[:3, :3]
    assert np.degrees(np.linalg.norm(se3.so3_log(error[None]))) < 0.4
    direction = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    assert np.degrees(np.arccos(found.first_T_second[:3, 3] @ direction)) < 3.0
    assert found.inlier[60:].mean() > 0.9
    assert found.inlier[:60].mean() < 0.2


def test_the_pose_of_a_camera_that_moves_by_a_hundredth_of_the_distance_has_its_points(
    rng: np.random.Generator,
) -> None:
    pose = moved((0.0, 0.01, 0.0), (0.02, 0.005, 0.0))
    _, first, second = views(rng, pose, noise_px=0.05)
    found = relative_pose(first, second, K, 1.5, 5000, 0.1)
    assert found is not None
    assert found.inlier.mean() > 0.95
    far = relative_pose(first, second, K, 1.5, 5000, 0.5)  # with which few of them are near enough
    assert far is None or far.inlier.mean() < 0.25
    direction = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    assert np.degrees(np.arccos(found.first_T_second[:3, 3] @ direction)) < 10.0


def bundle(points: np.ndarray, poses: np.ndarray, uv: np.ndarray) -> RayBundle:
    """All points in all views: uv (views, points, 2)."""
    views, count = uv.shape[:2]
    row = np.tile(np.arange(count), views)
    return RayBundle(row, poses, np.repeat(np.arange(views), count), uv.reshape(-1, 2), K, count)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), baseline=st.floats(0.05, 0.5))
def test_noiseless_points_are_triangulated_exactly(seed: int, baseline: float) -> None:
    rng = np.random.default_rng(seed)
    poses = np.stack(
        [np.eye(4), moved((0.0, 0.05, 0.0), (baseline, 0.0, 0.0)), moved((0.0, 0.0, 0.0), (0.0, baseline, 0.1))]
    )
    points, _, _ = views(rng, poses[1], 30)
    uv = np.stack([project(K, world_to_camera(pose, points)) for pose in poses])
    found = triangulate(bundle(points, poses, uv), 1.0)
    np.testing.assert_allclose(found.position, points, rtol=1e-5, atol=1e-5)
    assert found.error_px.max() < 1e-3


def test_the_stated_deviation_of_inverse_depth_is_the_real_one(rng: np.random.Generator) -> None:
    poses = np.stack([np.eye(4), moved((0.0, 0.0, 0.0), (0.2, 0.0, 0.0))])
    points, _, _ = views(rng, poses[1], 1000)
    uv = np.stack([project(K, world_to_camera(pose, points)) for pose in poses]) + rng.normal(0, 0.2, (2, 1000, 2))
    found = triangulate(bundle(points, poses, uv), 1.0)
    sigma = inverse_depth_sigma(poses[0], found.position, found.information, 0.2)
    normalized = (1.0 / found.position[:, 2] - 1.0 / points[:, 2]) / sigma
    assert np.std(normalized) == pytest.approx(1.0, abs=0.1)


def test_parallel_rays_and_points_behind_are_no_points() -> None:
    poses = np.stack([np.eye(4), np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 0.2
    # Track 0 is seen twice from one place, track 1 by rays that part in front and meet behind.
    row = np.array([0, 0, 1, 1])
    uv = np.array([[100.0, 100.0], [100.0, 100.0], [150.0, 100.0], [200.0, 100.0]])
    found = triangulate(RayBundle(row, poses, np.array([0, 2, 0, 1]), uv, K, 2), 1.0)
    assert np.isnan(found.position[0]).all()
    assert not sound(found, 3.0, 1.0).any()


def test_points_come_out_alike_together_and_alone(rng: np.random.Generator) -> None:
    poses = np.stack([np.eye(4), moved((0.0, 0.05, 0.0), (0.2, 0.0, 0.0)), moved((0.02, 0.0, 0.0), (0.0, 0.2, 0.1))])
    points, _, _ = views(rng, poses[1], 40)
    uv = np.stack([project(K, world_to_camera(pose, points)) for pose in poses]) + rng.normal(0, 0.5, (3, 40, 2))
    uv[2, :4] += 40.0  # outliers, of which Huber's kernel makes less
    rays = bundle(points, poses, uv)
    found = triangulate(rays, 1.0)
    alone = np.arange(3) * 40 + 7
    single = RayBundle(np.zeros(3, np.int64), poses, rays.frame[alone], rays.uv[alone], K, 1)
    np.testing.assert_allclose(triangulate(single, 1.0).position[0], found.position[7], rtol=1e-12)
    again = np.arange(40) < 4
    replaced = found.replaced(again, triangulate(rays.select(np.repeat([True, True, False], 40)), 1.0))
    np.testing.assert_array_equal(replaced.position[4:], found.position[4:])
    distance = np.linalg.norm(replaced.position[:4] - points[:4], axis=1)
    assert (distance < np.linalg.norm(found.position[:4] - points[:4], axis=1)).all()
    none = triangulate(rays.select(np.zeros(120, dtype=bool)), 1.0)
    assert np.isnan(none.position).all()
    assert np.isnan(none.angle).all()


def test_extension_and_numpy_find_the_same_points(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    poses = np.stack([moved(tuple(rng.normal(0, 0.05, 3)), tuple(rng.normal(0, 0.3, 3))) for _ in range(7)])
    points, _, _ = views(rng, poses[1], 600)
    points[:40, 2] *= -1.0  # behind the cameras
    uv = np.stack([project(K, world_to_camera(pose, points)) for pose in poses]) + rng.normal(0, 0.5, (7, 600, 2))
    uv[3, 50:90] += 40.0
    whole = bundle(points, poses, uv)
    # In any order, and with tracks of which nothing is seen.
    some = rng.permutation(len(whole.row))[: len(whole.row) // 3]
    for rays in (whole, RayBundle(whole.row[some], poses, whole.frame[some], whole.uv[some], K, 601)):
        found = {}
        for name in ("C++", "NumPy"):
            with monkeypatch.context() as patch:
                if name == "NumPy":
                    patch.setattr(triangulation, "find_extension", lambda: (None, ""))
                at = triangulate(rays, 1.0)
                near = np.where(np.isfinite(at.position), at.position, 5.0) + np.array([0.0, 0.0, 0.01])
                near[-3:] = np.nan
                others = triangulation.ray_angles(rays, near), triangulation.reprojection_errors(rays, near)
                found[name] = (at.position, at.information, at.angle, at.error_px, *others)
        assert np.isfinite(found["C++"][0]).all(axis=1).mean() > 0.6
        assert np.isnan(found["C++"][0]).any()
        for fast, slow in zip(found["C++"], found["NumPy"], strict=True):
            np.testing.assert_allclose(fast, slow, rtol=1e-9, atol=1e-12)


def test_tracks_are_picked_one_after_the_other(rng: np.random.Generator) -> None:
    first, length = rng.integers(0, 15, 900), rng.integers(1, 20, 900)
    track = np.repeat(np.arange(900), length)
    frame = np.concatenate([start + np.arange(count) for start, count in zip(first, length, strict=True)])
    ones = np.ones(len(track))
    uv = rng.uniform(0, 1, (len(track), 2)) * np.array([320.0, 240.0])
    picked = spread_tracks(Observations(track, frame, uv, ones, ones), (240, 320), 300)
    cells = [(frame * 1000 + picture_cells(uv, (240, 320)))[track == k] for k in range(900)]
    wanted, filled, quota = set[int](), dict[int, int](), 1
    while len(wanted) < 300:
        for k in np.argsort(-length, kind="stable")[: np.count_nonzero(length >= 3)].tolist():
            free = sum(filled.get(cell, 0) < quota for cell in cells[k].tolist())
            if k not in wanted and len(wanted) < 300 and 2 * free >= length[k]:
                wanted.add(k)
                filled |= {cell: filled.get(cell, 0) + 1 for cell in cells[k].tolist()}
        quota *= 2
    assert set(np.unique(track[picked]).tolist()) == wanted


def test_picked_tracks_cover_every_frame_and_both_sides(rng: np.random.Generator) -> None:
    count, frames = 2000, 20
    track, frame = np.divmod(np.arange(count * 5), 5)
    frame = (frame + track % (frames - 4)).astype(np.int64)
    x = np.where(track % 10 == 0, 20.0, 280.0)  # one in ten on the left
    uv = np.stack([x + rng.uniform(-10, 10, len(x)), rng.uniform(10, 230, len(x))], axis=1)
    ones = np.ones(len(track))
    picked = spread_tracks(Observations(track, frame, uv, ones, ones), (240, 320), 300)
    assert len(np.unique(track[picked])) == 300
    assert np.bincount(frame[picked], minlength=frames).min() > 20
    assert np.mean(uv[picked, 0] < 160) > 0.2
