"""The landmark Schur system at its boundary: against dense algebra, and with malformed arguments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_boundary import spoil
from uni4d_fg_cpp import _core

from uni4d_fg.factors.depth_prior import static_depth_prior
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.geometry import se3

FRAMES, LANDMARKS, COUNT = 4, 9, 30
STATE = ("world_T_cam", "intrinsics", "log_scale", "landmarks")
MAY_BE_NAN = {"uv", "depth", *STATE, "core", "border", "corner", "gradient", "camera_step"}
"""Values that are not finite pass here: the linearization reports them, and the solver names the variables."""
Arguments = dict[str, Any]


def make_plan(rng: np.random.Generator) -> Arguments:
    rows = {"pose": rng.integers(0, FRAMES, COUNT), "landmark": rng.integers(0, LANDMARKS, COUNT)}
    noise = {"sigma": rng.uniform(0.5, 2, COUNT), "weight": rng.uniform(0, 2, COUNT)}
    columns = np.arange(FRAMES * 7).reshape(FRAMES, 7) - 7
    columns[0] = -1
    return {
        **rows, "uv": rng.normal(scale=50, size=(COUNT, 2)), **noise, "depth": rng.uniform(1, 5, COUNT),
        "landmark_free": np.r_[0, np.ones(LANDMARKS - 1, dtype=np.int64)], "columns": columns,
    }  # fmt: skip


def make_system(arguments: Arguments, **options: Any) -> Any:
    rows = (arguments["pose"], arguments["landmark"])
    noise = (arguments["sigma"], arguments["weight"])
    kernel, threshold = options.pop("kernel", 0), options.pop("threshold", 1.3)
    reprojection = [(*rows, arguments["uv"], *noise, kernel, threshold)]
    depth = [(*rows, arguments["depth"], *noise, kernel, threshold)]
    chosen = {
        "num_frames": FRAMES,
        "intrinsics_free": True,
        "stored_rows": 7 * (FRAMES - 1),
        "banded": False,
        **options,
    }
    return _core.LandmarkSystem(
        reprojection, depth, landmark_free=arguments["landmark_free"], columns=arguments["columns"], **chosen
    )


def make_state(rng: np.random.Generator) -> Arguments:
    return {
        "world_T_cam": se3.se3_exp(rng.normal(scale=0.1, size=(FRAMES, 6))),
        "intrinsics": np.array([100.0, 110.0, 3.0, -2.0]),
        "log_scale": rng.normal(scale=0.1, size=FRAMES),
        "landmarks": rng.normal(loc=[0, 0, 4], size=(LANDMARKS, 3)),
    }


def dense_jacobian(plan: Arguments, state: Arguments) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian on (camera columns, intrinsics, landmarks) and the residual, quadratic kernel."""
    size = 7 * (FRAMES - 1)
    pose, point = state["world_T_cam"][plan["pose"]], state["landmarks"][plan["landmark"]]
    intrinsics = np.broadcast_to(state["intrinsics"], (COUNT, 4))
    r, (by_pose, by_point, by_intrinsics) = static_reprojection.linearize(pose, point, intrinsics, uv=plan["uv"])
    scale = state["log_scale"][plan["pose"], None]
    r_depth, (pose_depth, point_depth, by_scale) = static_depth_prior.linearize(pose, point, scale, depth=plan["depth"])
    jacobian, residual = np.zeros((3 * COUNT, size + 4 + 3 * LANDMARKS)), np.zeros(3 * COUNT)
    for n in range(COUNT):
        row, factor = slice(3 * n, 3 * n + 3), np.sqrt(plan["weight"][n]) / plan["sigma"][n]
        camera = np.zeros((3, 7))
        camera[:2, :6], camera[2, :6], camera[2, 6] = by_pose[n], pose_depth[n, 0], by_scale[n, 0, 0]
        start = 7 * (plan["pose"][n] - 1)
        if start >= 0:
            jacobian[row, start : start + 7] = camera
        jacobian[3 * n : 3 * n + 2, size : size + 4] = by_intrinsics[n]
        at = size + 4 + 3 * plan["landmark"][n]
        jacobian[row, at : at + 3] = np.concatenate([by_point[n], point_depth[n]])
        residual[row] = [*r[n], r_depth[n, 0]]
        jacobian[row] *= factor
        residual[row] *= factor
    return jacobian, residual


@pytest.mark.parametrize("threads", [1, 2])
def test_elimination_solves_the_dense_system(threads: int) -> None:
    rng = np.random.default_rng(3)
    plan, state = make_plan(rng), make_state(rng)
    system = make_system(plan, threads=threads)
    jacobian, residual = dense_jacobian(plan, state)
    np.testing.assert_allclose(system.energies(**state).sum(), 0.5 * residual @ residual, rtol=1e-12)

    core, border, corner, gradient, largest, finite = system.linearize(**state)
    assert finite
    size = len(core)
    hessian = np.zeros((size + 4, size + 4))
    hessian[:size, :size] = np.triu(core) + np.triu(core, 1).T
    hessian[:size, size:], hessian[size:, :size], hessian[size:, size:] = border, border.T, corner
    camera = jacobian[:, : size + 4]
    np.testing.assert_allclose(hessian, camera.T @ camera, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(gradient, camera.T @ residual, rtol=1e-10, atol=1e-9)
    landmark_gradient = jacobian[:, size + 4 + 3 :].T @ residual
    np.testing.assert_allclose(largest, np.abs(landmark_gradient).max(), rtol=1e-10)

    free = np.r_[np.arange(size + 4), np.arange(size + 7, jacobian.shape[1])]
    full = jacobian[:, free].T @ jacobian[:, free]
    damped = full + 0.1 * np.diag(np.clip(np.diag(full), 1e-6, 1e32))
    expected = np.linalg.solve(damped, -jacobian[:, free].T @ residual)
    core, border, corner, right = system.reduce(0.1, 1e-6, 1e32, core, border, corner, gradient)
    reduced = np.block([[np.triu(core) + np.triu(core, 1).T, border], [border.T, corner]])
    step = np.linalg.solve(reduced, right)
    np.testing.assert_allclose(step, expected[: size + 4], rtol=1e-8, atol=1e-10)
    landmarks, slope, damped_sum, squared = system.back_substitute(step)
    np.testing.assert_allclose(landmarks[1:].reshape(-1), expected[size + 4 :], rtol=1e-8, atol=1e-10)
    assert (landmarks[0] == 0.0).all()
    np.testing.assert_allclose(slope, landmark_gradient @ expected[size + 4 :], rtol=1e-8)
    np.testing.assert_allclose(squared, np.sum(expected[size + 4 :] ** 2), rtol=1e-8)
    diagonal = np.clip(np.diag(full)[size + 4 :], 1e-6, 1e32)
    np.testing.assert_allclose(damped_sum, np.sum(diagonal * expected[size + 4 :] ** 2), rtol=1e-8)


def check(call: Any, arguments: Arguments, data: st.DataObject) -> None:
    """Spoil one array of valid arguments; the call must refuse it by name or, where it may differ, not crash."""
    name = data.draw(st.sampled_from(sorted(arguments)))
    arguments[name], kind = spoil(arguments[name], data, name in ("sigma", "weight"))
    together = kind == "length" and name in ("pose", "landmark", "uv", "sigma", "weight", "depth", "landmark_free")
    # -1 is a frozen column; one column less is another system.
    other_system = name == "columns" and kind in ("range", "length")
    if (kind == "value" and name in MAY_BE_NAN) or together or other_system:
        message = "stored_rows"
        try:
            call(arguments)
        except (ValueError, TypeError) as error:
            message = str(error)
        assert any(n in message for n in (*arguments, "stored_rows"))
        return
    with pytest.raises((ValueError, TypeError)) as caught:
        call(arguments)
    assert name in str(caught.value), str(caught.value)


@settings(max_examples=200, deadline=None)
@given(data=st.data(), seed=st.integers(0, 100))
def test_malformed_plans_are_refused_by_name(data: st.DataObject, seed: int) -> None:
    def call(arguments: Arguments) -> None:
        system = make_system(arguments)
        system.energies(**make_state(np.random.default_rng(0)))
        system.linearize(**make_state(np.random.default_rng(0)))

    arguments = make_plan(np.random.default_rng(seed))
    call(arguments)
    check(call, arguments, data)


@settings(max_examples=100, deadline=None)
@given(data=st.data(), method=st.sampled_from(("energies", "linearize", "settle_landmarks")))
def test_malformed_states_are_refused_by_name(data: st.DataObject, method: str) -> None:
    rng = np.random.default_rng(0)
    system = make_system(make_plan(rng))
    more = {"iterations": 3, "min_diagonal": 1e-6, "max_diagonal": 1e32} if method == "settle_landmarks" else {}
    check(lambda arguments: getattr(system, method)(**arguments, **more), make_state(rng), data)


def test_steps_of_landmarks_are_checked() -> None:
    rng = np.random.default_rng(0)
    system, state = make_system(make_plan(rng)), make_state(rng)
    with pytest.raises(ValueError, match="iterations"):
        system.settle_landmarks(**state, iterations=-1, min_diagonal=1e-6, max_diagonal=1e32)
    with pytest.raises(ValueError, match="min_diagonal"):
        system.settle_landmarks(**state, iterations=1, min_diagonal=1.0, max_diagonal=0.5)
    rest = system.settle_landmarks(**state, iterations=0, min_diagonal=1e-6, max_diagonal=1e32)
    np.testing.assert_array_equal(rest, state["landmarks"])


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_malformed_camera_systems_are_refused_by_name(data: st.DataObject) -> None:
    rng = np.random.default_rng(0)
    system = make_system(make_plan(rng))
    arrays = system.linearize(**make_state(rng))[:4]
    arguments = dict(zip(("core", "border", "corner", "gradient"), arrays, strict=True))
    check(lambda a: system.reduce(0.1, 1e-6, 1e32, **a), dict(arguments), data)
    assert system.reduce(0.1, 1e-6, 1e32, **arguments) is not None
    check(lambda a: system.back_substitute(**a), {"camera_step": rng.normal(size=25)}, data)


@settings(max_examples=100, deadline=None)
@given(
    frames=st.integers(-3, 6), stored=st.integers(-2, 30), banded=st.booleans(), kernel=st.integers(-2, 7),
    threshold=st.floats(), threads=st.integers(-2, 5),
)  # fmt: skip
def test_numbers_are_checked(
    frames: int, stored: int, banded: bool, kernel: int, threshold: float, threads: int
) -> None:
    rng = np.random.default_rng(0)
    options = {"num_frames": frames, "stored_rows": stored, "banded": banded, "kernel": kernel}
    options |= {"threshold": threshold, "threads": threads}
    if frames == FRAMES and stored == 21 and 0 <= kernel < 5 and 0 < threshold < np.inf and threads >= 0:
        make_system(make_plan(rng), **options)
        return
    with pytest.raises(ValueError, match=r"pose|columns|stored_rows|kernel|threshold|threads|num_frames"):
        make_system(make_plan(rng), **options)


@pytest.mark.parametrize("damping", [-1.0, np.nan, np.inf])
def test_damping_is_checked(damping: float) -> None:
    rng = np.random.default_rng(0)
    system = make_system(make_plan(rng))
    arrays = system.linearize(**make_state(rng))[:4]
    with pytest.raises(ValueError, match="damping"):
        system.reduce(damping, 1e-6, 1e32, *arrays)
    with pytest.raises(ValueError, match="min_diagonal"):
        system.reduce(0.1, 1.0, 0.5, *arrays)


def test_calls_out_of_order_are_refused() -> None:
    rng = np.random.default_rng(0)
    system, state = make_system(make_plan(rng)), make_state(rng)
    zeros = [np.zeros(shape) for shape in ((21, 21), (21, 4), (4, 4), (25,))]
    with pytest.raises(ValueError, match="linearize first"):
        system.reduce(0.1, 1e-6, 1e32, *zeros)
    with pytest.raises(ValueError, match="linearize first"):
        system.landmark_blocks()
    with pytest.raises(ValueError, match="reduce first"):
        system.back_substitute(np.zeros(25))
    arrays = system.linearize(**state)[:4]
    system.reduce(0.1, 1e-6, 1e32, *arrays)
    system.back_substitute(np.zeros(25))
    system.linearize(**state)
    with pytest.raises(ValueError, match="reduce first"):
        system.back_substitute(np.zeros(25))


def test_nothing_at_all() -> None:
    empty = np.zeros(0, dtype=np.int64)
    system = _core.LandmarkSystem([], [], 0, empty, empty.reshape(0, 7), False, 0, False)
    state = (np.zeros((0, 4, 4)), np.ones(4), np.zeros(0), np.zeros((0, 3)))
    assert system.energies(*state).shape == (0,)
    arrays = system.linearize(*state)
    assert arrays[4:] == (0.0, True)
    assert system.reduce(0.1, 1e-6, 1e32, *arrays[:4]) is not None
    assert system.back_substitute(np.zeros(4))[1:] == (0.0, 0.0, 0.0)
