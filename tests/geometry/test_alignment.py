"""Umeyama alignment: recovery, degenerate inputs, agreement with a known program."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import geometry
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import InputError
from uni4d_fg.geometry.alignment import (
    Similarity,
    align_first_pose,
    align_points,
    align_trajectories,
)


def poses_of(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    out = np.tile(np.eye(4), (len(positions), 1, 1))
    out[:, :3, :3] = rotations
    out[:, :3, 3] = positions
    return out


def random_similarity(rng: np.random.Generator) -> Similarity:
    rotation = Rotation.random(rng=rng).as_matrix()
    return Similarity(rotation, rng.normal(size=3) * 3, float(np.exp(rng.normal())))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.booleans())
def test_exact_similarity_is_recovered(seed: int, count: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    truth = random_similarity(rng)
    if not with_scale:
        truth = Similarity(truth.rotation, truth.translation, 1.0)
    x = rng.normal(size=(count, 3))
    found = align_points(x, truth.apply(x), with_scale=with_scale)
    assert found.degenerate == "none"
    assert found.scale == pytest.approx(truth.scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-6)
    np.testing.assert_allclose(found.apply(x), truth.apply(x), atol=1e-7)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(4, 40), st.booleans())
def test_equals_evo_on_noisy_points(seed: int, count: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, count, 3))
    rotation, translation, scale = geometry.umeyama_alignment(x.T, y.T, with_scale)
    found = align_points(x, y, with_scale=with_scale)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, translation, atol=1e-9)
    assert found.scale == pytest.approx(scale, rel=1e-9)


def test_planar_points_give_a_proper_rotation() -> None:
    rng = np.random.default_rng(0)
    truth = random_similarity(rng)
    x = rng.normal(size=(20, 3)) * [1, 1, 0]
    found = align_points(x, truth.apply(x))
    assert found.degenerate == "none"
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_collinear_centers_take_the_roll_from_the_orientations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_similarity(rng)
    line = np.linspace(-1, 2, 15)[:, None] * rng.normal(size=3) + rng.normal(size=3)
    estimate = poses_of(line, Rotation.random(15, rng=rng).as_matrix())
    found = align_trajectories(estimate, truth.apply_poses(estimate))
    assert found.degenerate == "collinear"
    assert found.scale == pytest.approx(truth.scale)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-6)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-6)


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [-1.0, 0, 0], [0, 0, -2.0], [0, 3.0, 0]])
def test_collinear_points_without_orientations_match_exactly(direction: list[float]) -> None:
    line = np.linspace(0, 1, 9)[:, None]
    x, y = line * [1.0, 0, 0], line * direction
    found = align_points(x, y)
    assert found.degenerate == "collinear"
    np.testing.assert_allclose(found.apply(x), y, atol=1e-9)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("offset", [0.0, 1.0, 1e6])
def test_motionless_camera_takes_rotation_from_orientations(offset: float) -> None:
    rng = np.random.default_rng(1)
    truth = Rotation.random(rng=rng).as_matrix()
    rotations = Rotation.random(8, rng=rng).as_matrix()
    estimate = poses_of(np.full((8, 3), offset), rotations)
    reference = poses_of(np.tile([1.0, 2.0, 3.0], (8, 1)), truth @ rotations)
    found = align_trajectories(estimate, reference)
    assert (found.degenerate, found.scale) == ("motionless_estimate", 1.0)
    np.testing.assert_allclose(found.rotation, truth, atol=1e-9)
    np.testing.assert_allclose(found.apply(estimate[:, :3, 3]), reference[:, :3, 3], atol=1e-6)


def test_motionless_reference_does_not_shrink_a_moving_estimate() -> None:
    estimate = poses_of(np.eye(3), np.tile(np.eye(3), (3, 1, 1)))
    found = align_trajectories(estimate, np.tile(np.eye(4), (3, 1, 1)))
    assert (found.degenerate, found.scale) == ("motionless_reference", 1.0)


def test_no_finite_point_gives_the_identity() -> None:
    found = align_points(np.full((3, 3), np.nan), np.zeros((3, 3)))
    assert found.degenerate == "no_points"
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    assert align_points(np.zeros((0, 3)), np.zeros((0, 3))).degenerate == "no_points"


def test_single_pose_aligns_exactly() -> None:
    rng = np.random.default_rng(2)
    estimate, reference = poses_of(rng.normal(size=(2, 3)), Rotation.random(2, rng=rng).as_matrix())
    np.testing.assert_allclose(
        align_trajectories(estimate[None], reference[None]).apply_poses(estimate[None])[0], reference, atol=1e-9
    )
    np.testing.assert_allclose(
        align_first_pose(estimate, reference).apply_poses(estimate[None])[0], reference, atol=1e-9
    )


@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 6),
    st.sampled_from([0.0, 1e-320, 1e-12, 1e-6, 1.0, 1e9]),
    st.sampled_from([0.0, 1e-12, 1.0, 1e9]),
    st.integers(0, 3),
    st.integers(0, 3),
)
def test_never_nan_and_always_a_rotation(
    seed: int, count: int, size_x: float, size_y: float, rank_x: int, rank_y: int
) -> None:
    rng = np.random.default_rng(seed)
    x = size_x * rng.normal(size=(count, rank_x)) @ rng.normal(size=(rank_x, 3)) + rng.normal(size=3)
    y = size_y * rng.normal(size=(count, rank_y)) @ rng.normal(size=(rank_y, 3)) + rng.normal(size=3)
    for with_scale in (True, False):
        found = align_points(x, y, with_scale=with_scale)
        assert np.isfinite(found.rotation).all()
        assert np.isfinite(found.translation).all()
        assert np.isfinite(found.scale)
        assert found.scale >= 0.0
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_points_that_are_not_finite_are_left_out() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(10, 3))
    truth = random_similarity(rng)
    y = truth.apply(x)
    y[4] = np.nan
    np.testing.assert_allclose(align_points(x, y).rotation, truth.rotation, atol=1e-9)


def test_shapes_that_disagree_are_refused() -> None:
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        align_points(np.zeros((4, 3)), np.zeros((5, 3)))
