"""The open list of factor types: every header is in it, and kernels are found by name."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from families import TWINS, TYPES, arguments_of, split_arguments
from uni4d_fg_cpp import _core

from uni4d_fg.geometry import se3

HEADERS = Path(__file__).parents[1] / "include" / "uni4d_fg" / "factors"


def test_every_header_is_listed() -> None:
    declared = {
        name for path in HEADERS.glob("*.hpp") for name in re.findall(r'kName = "(\w+)"', path.read_text("utf-8"))
    }
    assert declared == set(TYPES)
    for name in TYPES:
        for suffix in ("residual", "linearize"):
            assert callable(getattr(_core, f"{name}_{suffix}"))


@pytest.mark.parametrize("name", TWINS)
def test_arguments_are_those_of_the_python_package(name: str) -> None:
    kind, twin = TYPES[name], TWINS[name]
    assert kind["dim"] == twin.dim
    assert kind["data"] == list(twin.data)
    assert [kind["shapes"][n] for n in kind["data"]] == list(twin.data.values())
    assert [kind["shapes"][n] for n in kind["variables"]] == [v.manifold.shape for v in twin.variables]
    assert [kind["tangents"][n] for n in kind["variables"]] == [v.dim for v in twin.variables]


@pytest.mark.parametrize("name", TYPES)
def test_all_ways_of_calling_agree(name: str) -> None:
    arguments = arguments_of(name, np.random.default_rng(0), 7)
    variables, data = split_arguments(name, arguments)
    expected_r, expected_jacobians = _core.linearize(name, variables, data)
    assert expected_r.shape == (7, TYPES[name]["dim"])
    calls = [
        lambda: _core.linearize(name, tuple(variables), list(data.values()), threads=2),
        lambda: _core.linearize(name=name, variables=variables, data=dict(reversed(data.items()))),
        lambda: getattr(_core, f"{name}_linearize")(*variables, **data),
        lambda: getattr(_core, f"{name}_linearize")(**arguments, threads=1),
    ]
    if not data:
        calls.append(lambda: _core.linearize(name, variables))
    for call in calls:
        r, jacobians = call()
        np.testing.assert_array_equal(r, expected_r)
        for mine, theirs in zip(jacobians, expected_jacobians, strict=True):
            np.testing.assert_array_equal(mine, theirs)
    for r in (
        _core.residual(name, variables, data),
        _core.residual(name, variables, list(data.values())),
        getattr(_core, f"{name}_residual")(*variables, **data),
    ):
        np.testing.assert_allclose(r, expected_r, rtol=1e-13, atol=1e-13)


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    for call in (_core.residual, _core.linearize):
        with pytest.raises(ValueError, match=r"factor type 'gps': .*has none of this name; it has .*point_position"):
            call("gps", [np.zeros((1, 3))], {})


def test_wrong_arguments_are_refused_by_name() -> None:
    pose, uv = np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 2))
    point, k = np.ones((2, 3)), np.ones((2, 4))
    variables, known = [pose, point, k], r"variables \(world_T_cam, landmark, intrinsics\)"
    with pytest.raises(ValueError, match=rf"static_reprojection: expected 3 {known}, got 2"):
        _core.residual("static_reprojection", [pose, point], {"uv": uv})
    with pytest.raises(ValueError, match=r"static_reprojection: data 'uv' is missing"):
        _core.residual("static_reprojection", variables, {"pixel": uv})
    with pytest.raises(ValueError, match=r"static_reprojection: expected 1 data \(uv\), got \['uv', 'depth'\]"):
        _core.residual("static_reprojection", variables, {"uv": uv, "depth": uv})
    for data in ([], [uv, uv], None):
        with pytest.raises(ValueError, match=r"static_reprojection: expected 1 data \(uv\), got [02]"):
            _core.residual("static_reprojection", variables, data)
    for bad in (3.0, "abc"):
        with pytest.raises(TypeError, match="static_reprojection: variables: expected a list of arrays"):
            _core.residual("static_reprojection", bad, {"uv": uv})
    with pytest.raises(TypeError, match="static_reprojection: data: expected a dict or a list of arrays"):
        _core.residual("static_reprojection", variables, "uv")
    with pytest.raises(ValueError, match=r"^landmark: expected float64 \(2, 3\) C-contiguous, got float64 \(3, 3\)$"):
        _core.residual("static_reprojection", [pose, np.ones((3, 3)), k], {"uv": uv})
    for positional, named, message in (
        ((pose, point, k, uv), {}, r"expected at most 3 positional arguments"),
        ((pose, point), {"landmark": point, "uv": uv}, r"'landmark' is given twice"),
        ((pose, point, k), {}, r"'uv' is missing"),
        ((pose, point, k), {"uv": uv, "pixel": uv}, r"expected the variables .*, got \['uv', 'pixel'\]"),
        ((pose, point, k), {"uv": uv, "threads": "many"}, r"threads: expected an int"),
    ):
        with pytest.raises(TypeError, match=f"static_reprojection: {message}"):
            _core.static_reprojection_residual(*positional, **named)


def test_positions() -> None:
    rng = np.random.default_rng(3)
    pose, measured = se3.se3_exp(rng.normal(size=(4, 6))), rng.normal(size=(4, 3))
    r, (jacobian,) = _core.linearize("camera_position", [pose], [measured])
    np.testing.assert_array_equal(r, pose[:, :3, 3] - measured)
    np.testing.assert_array_equal(jacobian[:, :, :3], 0.0)
    np.testing.assert_array_equal(jacobian[:, :, 3:], pose[:, :3, :3])
    point = rng.normal(size=(4, 3))
    r, (jacobian,) = _core.linearize("point_position", [point], [measured])
    np.testing.assert_array_equal(r, point - measured)
    np.testing.assert_array_equal(jacobian, np.tile(np.eye(3), (4, 1, 1)))
