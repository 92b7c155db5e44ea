r"""Factors that the landmark system does not know, against one dense Hessian over everything.

They come as linearized blocks: what they add to the landmarks goes through ``add_to_landmarks``, what they add to the
cameras into the camera system, and what couples both, :math:`F`, into the reduced system, with
:math:`W_E = L^{-1} E^T` and :math:`W_F = L^{-1} F^T`:

.. math:: S = H - W_E^T W_E - W_E^T W_F - W_F^T W_E - W_F^T W_F.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from uni4d_fg_cpp import _core

from uni4d_fg.factors.depth_prior import static_depth_prior
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.geometry import se3

DAMPING, BOUNDS = 0.07, (1e-6, 1e32)
BORDER = 4


@dataclass
class Scene:
    """A bundle adjustment in which a landmark is seen by a few consecutive frames."""

    frames: int
    landmarks: int
    pose: np.ndarray
    landmark: np.ndarray
    uv: np.ndarray
    depth: np.ndarray
    state: dict[str, np.ndarray]
    columns: np.ndarray
    """(T, 7) core column of each entry of pose and log-scale, -1 where frozen."""
    landmark_free: np.ndarray
    intrinsics_free: np.ndarray
    """(4,) bool."""

    @property
    def size(self) -> int:
        return int(self.columns.max()) + 1


def make_scene(seed: int, frames: int, landmarks: int, span: int, *, intrinsics: str) -> Scene:
    """Frame 0, an entry here and there, and every fifth landmark are frozen; the last landmark is never seen."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, frames - span + 1, landmarks - 1)
    pose = (first[:, None] + np.arange(span)).reshape(-1)
    landmark = np.repeat(np.arange(landmarks - 1), span)
    points = rng.normal(loc=[0, 0, 4], scale=[1, 1, 0.3], size=(landmarks, 3))
    state = {
        "world_T_cam": se3.se3_exp(rng.normal(scale=0.05, size=(frames, 6))),
        "intrinsics": np.array([300.0, 310.0, 3.0, -2.0]),
        "log_scale": rng.normal(scale=0.1, size=frames),
        "landmarks": points,
    }
    free = rng.random((frames, 7)) > 0.1
    free[0] = False
    columns = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
    count = len(pose)
    return Scene(
        frames,
        landmarks,
        pose,
        landmark,
        rng.normal(scale=80, size=(count, 2)),
        rng.uniform(3, 5, count),
        state,
        columns,
        (np.arange(landmarks) % 5 != 0).astype(np.int64),
        {"free": np.ones(4, bool), "partly": np.array([1, 1, 0, 0], bool), "frozen": np.zeros(4, bool)}[intrinsics],
    )


def make_system(scene: Scene, stored_rows: int, *, banded: bool, threads: int) -> Any:
    """Return the system; each of two threads gets its share only of many factors, hence the copies."""
    copies = 3
    noise = (np.full(len(scene.pose), 2.0), np.full(len(scene.pose), 1.0 / copies), 0, 1.0)
    return _core.LandmarkSystem(
        [(scene.pose, scene.landmark, scene.uv, *noise)] * copies,
        [(scene.pose, scene.landmark, scene.depth, *noise)] * copies,
        scene.frames,
        scene.landmark_free,
        scene.columns,
        bool(scene.intrinsics_free.any()),
        stored_rows,
        banded,
        threads,
    )


def own_jacobian(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return J over (core columns, intrinsics, landmarks) and r of the system's own factors."""
    n, count = scene.size, len(scene.pose)
    pose, point = scene.state["world_T_cam"][scene.pose], scene.state["landmarks"][scene.landmark]
    intrinsics = np.broadcast_to(scene.state["intrinsics"], (count, 4))
    r, (by_pose, by_point, by_intrinsics) = static_reprojection.linearize(pose, point, intrinsics, uv=scene.uv)
    scale = scene.state["log_scale"][scene.pose, None]
    r_depth, (pose_depth, point_depth, by_scale) = static_depth_prior.linearize(pose, point, scale, depth=scene.depth)
    jacobian = np.zeros((count, 3, n + BORDER + 3 * scene.landmarks))
    for i in range(count):
        camera = np.zeros((3, 7))
        camera[:2, :6], camera[2, :6], camera[2, 6] = by_pose[i], pose_depth[i, 0], by_scale[i, 0, 0]
        at = scene.columns[scene.pose[i]]
        jacobian[i][:, at[at >= 0]] = camera[:, at >= 0]
        jacobian[i, :2, n : n + BORDER] = by_intrinsics[i]
        start = n + BORDER + 3 * scene.landmark[i]
        jacobian[i, :2, start : start + 3], jacobian[i, 2:, start : start + 3] = by_point[i], point_depth[i]
    residual = np.concatenate([r, r_depth], axis=1)
    return 0.5 * jacobian.reshape(3 * count, -1), 0.5 * residual.reshape(-1)


def foreign_jacobian(scene: Scene, seed: int, *, coupled: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return J and r of factors of dimension 2 on a landmark each and, if ``coupled``, a frame and the intrinsics.

    Frames are drawn whether they see the landmark or not.
    """
    rng = np.random.default_rng(seed)
    n, blocks = scene.size, []
    for landmark in rng.permutation(np.flatnonzero(scene.landmark_free))[:12].tolist() * 2:
        block = np.zeros((2, n + BORDER + 3 * scene.landmarks))
        block[:, n + BORDER + 3 * landmark :][:, :3] = rng.normal(scale=30, size=(2, 3))
        if coupled:
            at = scene.columns[rng.integers(0, scene.frames)]
            block[:, at[at >= 0]] = rng.normal(scale=30, size=(2, int((at >= 0).sum())))
            block[:, n : n + BORDER] = rng.normal(scale=0.3, size=(2, BORDER))
        blocks.append(block)
    jacobian = np.concatenate(blocks)
    return jacobian, rng.normal(scale=5, size=len(jacobian))


def spread(scene: Scene, arrays: tuple[np.ndarray, ...], *, banded: bool) -> np.ndarray:
    """Return the dense symmetric matrix (n + 4, n + 4) of a camera system's storage."""
    core, border, corner = arrays[:3]
    n = scene.size
    matrix = np.zeros((n + BORDER, n + BORDER))
    for j in range(n):
        column = core[j, : min(core.shape[1], n - j)] if banded else core[j, j:]
        matrix[j : j + len(column), j] = column
    matrix[:n, :n] += np.tril(matrix[:n, :n], -1).T
    matrix[:n, n:], matrix[n:, :n], matrix[n:, n:] = border, border.T, corner
    return matrix


def storage(scene: Scene, matrix: np.ndarray, stored_rows: int, *, banded: bool) -> tuple[np.ndarray, ...]:
    """Return core, border and corner of a dense symmetric matrix; the inverse of :func:`spread`."""
    n = scene.size
    core = np.zeros((n, stored_rows))
    for j in range(n):
        stop = min(j + stored_rows, n) if banded else n
        if banded:
            core[j, : stop - j] = matrix[j:stop, j]
        else:
            core[j, j:] = matrix[j:n, j]
    return core, np.ascontiguousarray(matrix[:n, n:]), np.ascontiguousarray(matrix[n:, n:])


@pytest.mark.parametrize("coupled", [False, True], ids=["landmarks alone", "coupled to cameras"])
@pytest.mark.parametrize("intrinsics", ["free", "partly", "frozen"])
@pytest.mark.parametrize("banded", [False, True], ids=["dense", "banded"])
@pytest.mark.parametrize("threads", [1, 2])
def test_step_equals_that_of_the_dense_system(threads: int, banded: bool, intrinsics: str, coupled: bool) -> None:
    scene = make_scene(3, 12, 350 if threads > 1 else 40, 4, intrinsics=intrinsics)
    n = scene.size
    stored_rows = 7 * 5 if banded else n
    own, own_r = own_jacobian(scene)
    foreign, foreign_r = foreign_jacobian(scene, 5, coupled=coupled)
    camera = slice(0, n + BORDER)
    point = slice(n + BORDER, None)

    # The dense reference over the free entries.
    jacobian, residual = np.concatenate([own, foreign]), np.concatenate([own_r, foreign_r])
    free = np.r_[np.ones(n, bool), scene.intrinsics_free, np.repeat(scene.landmark_free > 0, 3)]
    hessian, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    diagonal = np.clip(np.diag(hessian), *BOUNDS)
    expected = np.zeros(len(free))
    damped = hessian + DAMPING * np.diag(diagonal)
    expected[free] = np.linalg.solve(damped[np.ix_(free, free)], -gradient[free])

    system = make_system(scene, stored_rows, banded=banded, threads=threads)
    *arrays, camera_gradient, _, finite = system.linearize(**scene.state)
    assert finite

    # What the foreign factors add to the landmarks: some one by one, the others in one call. Rows repeat.
    by_landmark = foreign[:, point].reshape(-1, 2, scene.landmarks, 3)
    factor_rows = np.abs(by_landmark).sum(axis=(1, 3)).argmax(axis=1)
    own_blocks = by_landmark[np.arange(len(by_landmark)), :, factor_rows]
    blocks = np.swapaxes(own_blocks, 1, 2) @ own_blocks
    gradients = np.einsum("nds,nd->ns", own_blocks, foreign_r.reshape(-1, 2))
    for part in ([0], [1], slice(2, None)):
        largest = system.add_to_landmarks(factor_rows[part], blocks[part], gradients[part])
    np.testing.assert_allclose(largest, np.abs(gradient[point][free[point]]).max(), rtol=1e-12)
    all_blocks, all_gradients = system.landmark_blocks()
    for i in np.flatnonzero(scene.landmark_free).tolist():
        at = n + BORDER + 3 * i + np.arange(3)
        np.testing.assert_allclose(all_blocks[i], hessian[np.ix_(at, at)], rtol=1e-10, atol=1e-8)
        np.testing.assert_allclose(all_gradients[i], gradient[at], rtol=1e-10, atol=1e-8)

    # What they add to the cameras.
    full = spread(scene, tuple(arrays), banded=banded) + foreign[:, camera].T @ foreign[:, camera]
    camera_gradient = camera_gradient + foreign[:, camera].T @ foreign_r
    used = free[camera]
    np.testing.assert_allclose(
        full[np.ix_(used, used)], hessian[camera, camera][np.ix_(used, used)], rtol=1e-10, atol=1e-7
    )
    *reduced, right = system.reduce(
        DAMPING, *BOUNDS, *storage(scene, full, stored_rows, banded=banded), camera_gradient
    )
    matrix = spread(scene, tuple(reduced), banded=banded)

    # What couples both.
    rows = np.unique(factor_rows)
    coupling = foreign[:, camera].T @ foreign[:, point]
    extra_rows = coupling.T.reshape(scene.landmarks, 3, -1)
    assert np.all(extra_rows[np.setdiff1d(np.arange(scene.landmarks), rows)] == 0.0)
    whitened = system.whitened_coupling(rows)
    assert whitened.shape == (len(rows), 3, n + BORDER + 1)
    inverse = system.inverse_factors(rows)
    of_own = own[:, camera].T @ own[:, point]
    for i, row in enumerate(rows.tolist()):
        at = n + BORDER + 3 * row + np.arange(3)
        np.testing.assert_allclose(np.linalg.inv(inverse[i].T @ inverse[i]), damped[np.ix_(at, at)], rtol=1e-9)
        lower = np.linalg.cholesky(damped[np.ix_(at, at)])
        np.testing.assert_allclose(inverse[i] @ lower, np.eye(3), atol=1e-11)
        known = np.flatnonzero(used)
        np.testing.assert_allclose(
            whitened[i][:, known], np.linalg.solve(lower, of_own.T[3 * row : 3 * row + 3, known]), rtol=1e-8, atol=1e-8
        )
        np.testing.assert_allclose(whitened[i, :, -1], np.linalg.solve(lower, gradient[at]), rtol=1e-9, atol=1e-9)
    ours = whitened[:, :, :-1].reshape(-1, n + BORDER)
    theirs = (inverse @ extra_rows[rows]).reshape(-1, n + BORDER)
    assert coupled == bool(theirs.any())
    matrix -= ours.T @ theirs + theirs.T @ ours + theirs.T @ theirs
    right = right + theirs.T @ whitened[:, :, -1].reshape(-1)
    if banded and coupled:
        assert np.abs(np.tril(matrix[:n, :n], -stored_rows)).max() > 0.0, "the coupling must leave the band"

    step = np.zeros(n + BORDER)
    step[used] = np.linalg.solve(matrix[np.ix_(used, used)], right[used])
    np.testing.assert_allclose(step, expected[camera], rtol=1e-7, atol=1e-10)
    landmark_step, slope, damped_sum, squared = system.back_substitute(step, extra=extra_rows @ step)
    np.testing.assert_allclose(landmark_step.reshape(-1), expected[point], rtol=1e-7, atol=1e-10)
    of_landmarks = expected[point]
    np.testing.assert_allclose(slope, gradient[point] @ of_landmarks, rtol=1e-8)
    np.testing.assert_allclose(damped_sum, np.sum(diagonal[point] * of_landmarks**2), rtol=1e-8)
    np.testing.assert_allclose(squared, np.sum(of_landmarks**2), rtol=1e-8)
    # The decrease that these sums predict is that of the whole model.
    slope += gradient[camera] @ step
    damped_sum += np.sum(diagonal[camera] * step**2)
    decrease = -(gradient[free] @ expected[free] + 0.5 * expected @ hessian @ expected)
    np.testing.assert_allclose(0.5 * (DAMPING * damped_sum - slope), decrease, rtol=1e-9)


def test_each_linearization_starts_without_foreign_factors() -> None:
    scene = make_scene(1, 6, 20, 3, intrinsics="free")
    system = make_system(scene, scene.size, banded=False, threads=1)
    system.linearize(**scene.state)
    before = system.landmark_blocks()
    system.add_to_landmarks(np.array([1, 1, 2]), np.tile(np.eye(3), (3, 1, 1)), np.ones((3, 3)))
    after = system.landmark_blocks()
    np.testing.assert_allclose((after[0] - before[0])[1], 2.0 * np.eye(3), atol=1e-9)
    np.testing.assert_allclose((after[1] - before[1])[[1, 2, 3], 0], [2.0, 1.0, 0.0], atol=1e-9)
    system.linearize(**scene.state)
    for mine, theirs in zip(system.landmark_blocks(), before, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_an_unseen_landmark_is_determined_by_a_foreign_factor_alone() -> None:
    scene = make_scene(1, 6, 22, 3, intrinsics="frozen")
    last = np.array([21])
    assert scene.landmark_free[21]
    system = make_system(scene, scene.size, banded=False, threads=1)
    arrays = system.linearize(**scene.state)[:4]
    assert system.reduce(0.0, 0.0, 1e32, *arrays) is None
    system.add_to_landmarks(last, 4.0 * np.eye(3)[None], np.array([[8.0, -4.0, 0.0]]))
    assert system.reduce(0.0, 0.0, 1e32, *arrays) is not None
    np.testing.assert_array_equal(system.whitened_coupling(last)[0, :, :-1], 0.0)
    step = system.back_substitute(np.zeros(scene.size + 4))[0]
    np.testing.assert_allclose(step[21], [-2.0, 1.0, 0.0], rtol=1e-15)


def test_an_asymmetric_block_counts_with_its_symmetric_part() -> None:
    scene = make_scene(1, 6, 20, 3, intrinsics="frozen")
    system = make_system(scene, scene.size, banded=False, threads=1)
    system.linearize(**scene.state)
    before = system.landmark_blocks()[0]
    block = np.arange(9.0).reshape(3, 3)
    system.add_to_landmarks(np.array([4]), block[None], np.zeros((1, 3)))
    np.testing.assert_allclose((system.landmark_blocks()[0] - before)[4], 0.5 * (block + block.T), atol=1e-10)


def test_couplings_go_to_the_frames_that_a_landmark_has() -> None:
    scene = make_scene(5, 8, 30, 3, intrinsics="free")
    system = make_system(scene, scene.size, banded=False, threads=1)
    one, frames = np.array([6]), scene.pose[scene.landmark == 6]
    system.reduce(DAMPING, *BOUNDS, *system.linearize(**scene.state)[:4])
    before, factor = system.whitened_coupling(one)[0], system.inverse_factors(one)[0]
    arrays = system.linearize(**scene.state)[:4]
    block = np.arange(21.0).reshape(1, 3, 7)
    system.add_to_coupling(np.repeat(frames[1], 2), np.repeat(one, 2), np.repeat(block, 2, axis=0))
    with pytest.raises(ValueError, match="call reduce first"):
        system.whitened_coupling(one)
    system.reduce(DAMPING, *BOUNDS, *arrays)
    expected = np.zeros_like(before)
    columns = scene.columns[frames[1]]
    expected[:, columns[columns >= 0]] = 2.0 * factor @ block[0][:, columns >= 0]
    np.testing.assert_allclose(system.whitened_coupling(one)[0] - before, expected, atol=1e-9)
    elsewhere = np.setdiff1d(np.arange(scene.frames), frames)[:1]
    with pytest.raises(ValueError, match=rf"no factor of the problem reads landmark 6 and frame {elsewhere[0]}"):
        system.add_to_coupling(elsewhere, one, block)
    with pytest.raises(ValueError, match=r"frames: entry 0 is 8, outside \[0, 8\)"):
        system.add_to_coupling(np.array([8]), one, block)
    with pytest.raises(ValueError, match=r"blocks: expected float64 \(1, 3, 7\)"):
        system.add_to_coupling(frames[:1], one, block[:, :, :6].copy())


def test_what_is_refused() -> None:
    scene = make_scene(2, 6, 20, 3, intrinsics="free")
    system = make_system(scene, scene.size, banded=False, threads=1)
    one, block, gradient = np.array([1]), np.eye(3)[None], np.zeros((1, 3))
    with pytest.raises(ValueError, match="call linearize first"):
        system.add_to_landmarks(one, block, gradient)
    arrays = system.linearize(**scene.state)[:4]
    for call in (system.whitened_coupling, system.inverse_factors):
        with pytest.raises(ValueError, match="call reduce first"):
            call(one)
    system.reduce(0.1, *BOUNDS, *arrays)
    frozen = np.array([1, 5])
    for call in (
        system.whitened_coupling,
        system.inverse_factors,
        lambda rows: system.add_to_landmarks(rows, np.zeros((2, 3, 3)), np.zeros((2, 3))),
    ):
        with pytest.raises(ValueError, match=r"rows: entry 1 is landmark 5, which is frozen"):
            call(frozen)
        with pytest.raises(ValueError, match=r"rows: entry 1 is 20, outside \[0, 20\)"):
            call(np.array([1, 20]))
        with pytest.raises(ValueError, match=r"rows: expected int64"):
            call(np.array([1, 2], dtype=np.int32))
    with pytest.raises(ValueError, match=r"blocks: expected float64 \(1, 3, 3\)"):
        system.add_to_landmarks(one, np.zeros((2, 3, 3)), gradient)
    with pytest.raises(ValueError, match=r"gradients: every value must be finite"):
        system.add_to_landmarks(one, block, np.full((1, 3), np.nan))
    with pytest.raises(ValueError, match=r"extra: expected float64 \(20, 3\)"):
        system.back_substitute(np.zeros(scene.size + 4), np.zeros((19, 3)))
    system.add_to_landmarks(one, block, gradient)
    with pytest.raises(ValueError, match="call reduce first"):
        system.whitened_coupling(one)


def test_many_landmarks_in_pieces_equal_all_at_once() -> None:
    scene = make_scene(7, 60, 2001, 6, intrinsics="free")
    system = make_system(scene, scene.size, banded=False, threads=2)
    system.reduce(0.1, *BOUNDS, *system.linearize(**scene.state)[:4])
    rows = np.random.default_rng(0).permutation(np.flatnonzero(scene.landmark_free))
    whole = system.whitened_coupling(rows)
    for begin in range(0, len(rows), 500):
        np.testing.assert_array_equal(system.whitened_coupling(rows[begin : begin + 500]), whole[begin : begin + 500])
