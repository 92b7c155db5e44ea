"""Points of other frames, where a frame has none: shown where nothing hides them, left out where something does."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.borrowed_points import beside_masks, with_borrowed
from uni4d_fg.cues.interpolated_depth import SparseInverseDepth, interpolate
from uni4d_fg.geometry.camera import project
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

CAMERA = CameraModel(np.array([200.0, 200.0, 159.5, 119.5]))
SIZE = (240, 320)
FAR, NEAR = 5.0, 1.0


def plane(u: tuple[float, float], z: float, count: int = 400) -> FloatArray:
    """Points (N, 3) of a plane at depth ``z`` that are seen at columns between ``u``, also a little above and below."""
    rng = np.random.default_rng(int(10 * z + u[1]))
    uv = np.stack([rng.uniform(*u, count), rng.uniform(-40, 280, count)], axis=1)
    return np.column_stack([(uv - CAMERA.intrinsics[2:]) / CAMERA.intrinsics[:2] * z, np.full(count, z)])


def own(points: FloatArray) -> SparseInverseDepth:
    """What a camera at the origin follows of points."""
    uv = project(CAMERA.intrinsics, points)
    inside = (uv >= 0).all(axis=1) & (uv < SIZE[::-1]).all(axis=1)
    return SparseInverseDepth(uv[inside], 1.0 / points[inside, 2])


def borrowed(mine: SparseInverseDepth, others: FloatArray) -> SparseInverseDepth:
    return with_borrowed(mine, others, np.eye(4), CAMERA, 0, SIZE, GeometricDepthConfig())


def test_a_near_wall_without_tracks_is_where_other_frames_saw_it() -> None:
    mine = own(plane((130, 320), FAR))
    wall = plane((-60, 100), NEAR)
    before, after = (interpolate(points, SIZE, 4) for points in (mine, borrowed(mine, wall)))
    assert 1.0 / before[30, 10] == pytest.approx(FAR, rel=0.01)
    np.testing.assert_allclose(1.0 / after[:, :22], NEAR, rtol=0.01)
    np.testing.assert_allclose(1.0 / after[5:-5, 35:], FAR, rtol=0.01)


def test_what_is_behind_the_frames_own_points_stays_hidden() -> None:
    mine = own(plane((0, 320), NEAR, 1500))
    after = borrowed(mine, plane((-20, 340), FAR))
    kept = after.uv[len(mine.uv) :]
    assert not ((kept > 20) & (kept < np.array(SIZE[::-1]) - 20)).all(axis=1).any()
    np.testing.assert_array_equal(after.uv[: len(mine.uv)], mine.uv)


def test_what_is_behind_other_borrowed_points_stays_hidden() -> None:
    mine = own(plane((220, 320), FAR))
    after = borrowed(mine, np.concatenate([plane((-60, 150), NEAR, 1500), plane((0, 150), 4.0)]))
    assert np.mean(after.inverse_depth[len(mine.uv) :] == 1.0 / NEAR) > 0.97


def test_points_near_the_frames_own_are_not_borrowed() -> None:
    mine = own(plane((0, 320), FAR, 1500))
    kept = borrowed(mine, plane((0, 320), 4.9)).uv[len(mine.uv) :]
    assert not ((kept > 0) & (kept < SIZE[::-1])).all(axis=1).any()


def test_points_behind_the_camera_or_far_outside_are_not_borrowed() -> None:
    mine = own(plane((0, 320), FAR))
    behind = plane((0, 320), NEAR) * -1.0
    assert len(borrowed(mine, behind).uv) == len(mine.uv)
    assert len(borrowed(mine, plane((600, 900), NEAR)).uv) == len(mine.uv)


def test_what_a_lens_folds_back_into_the_image_is_not_borrowed() -> None:
    """Beyond r = 1.29 in a plane at distance one, k1 = -0.2 brings directions back toward the middle."""
    lens = CameraModel(CAMERA.intrinsics, Lens("SIMPLE_RADIAL", (-0.2,)))
    mine = own(plane((0, 320), FAR))
    rng = np.random.default_rng(0)
    far_outside = np.column_stack([rng.uniform(2.1, 2.3, 400), rng.uniform(-0.1, 0.1, 400), np.ones(400)])
    uv = lens.real(project(lens.intrinsics, far_outside), np.zeros(400, np.int64))
    assert (uv[:, 0] < SIZE[1]).mean() > 0.5
    after = with_borrowed(mine, far_outside, np.eye(4), lens, 0, SIZE, GeometricDepthConfig())
    assert len(after.uv) == len(mine.uv)


def test_tracks_beside_masks_in_most_of_their_frames_are_known() -> None:
    masks = np.zeros((4, 240, 320), np.int32)
    masks[:, 100:140, 100:140] = 2
    # Track 0 is beside the mask in three of four frames, track 1 in one of them, track 2 never.
    where = {0: (145, 145, 145, 300), 1: (145, 300, 300, 300), 2: (200, 200, 200, 200)}
    track = np.repeat(np.arange(3), 4)
    frame = np.tile(np.arange(4), 3)
    uv = np.array([[u, 120.0] for columns in where.values() for u in columns])
    seen = Observations(track, frame, uv, np.full(12, np.nan), np.ones(12))
    np.testing.assert_array_equal(beside_masks(masks, seen, 4), [True, False, False, False])
