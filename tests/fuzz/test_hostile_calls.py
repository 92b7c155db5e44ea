"""Calls of the library and of the extension with anything, and scenes that determine little."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import judged
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.config.load import load_config
from uni4d_fg.errors import InputError, Uni4dFgError
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.pipeline import RunSummary, reconstruct
from uni4d_fg.results.io import load_reconstruction

hostile = settings(settings.get_profile("hostile"))
few = settings(hostile, max_examples=max(2, hostile.max_examples // 10))

ARRAYS = st.builds(
    lambda shape, dtype, value: np.full(shape, value).astype(dtype),
    st.lists(st.sampled_from([0, 1, 3, 4, 6, 60, 80]), max_size=4).map(tuple),
    st.sampled_from(["u1", "u2", "i4", "i8", "f4", "f8", "?", "c8", "O", "U2"]),
    st.sampled_from([0, 1, 7]),
)


def frames_of(sequence: Sequence, name: str) -> np.ndarray:
    return np.stack(list(getattr(sequence, name)))


@hostile
@given(name=st.sampled_from(["images", "depths", "masks"]), array=ARRAYS, frame=st.integers(0, 5))
def test_sequences_in_memory(
    sequence_folder: Path, tmp_path_factory: pytest.TempPathFactory, name: str, array: Any, frame: int
) -> None:
    sequence = read_sequence(sequence_folder)
    frames = list(getattr(sequence, name))
    if frames[frame].shape == array.shape and frames[frame].dtype == array.dtype:
        return
    frames[frame] = array
    run = tmp_path_factory.getbasetemp() / "refused"
    error = judged(reconstruct, dataclasses.replace(sequence, **{name: frames}), run, load_config("fast"))
    # Another type of whole numbers is as good for masks; nothing else is.
    if not (name == "masks" and array.shape == (60, 80)) and not (name == "depths" and array.shape == (60, 80)):
        assert isinstance(error, InputError)
        assert f"of frame {frame}" in str(error)
    shutil.rmtree(run, ignore_errors=True)


@hostile
@given(name=st.sampled_from(["intrinsics", "timestamps", "initial_world_T_cam"]), array=ARRAYS)
def test_calibrations_in_memory(
    sequence_folder: Path, tmp_path_factory: pytest.TempPathFactory, name: str, array: Any
) -> None:
    if array.shape == (4,):  # perhaps a calibration
        return
    sequence = dataclasses.replace(read_sequence(sequence_folder), **{name: array})
    assert isinstance(
        judged(reconstruct, sequence, tmp_path_factory.getbasetemp() / "refused", load_config("fast")), InputError
    )


def test_the_error_does_not_hold_the_array(sequence_folder: Path, tmp_path: Path) -> None:
    for shape in ((60, 60, 0), (2, 2), (5,)):
        sequence = dataclasses.replace(read_sequence(sequence_folder), intrinsics=np.ones(shape))
        error = judged(reconstruct, sequence, tmp_path / "run", load_config("fast"))
        assert f"intrinsics of shape {shape} are not fx, fy" in str(error)


def scenes(sequence: Sequence) -> dict[str, dict[str, Any]]:
    images, depths, masks = (frames_of(sequence, name) for name in ("images", "depths", "masks"))
    rng = np.random.default_rng(0)
    tracks = sequence.tracks
    assert tracks is not None
    return {
        "black": {"images": np.zeros_like(images), "tracks": None},
        "noise": {"images": rng.integers(0, 256, images.shape, np.uint8), "tracks": None},
        "no depth": {"depths": np.full_like(depths, np.nan)},
        "flat depth": {"depths": np.ones_like(depths)},
        "far depth": {"depths": np.full_like(depths, 1e30)},
        "near depth": {"depths": np.full_like(depths, 1e-30)},
        "infinite depth": {"depths": np.full_like(depths, np.inf)},
        "negative depth": {"depths": -depths},
        "random depth": {"depths": rng.uniform(0.1, 10, depths.shape).astype(np.float32)},
        "all moves": {"masks": np.ones_like(masks)},
        "checkerboard": {"masks": (np.indices(masks.shape).sum(axis=0) % 2).astype(np.int32)},
        "many instances": {"masks": rng.integers(0, 2**31 - 1, masks.shape).astype(np.int32)},
        "no tracks": {"tracks": tracks.select(np.zeros(tracks.num_tracks, bool))},
        "one track": {"tracks": tracks.select(np.arange(tracks.num_tracks) == 0)},
        "shuffled tracks": {"tracks": dataclasses.replace(tracks, uv=rng.permutation(tracks.uv, axis=0).copy())}
        if tracks.visible.all()
        else {"tracks": None},
        "still": {name: np.repeat(frames_of(sequence, name)[:1], 6, axis=0) for name in ("images", "depths", "masks")}
        | {"tracks": None},
        "tiny focal length": {"intrinsics": np.array([1e-6, 1e-6, 40.0, 30.0])},
        "huge focal length": {"intrinsics": np.array([1e12, 1e12, 40.0, 30.0])},
        "far times": {"timestamps": sequence.timestamps * 1e15},
    }


@pytest.mark.parametrize("number", range(19))
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_degenerate_scenes(sequence_folder: Path, tmp_path: Path, number: int) -> None:
    sequence = read_sequence(sequence_folder)
    changes = list(scenes(sequence).values())[number]
    changes = {k: ArrayFrames(v) if k in ("images", "depths", "masks") else v for k, v in changes.items()}
    config = load_config("fast", ["output.pictures=false", "output.clouds=false"])
    found = judged(reconstruct, dataclasses.replace(sequence, **changes), tmp_path / "run", config)
    if isinstance(found, RunSummary):
        load_reconstruction(tmp_path / "run" / "reconstruction.npz")  # checks that all is finite and rigid
    else:
        assert isinstance(found, Uni4dFgError)
        assert not (tmp_path / "run" / "reconstruction.npz").exists()


core = pytest.importorskip("uni4d_fg_cpp", reason="the C++ extension is not installed")._core
ANYTHING = st.one_of(ARRAYS, st.none(), st.integers(-(2**70), 2**70), st.floats(), st.text(max_size=3), st.booleans())


def _callables() -> dict[str, Any]:
    return {
        name: getattr(core, name) for name in dir(core) if not name.startswith("_") and callable(getattr(core, name))
    }


@settings(hostile, max_examples=hostile.max_examples * 3)
@given(name=st.sampled_from(sorted(_callables())), arguments=st.lists(ANYTHING, max_size=8))
def test_the_extension_takes_anything(name: str, arguments: list[Any]) -> None:
    # What a binding may raise; anything else, or the end of the process, fails.
    with contextlib.suppress(TypeError, ValueError, OverflowError, IndexError, RuntimeError):
        _callables()[name](*arguments)


def _landmark_system(rng: np.random.Generator) -> tuple[Any, tuple[np.ndarray, ...]]:
    frames, points = 4, 200
    pose = np.repeat(np.arange(frames), points)
    landmark = np.tile(np.arange(points), frames)
    world = np.column_stack([rng.uniform(-1, 1, (points, 2)), rng.uniform(3, 5, points)])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(frames)
    intrinsics = np.array([100.0, 100.0, 50.0, 40.0])
    seen = world[landmark] - poses[pose, :3, 3]
    uv = seen[:, :2] / seen[:, 2:] * 100.0 + intrinsics[2:] + rng.normal(0, 1, (len(pose), 2))
    count = len(pose)
    batch = (pose, landmark, uv, np.ones((count, 2)), np.ones(count), 0, 1.0)
    columns = np.full((frames, 7), -1, np.int64)
    columns[1:, :6] = np.arange(6 * (frames - 1)).reshape(-1, 6)
    size = 6 * (frames - 1)
    system = core.LandmarkSystem([batch], [], frames, np.ones(points, np.int64), columns, False, size, False, 2)
    return system, (poses, intrinsics, np.zeros(frames), world)


def test_one_system_in_several_threads_gives_what_it_gives_in_one(rng: np.random.Generator) -> None:
    system, state = _landmark_system(rng)
    alone = system.linearize(*state)
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: system.linearize(*state), range(300)):
            for array, wanted in zip(found[:4], alone[:4], strict=True):
                np.testing.assert_array_equal(array, wanted)
