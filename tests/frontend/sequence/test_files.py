"""Files that are whole or absent, and array files that are checked before they are believed."""

from __future__ import annotations

import errno
import json
import zipfile
import zlib
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg import files
from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import (
    atomic_path,
    atomic_write_json,
    atomic_write_text,
    load_npy,
    load_npz,
    save_npy,
    save_npz,
)


def write_half_then_raise(target: Path, error: BaseException) -> None:
    with atomic_path(target) as temporary:
        temporary.write_text("half")
        raise error


def test_atomic_path_replaces_only_on_success(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "result.npy"
    with atomic_path(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == ".npy"
        temporary.write_text("first")
        assert not target.exists()
    assert target.read_text() == "first"
    with pytest.raises(ZeroDivisionError):
        write_half_then_raise(target, ZeroDivisionError())
    assert target.read_text() == "first"
    assert [p.name for p in target.parent.iterdir()] == ["result.npy"]


def test_disk_full_is_one_clear_sentence(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    with pytest.raises(OutputError) as raised:
        write_half_then_raise(target, OSError(errno.ENOSPC, "No space left on device"))
    assert str(raised.value) == (f"cannot write {target}: No space left on device; free space or choose another --out")
    assert list(tmp_path.iterdir()) == []


def test_short_write_of_numpy_counts_as_disk_full(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No space left on device; free space"):
        write_half_then_raise(tmp_path / "a", OSError("5242880 requested and 0 written"))


def test_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"cannot write .*; choose another --out"):
        atomic_write_text(tmp_path / "file" / "a.txt", "x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*folder"):
        atomic_write_text(tmp_path / "folder", "x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_symbolic_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "there" / "real.txt")
    atomic_write_text(link, "text")
    assert link.is_symlink()
    assert (tmp_path / "there" / "real.txt").read_text() == "text"


def test_json_is_strict(tmp_path: Path) -> None:
    class Color(Enum):
        RED = "red"

    value = {
        "nan": float("nan"),
        "inf": np.float32(np.inf),
        "array": np.array([[1.5, np.nan]]),
        "flag": np.bool_(True),
        "path": Path("a/b"),
        "pair": (1, np.int64(2)),
        "color": Color.RED,
        3: None,
    }
    atomic_write_json(tmp_path / "a.json", value)
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "nan": None,
        "inf": None,
        "array": [[1.5, None]],
        "flag": True,
        "path": "a/b",
        "pair": [1, 2],
        "color": "red",
        "3": None,
    }
    with pytest.raises(TypeError):
        atomic_write_json(tmp_path / "b.json", {"a": object()})
    assert not (tmp_path / "b.json").exists()


def test_npz_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    arrays = {
        "file": np.arange(6, dtype=np.float32).reshape(2, 3),
        "flag": np.array([True, False]),
        "empty": np.zeros((0, 4, 2)),
        "scalar": np.int32(7),
        "name": "kitchen",
    }
    save_npz(path, **arrays)
    loaded = load_npz(path, {"file": 2, "empty": 3})
    assert set(loaded) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(loaded[name], array)
        assert loaded[name].dtype == np.asarray(array).dtype
    assert set(load_npz(path, {"flag": 1}, {"scalar": 0, "absent": 2})) == {"flag", "scalar"}
    with np.load(path, allow_pickle=False) as archive:
        assert str(archive["name"]) == "kitchen"


def test_arrays_are_compressed_at_level_three(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save_npz(path, values=np.random.default_rng(0).integers(0, 50, 100_000).astype(np.int32))
    with zipfile.ZipFile(path) as archive:
        (entry,) = archive.infolist()
        data = archive.read(entry)
    sizes = []
    for level in (3, 6):
        packer = zlib.compressobj(level, zlib.DEFLATED, -15)
        sizes.append(len(packer.compress(data)) + len(packer.flush()))
    assert entry.date_time == (1980, 1, 1, 0, 0, 0)
    assert abs(entry.compress_size - sizes[0]) < 0.1 * abs(sizes[1] - sizes[0])


def test_npz_refuses_what_it_should(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save_npz(path, uv=np.zeros((2, 3)), word="text")
    with pytest.raises(InputError, match=r"lacks 'visible'; it holds 'uv', 'word'"):
        load_npz(path, {"uv": 2, "visible": 2})
    with pytest.raises(InputError, match=r"'uv' has shape \(2, 3\), but 3 dimensions"):
        load_npz(path, {"uv": 3})
    with pytest.raises(InputError, match="'word' has dtype <U4, but numbers"):
        load_npz(path, {"word": 0})
    with pytest.raises(InputError, match="no such file"):
        load_npz(tmp_path / "absent.npz", {})
    with pytest.raises(InputError, match="is a folder"):
        load_npz(tmp_path, {})
    with pytest.raises(ValueError, match="'bad' is an object array"):
        save_npz(tmp_path / "b.npz", bad=np.array([None, 1], dtype=object))
    assert not (tmp_path / "b.npz").exists()


@pytest.mark.parametrize("letters", [100, 8191, 8192, 100_000])
def test_a_text_of_any_length_is_compressed(tmp_path: Path, letters: int) -> None:
    text = "a summary; " * (letters // 11 + 1)
    save_npz(tmp_path / "a.npz", summary=np.array(text[:letters]))
    assert (tmp_path / "a.npz").stat().st_size < 1200 + 0.05 * letters
    assert str(load_npz(tmp_path / "a.npz", {"summary": None})["summary"]) == text[:letters]


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    objects = np.array([{"a": 1}], dtype=object)
    np.savez(tmp_path / "a.npz", uv=objects)
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    with pytest.raises(InputError, match="holds Python objects"):
        load_npz(tmp_path / "a.npz", {"uv": None})
    with pytest.raises(InputError, match="holds Python objects"):
        load_npy(tmp_path / "a.npy")
    np.savez(tmp_path / "b.npz", uv=np.zeros(3), notes=objects)
    assert set(load_npz(tmp_path / "b.npz", {"uv": 1}, {})) == {"uv"}


def test_zip_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.npz"
    save_npz(path, a=np.zeros(1000))
    monkeypatch.setattr(files, "MAX_NPZ_BYTES", 4000)
    with pytest.raises(InputError, match="more than"):
        load_npz(path, {"a": 1})


def test_header_that_lies_about_its_size(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive, archive.open("a.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 10**6)})
    with pytest.raises(InputError, match="cut short"):
        load_npz(path, {"a": 2})


@pytest.mark.filterwarnings(
    "ignore:Reading `.npy`", "ignore:invalid escape:DeprecationWarning", "ignore:invalid escape:SyntaxWarning"
)
@pytest.mark.parametrize("value", b"\x00 z'{}()[]:,9#\\\n\xff")
def test_any_altered_byte_of_a_header_is_an_input_error_or_harmless(tmp_path: Path, value: int) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.eye(3))
    data = path.read_bytes()
    refused = 0
    for position in range(128):
        path.write_bytes(data[:position] + bytes([value]) + data[position + 1 :])
        try:
            load_npy(path)
        except InputError:
            refused += 1
    assert refused > 20


@settings(max_examples=60, deadline=None)
@given(cut=st.floats(0, 0.999), flip=st.integers(0, 10**6), value=st.integers(0, 255))
def test_damaged_npz_is_an_input_error_or_intact(
    tmp_path_factory: pytest.TempPathFactory, cut: float, flip: int, value: int
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    save_npz(folder / "a.npz", uv=np.arange(40.0).reshape(2, 10, 2), visible=np.ones((2, 10), bool))
    data = bytearray((folder / "a.npz").read_bytes())
    (folder / "cut.npz").write_bytes(data[: int(len(data) * cut)])
    with pytest.raises(InputError, match=r"cut\.npz"):
        load_npz(folder / "cut.npz", {"uv": 3})
    data[flip % len(data)] = value
    (folder / "flip.npz").write_bytes(data)
    try:
        loaded = load_npz(folder / "flip.npz", {"uv": 3})
    except InputError:
        pass
    else:
        np.testing.assert_array_equal(loaded["uv"], np.arange(40.0).reshape(2, 10, 2))


def test_npy_round_trip_and_memory_map(tmp_path: Path) -> None:
    array = np.arange(12, dtype=np.float32).reshape(3, 4)
    save_npy(tmp_path / "a.npy", array)
    mapped = load_npy(tmp_path / "a.npy", memory_map=True)
    assert isinstance(mapped, np.memmap)
    np.testing.assert_array_equal(mapped, array)
    save_npy(tmp_path / "empty.npy", np.zeros((0, 3)))
    assert load_npy(tmp_path / "empty.npy", memory_map=True).shape == (0, 3)
    with pytest.raises(ValueError, match="object array"):
        save_npy(tmp_path / "b.npy", np.array([None]))


@pytest.mark.parametrize("keep", [0, 3, 40, 100, 150])
def test_truncated_npy(tmp_path: Path, keep: int) -> None:
    save_npy(tmp_path / "a.npy", np.zeros((10, 10)))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:keep])
    with pytest.raises(InputError, match=r"cut\.npy"):
        load_npy(tmp_path / "cut.npy", memory_map=True)


def test_npy_of_text(tmp_path: Path) -> None:
    save_npy(tmp_path / "a.npy", np.array(["a"]))
    with pytest.raises(InputError, match="not numeric"):
        load_npy(tmp_path / "a.npy")
    with pytest.raises(InputError, match="no such file"):
        load_npy(tmp_path / "none.npy")
