"""What an incremental solve refuses, and that nobody outside can reach into it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stream_samples import no_tracks, stream, stream_config, tracks_of

from uni4d_fg.config.load import load_config
from uni4d_fg.errors import ConfigError, DegenerateProblemError, InputError, SolverError
from uni4d_fg.slam.incremental import FrameTracks, IncrementalReconstructor
from uni4d_fg.slam.incremental.dynamic import DynamicWindow

FRAMES = 8
FEW = {"grid_columns": 14, "grid_rows": 10}


def solver_and_sequence() -> tuple[IncrementalReconstructor, Any]:
    sequence = stream(FRAMES, **FEW)
    return IncrementalReconstructor(sequence.intrinsics, sequence.image_size, stream_config()), sequence


def add(solver: IncrementalReconstructor, sequence: Any, frame: int) -> Any:
    return solver.add_frame(
        sequence.images[frame], sequence.depths[frame], sequence.masks[frame], tracks_of(sequence, frame),
        float(sequence.timestamps[frame]),
    )  # fmt: skip


def arrays_of(value: Any) -> list[np.ndarray]:
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, tuple):
        return [array for item in value for array in arrays_of(item)]
    if dataclasses.is_dataclass(value):
        return [a for field in dataclasses.fields(value) for a in arrays_of(getattr(value, field.name))]
    return []


def test_no_frame_is_taken_after_the_end() -> None:
    solver, sequence = solver_and_sequence()
    for frame in range(4):
        add(solver, sequence, frame)
    assert solver.finish().num_frames == 4
    with pytest.raises(SolverError, match="was finished"):
        add(solver, sequence, 4)
    assert solver.finish().num_frames == 4


def test_an_exception_within_a_frame_closes_the_solve(monkeypatch: pytest.MonkeyPatch) -> None:
    solver, sequence = solver_and_sequence()
    add(solver, sequence, 0)

    def fail(*_: object) -> None:
        raise MemoryError("injected")

    with monkeypatch.context() as patch:
        patch.setattr(DynamicWindow, "append", fail)
        with pytest.raises(MemoryError):
            add(solver, sequence, 1)
    with pytest.raises(SolverError, match="an earlier frame ended with MemoryError"):
        add(solver, sequence, 2)


def test_a_refused_frame_changes_nothing() -> None:
    solver, sequence = solver_and_sequence()
    other, _ = solver_and_sequence()
    for frame in range(FRAMES):
        with pytest.raises(InputError):
            solver.add_frame(sequence.images[frame][:5], sequence.depths[frame], tracks=no_tracks())
        np.testing.assert_array_equal(add(solver, sequence, frame).world_T_cam, add(other, sequence, frame).world_T_cam)


def test_writing_into_what_was_handed_out_or_in_changes_nothing() -> None:
    solver, sequence = solver_and_sequence()
    other, _ = solver_and_sequence()
    for frame in range(FRAMES):
        image, depth, mask = (np.array(s[frame]) for s in (sequence.images, sequence.depths, sequence.masks))
        tracks = tracks_of(sequence, frame)
        update = solver.add_frame(image, depth, mask, tracks, float(sequence.timestamps[frame]))
        expected = add(other, sequence, frame)
        for array, wanted in zip(arrays_of(update), arrays_of(expected), strict=True):
            np.testing.assert_array_equal(array, wanted)
        for array in (*arrays_of(update), image, depth, mask, tracks.track, tracks.uv, solver.intrinsics):
            array[...] = 1
    found, wanted = solver.finish(), other.finish()
    for name in found.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)


def test_tracks_are_given_for_all_frames_or_for_none() -> None:
    solver, sequence = solver_and_sequence()
    add(solver, sequence, 0)
    with pytest.raises(InputError, match="for some frames and not for others"):
        solver.add_frame(sequence.images[1], sequence.depths[1])
    other, _ = solver_and_sequence()
    other.add_frame(sequence.images[0], sequence.depths[0])
    with pytest.raises(InputError, match="for some frames and not for others"):
        other.add_frame(sequence.images[1], sequence.depths[1], tracks=tracks_of(sequence, 1))


SIZE = (120, 160)
GOOD = {
    "image": np.zeros((*SIZE, 3), np.uint8),
    "depth": np.ones(SIZE, np.float32),
    "mask": np.zeros(SIZE, np.int32),
    "timestamp": 0.0,
}
BAD: dict[str, list[Any]] = {
    "image": [
        None, "image", [[1, 2], [3]], np.zeros(SIZE, np.float32), np.zeros((*SIZE, 4), np.uint8), np.zeros((*SIZE, 0)),
        np.zeros((*SIZE, 3), np.uint16), np.zeros((3, *SIZE), np.uint8), np.zeros((*SIZE, 3), object), np.uint8(3),
    ],
    "depth": [
        None, 1.0, np.zeros((*SIZE, 1)), np.zeros(SIZE, complex), np.full(SIZE, "far"), np.zeros(SIZE[::-1]),
        np.zeros(SIZE, object), np.full(SIZE, 2500, np.uint16), np.full(SIZE, 2, np.int64),
        np.full(SIZE, 2500.0), np.full(SIZE, 0.01), np.linspace(-3.0, -2.0, SIZE[0] * SIZE[1]).reshape(SIZE),
    ],
    "mask": [
        np.full(SIZE, 2**40), np.full(SIZE, -1), np.zeros(SIZE), np.zeros(SIZE[::-1], int), "mask",
        np.full(SIZE, 2**63, np.uint64),
    ],
    "timestamp": ["now", float("nan"), float("inf"), 10**400, [1.0]],
    "tracks": [
        (np.zeros(0), np.zeros((0, 2))), FrameTracks(np.array([0.5]), np.zeros((1, 2))),
        FrameTracks(np.array([2**62], np.uint64), np.zeros((1, 2))),
        FrameTracks(np.array([0]), np.array([[1e30, 0.0]])),
    ],
}  # fmt: skip


@pytest.mark.parametrize(("name", "number"), [(name, n) for name, values in BAD.items() for n in range(len(values))])
def test_what_is_no_frame_is_one_clear_error(name: str, number: int) -> None:
    solver = IncrementalReconstructor(np.array([150.0, 150.0, 80.0, 60.0]), SIZE, stream_config())
    with pytest.raises(InputError, match=r"^frame 0: "):
        solver.add_frame(**{**GOOD, name: BAD[name][number]})
    assert solver.add_frame(**GOOD).frame == 0


@pytest.mark.parametrize("size", [(0, 5), (4.0, 4), None, (1, 2, 3), "ab", (-3, 3)])
def test_what_is_no_image_size_is_one_clear_error(size: Any) -> None:
    with pytest.raises(InputError, match="image_size"):
        IncrementalReconstructor(np.array([150.0, 150.0, 80.0, 60.0]), size, stream_config())


def test_depth_without_a_unit_and_depth_in_another_unit_are_told_apart() -> None:
    solver = IncrementalReconstructor(np.array([150.0, 150.0, 80.0, 60.0]), SIZE, stream_config())
    for depth, message in (
        (np.full(SIZE, 2500, np.uint16), "frame 0: depth holds uint16 values of unknown unit; give meters as floats"),
        (np.full(SIZE, 2500.0), r"frame 0: depth lies outside 0\.05 to 80 m in every pixel \(its median is 2500\)"),
        (-np.linspace(1.0, 2.0, SIZE[1]) * np.ones((SIZE[0], 1)), "frame 0: depth is negative wherever it is finite"),
    ):
        with pytest.raises(InputError, match=message):
            solver.add_frame(**{**GOOD, "depth": depth})
    solver.add_frame(**GOOD)
    later = {**GOOD, "depth": np.full(SIZE, 2500.0), "timestamp": 1.0}
    assert solver.add_frame(**later).frame == 1, "a camera may turn to what is too far"


@pytest.mark.parametrize("missing", [np.nan, 0.0, -1.0])
def test_a_stream_without_any_depth_has_no_result(missing: float) -> None:
    solver = IncrementalReconstructor(np.array([150.0, 150.0, 80.0, 60.0]), SIZE, stream_config())
    nothing = {**GOOD, "depth": np.full(SIZE, missing)}
    for time in (0.0, 0.0, 1.0):
        solver.add_frame(**{**nothing, "timestamp": time})
    with pytest.raises(DegenerateProblemError, match="none of the 2 frames has depth"):
        solver.finish()
    solver.add_frame(**{**GOOD, "timestamp": 2.0})
    assert solver.finish().num_frames == 3


@pytest.mark.parametrize("center", [(800.0, 60.0), (80.0, -1.0)])
def test_a_principal_point_outside_the_image_is_refused(center: tuple[float, float]) -> None:
    with pytest.raises(InputError, match=r"principal point \(.*\) lies outside the image of 160 x 120 px"):
        IncrementalReconstructor(np.array([150.0, 150.0, *center]), SIZE, stream_config())


@settings(max_examples=25)
@given(
    shape=st.lists(st.integers(0, 6), max_size=4).map(tuple),
    dtype=st.sampled_from(["u1", "i8", "f4", "c8", "?", "U3", "M8[s]", "O"]),
    name=st.sampled_from(["image", "depth", "mask"]),
)
def test_any_small_array_is_refused_or_taken(shape: tuple[int, ...], dtype: str, name: str) -> None:
    solver = IncrementalReconstructor(np.array([5.0, 5.0, 2.0, 2.0]), (4, 5), stream_config())
    good = {
        "image": np.zeros((4, 5, 3), np.uint8), "depth": np.ones((4, 5), np.float32),
        "mask": np.zeros((4, 5), np.int32), "tracks": no_tracks(),
    }  # fmt: skip
    try:
        solver.add_frame(**{**good, name: np.zeros(shape, dtype)})
    except InputError as error:
        assert str(error).startswith("frame 0: ")  # noqa: PT017 - taking it is right too


def test_a_preset_is_taken_by_its_name() -> None:
    sequence = stream(FRAMES, **FEW)
    arguments = (sequence.intrinsics, sequence.image_size)
    assert IncrementalReconstructor(*arguments, "fast").config == load_config("fast")
    assert IncrementalReconstructor(*arguments).config == load_config()
    with pytest.raises(ConfigError, match="fsat: no such preset or file; did you mean fast"):
        IncrementalReconstructor(*arguments, "fsat")
    with pytest.raises(SolverError, match="additions: a list of sources is expected"):
        IncrementalReconstructor(*arguments, additions=lambda stage, state: None)  # type: ignore[arg-type]
