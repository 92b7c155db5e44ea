"""Malformed arrays at every entry point: refused by name, never a crash."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from entry_points import ENTRY_POINTS
from hypothesis import given, settings
from hypothesis import strategies as st
from uni4d_fg_cpp import _core

DTYPES = ("float32", "int64", "int32", "uint8", "bool", "complex128", "float16", ">f8", "object", "U3", "M8[s]")
SHAPE_CHANGES = ("longer", "shorter", "extra axis", "no axes", "last axis", "empty")


def spoil(array: np.ndarray, data: st.DataObject, negative: bool) -> tuple[Any, str]:
    """Return a malformed version of an array and what is wrong with it."""
    kinds = ["dtype", "shape", "strides", "not an array"]
    # Any byte is a gray level.
    kinds += {"f": ["value"], "u": []}.get(array.dtype.kind, ["range"])
    kinds += ["negative"] if negative else []
    kind = data.draw(st.sampled_from(kinds))
    if kind == "dtype":
        dtype = data.draw(st.sampled_from([d for d in DTYPES if np.dtype(d) != array.dtype]))
        return np.zeros(array.shape, dtype=dtype), kind
    if kind == "strides":
        choice = data.draw(st.sampled_from(("step", "reversed", "broadcast")))
        if choice == "step":
            return np.repeat(array, 2, axis=0)[::2], kind
        if choice == "reversed":
            return array[::-1], kind
        return np.broadcast_to(array[:1], array.shape), kind
    if kind == "not an array":
        return data.draw(st.sampled_from((None, [1.0], "x", 3.0, {}, object()))), kind
    spoilt = array.copy()
    if kind in ("value", "range", "negative"):
        index = data.draw(st.integers(0, array.size - 1))
        values: tuple[float, ...] = (np.nan, np.inf, -np.inf)
        if kind == "range":
            values = (-2, 10**9, -(2**63), 2**63 - 1)
        elif kind == "negative":
            values = (-1.0, -1e-300)
        spoilt.reshape(-1)[index] = data.draw(st.sampled_from(values))
        return spoilt, kind
    change = data.draw(st.sampled_from(SHAPE_CHANGES))
    if change == "longer":
        return np.concatenate([array, array[:1]]), "length"
    if change == "shorter":
        return array[:-1].copy(), "length"
    if change == "empty":
        return array[:0].copy(), "length"
    if change == "extra axis":
        return array[None].copy(), kind
    if change == "no axes":
        return np.array(array.reshape(-1)[0]), kind
    return np.repeat(array, 2, axis=-1), kind if array.ndim > 1 else "length"


def refusal(call: Callable[..., Any], arguments: dict[str, Any]) -> str | None:
    """Return the message with which a call was refused; None when it went through."""
    try:
        call(**arguments)
    except (ValueError, TypeError) as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", ENTRY_POINTS)
def test_valid_arguments_are_accepted(name: str) -> None:
    entry = ENTRY_POINTS[name]
    entry.call(**entry.make(np.random.default_rng(0)))


@pytest.mark.parametrize("name", ENTRY_POINTS)
@settings(max_examples=120, deadline=None)
@given(data=st.data(), seed=st.integers(0, 1000))
def test_malformed_arrays_are_refused_by_name(name: str, data: st.DataObject, seed: int) -> None:
    entry = ENTRY_POINTS[name]
    arguments = entry.make(np.random.default_rng(seed))
    arrays = sorted(n for n, a in arguments.items() if isinstance(a, np.ndarray) and a.size)
    argument = data.draw(st.sampled_from(arrays))
    arguments[argument], kind = spoil(arguments[argument], data, argument in entry.negative)
    # Arrays of one length stand together: when one differs, either may be called wrong; a free axis may be any.
    if kind == "length" or (kind == "shape" and argument in ("residual", "jacobians", "image")):
        message = refusal(entry.call, arguments)
        assert message is None or any(n in message for n in arrays)
        return
    if kind == "value" and argument in entry.open_values:
        entry.call(**arguments)
        return
    with pytest.raises((ValueError, TypeError)) as caught:
        entry.call(**arguments)
    assert argument in str(caught.value), str(caught.value)


@settings(max_examples=50, deadline=None)
@given(kernel=st.integers(-(2**31), 2**31 - 1), threshold=st.floats(), threads=st.integers(-5, 5))
def test_kernel_and_threads_are_checked(kernel: int, threshold: float, threads: int) -> None:
    arguments = ENTRY_POINTS["robust_energy"].make(np.random.default_rng(0))
    arguments |= {"kernel": kernel, "threshold": threshold, "threads": threads}
    valid = 0 <= kernel < 5 and 0 < threshold < np.inf and threads >= 0
    if valid:
        assert np.isfinite(_core.robust_energy(**arguments)) or threshold > 1e100 or threshold < 1e-100
        return
    with pytest.raises(ValueError, match=r"kernel|threshold|threads"):
        _core.robust_energy(**arguments)


def test_message_names_expected_and_got() -> None:
    arguments = ENTRY_POINTS["static_reprojection_residual"].make(np.random.default_rng(0))
    arguments["uv"] = arguments["uv"].astype(np.float32)
    with pytest.raises(ValueError, match=r"^uv: expected float64 \(5, 2\) C-contiguous, got float32 \(5, 2\)$"):
        _core.static_reprojection_residual(**arguments)


def test_strides_are_named() -> None:
    arguments = ENTRY_POINTS["static_reprojection_residual"].make(np.random.default_rng(0))
    arguments["uv"] = np.repeat(arguments["uv"], 2, axis=0)[::2]
    with pytest.raises(ValueError, match=r"uv: expected float64 .* got float64 \(5, 2\) with strides"):
        _core.static_reprojection_residual(**arguments)


def test_read_only_arrays_are_accepted() -> None:
    arguments = ENTRY_POINTS["static_reprojection_residual"].make(np.random.default_rng(0))
    for array in arguments.values():
        array.setflags(write=False)
    assert np.isfinite(_core.static_reprojection_residual(**arguments)).all()
