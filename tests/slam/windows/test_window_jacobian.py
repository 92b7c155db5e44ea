"""The Jacobian of a window's difference: against finite differences, and its products against dense ones."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.geometry import se3
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.information import FRAME, SHARED, WindowInformation, WindowJacobian
from uni4d_fg.slam.windows.plan import Window


def window_and_cameras(rng: np.random.Generator, count: int, before: int) -> tuple[WindowInformation, Cameras]:
    """A window that begins after some frames, and cameras some way from its linearization point."""
    poses = np.cumsum(rng.normal(scale=0.1, size=(before + count, 6)), axis=0)
    cameras = Cameras(
        se3.se3_exp(poses), rng.normal(size=4), rng.normal(scale=0.1, size=before + count)
    )  # fmt: skip
    window = Window(before, before + count)
    point = cameras.part(window.start, window.stop)
    moved = se3.retract(point.world_T_cam, rng.normal(scale=0.05, size=(count, 6)) * (np.arange(count) > 0)[:, None])
    size = FRAME * count + SHARED
    nothing = np.zeros((size, size))
    here = Cameras(moved, rng.normal(size=4), rng.normal(scale=0.1, size=count))
    return WindowInformation(window, here, nothing, np.zeros(size)), cameras


def dense(jacobian: WindowJacobian) -> np.ndarray:
    return jacobian.left_product(np.eye(FRAME * len(jacobian.own) + SHARED))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 5), before=st.integers(0, 3))
def test_it_is_the_derivative_of_the_difference(seed: int, count: int, before: int) -> None:
    rng = np.random.default_rng(seed)
    part, cameras = window_and_cameras(rng, count, before)
    found, step = dense(part.difference(cameras)[1]), 1e-6

    def difference(tangent: np.ndarray) -> np.ndarray:
        own = slice(before, before + count)
        frames = tangent[:-SHARED].reshape(count, FRAME)
        poses, scales = cameras.world_T_cam.copy(), cameras.log_scale.copy()
        poses[own] = se3.retract(poses[own], frames[:, :6])
        scales[own] += frames[:, 6]
        return part.difference(Cameras(poses, cameras.intrinsics + tangent[-SHARED:], scales))[0]

    for column, tangent in enumerate(step * np.eye(len(found))):
        numeric = (difference(tangent) - difference(-tangent)) / (2 * step)
        np.testing.assert_allclose(found[:, column], numeric, atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 6), rows=st.integers(1, 4))
def test_products_by_blocks_are_the_dense_ones(seed: int, count: int, rows: int) -> None:
    rng = np.random.default_rng(seed)
    part, cameras = window_and_cameras(rng, count, 2)
    jacobian = part.difference(cameras)[1]
    whole = dense(jacobian)
    matrix, root = rng.normal(size=(rows, len(whole))), rng.normal(size=(len(whole), len(whole)))
    np.testing.assert_allclose(jacobian.left_product(matrix), matrix @ whole, atol=1e-12)
    symmetric = root.T @ root
    np.testing.assert_allclose(jacobian.congruent(symmetric), whole.T @ symmetric @ whole, atol=1e-10)
