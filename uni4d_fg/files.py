"""Files that are either whole or absent, and array files that are checked before they are believed."""

from __future__ import annotations

import errno
import json
import math
import mmap
import os
import secrets
import shutil
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from pathlib import Path, PurePath
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.reading import check_regular, read_failure

MAX_NPZ_BYTES = 16 * 1024**3
"""Uncompressed size above which an array file is refused, unless it is mapped into memory."""

MAX_RATIO, FREE_BYTES = 200, 256 * 1024**2
"""An .npz that unpacks to more than so many times its size is refused, beyond that many bytes."""

_SAMPLE_BYTES = 1 << 15
_WORTH_COMPRESSING = 0.8
_CRC_MAGIC = b"\nU4DCRC1"
"""Begins what follows the data of a .npy file with checksums: a count and CRC-32 numbers of equal parts of the data."""

DAMAGED_ARCHIVE = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, KeyError, OSError, RuntimeError)

_BROKEN_HEADER = (ValueError, SyntaxError, TypeError, LookupError, AttributeError, RecursionError, tokenize.TokenError)
"""What numpy raises on the header of a damaged array: it parses it as Python, and again as Python 2's."""


def write_failure(path: Path, error: OSError) -> OutputError:
    """Return the error to raise when writing ``path`` failed: what, where, and what to do."""
    reason = error.strerror or str(error) or type(error).__name__
    if error.errno in (errno.ENOSPC, errno.EDQUOT) or "requested and" in reason:
        # ndarray.tofile reports a full disk as "N requested and M written", without an errno.
        reason = reason if error.errno else "No space left on device"
        remedy = "free space or choose another --out"
    elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        remedy = "check the permissions of the folder or choose another --out"
    else:
        remedy = "choose another --out"
    return OutputError(f"cannot write {path}: {reason}; {remedy}")


def remove_file(path: Path) -> None:
    """Remove a file, if it is there. Raises OutputError if it cannot be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise write_failure(path, error) from error


def temporary_sibling(path: Path) -> Path:
    """Return an unused hidden path in the folder of ``path`` that ends in the same name (and suffix)."""
    return path.with_name(f".tmp-{secrets.token_hex(4)}-{path.name}")


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Write a file so that it appears whole or not at all.

    Args:
        path: Where the file shall be; its folder is made if absent. A symbolic link is written through.

    Yields:
        A temporary path in the same folder, with the same suffix, to write the file to. When the block ends
        normally it is synced to disk and moved to ``path``; when it raises, it is removed.

    Raises:
        OutputError: If an ``OSError`` occurs in the block or while moving the file.
    """
    target = Path(os.path.realpath(path))
    temporary = temporary_sibling(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise write_failure(Path(path), error) from error
    finally:
        if temporary.exists():
            temporary.unlink()


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Write a folder so that it appears whole or not at all.

    Args:
        path: Where the folder shall be: absent, or an empty folder. What is there is never overwritten.

    Yields:
        A temporary folder beside it. When the block ends normally it is moved to ``path``; when it raises,
        it is removed with all it holds.

    Raises:
        OutputError: If ``path`` is in the way, or an ``OSError`` occurs in the block or while moving.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise OutputError(f"cannot write {path}: it exists already; remove it or choose another --out")
    temporary = temporary_sibling(target)
    try:
        temporary.mkdir(parents=True)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise write_failure(Path(path), error) from error
    except OutputError as error:
        raise OutputError(str(error).replace(str(temporary), str(path))) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def atomic_write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in UTF-8, whole or not at all.

    Raises:
        OutputError: If it cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _plain(value: Any) -> Any:
    """Return ``value`` in JSON's own types; NaN and infinities, which JSON lacks, become null."""
    if isinstance(value, Enum):
        return _plain(value.value)
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(_plain(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(item) for item in value]
    return value


def json_text(value: Any) -> str:
    """Return ``value`` as indented, strictly valid JSON; conversions as in :func:`atomic_write_json`.

    Raises:
        TypeError: If ``value`` holds something that JSON cannot express.
    """
    return json.dumps(_plain(value), indent=2, allow_nan=False)


def atomic_write_json(path: Path, value: Any) -> None:
    """Write ``value`` to ``path`` as indented, strictly valid JSON, whole or not at all.

    NumPy scalars and arrays, paths, enumerations and tuples are converted; NaN and infinity become null.

    Raises:
        OutputError: If it cannot be written.
        TypeError: If ``value`` holds something that JSON cannot express.
    """
    atomic_write_text(path, json_text(value) + "\n")


def save_npy(path: Path, array: npt.ArrayLike, *, checksum: bool = False) -> None:
    """Write one array to ``path`` (``.npy``), whole or not at all.

    Args:
        path: The file.
        array: Numbers, booleans or text.
        checksum: Write a checksum behind the data, where numpy does not look; :func:`load_npy` does.

    Raises:
        OutputError: If it cannot be written.
        ValueError: If it is an object array, which could not be read back without pickle.
    """
    values = np.asarray(array)
    if values.dtype.hasobject:
        raise ValueError(f"{path}: an object array cannot be saved without pickle")
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.lib.format.write_array(stream, values, allow_pickle=False)
        if checksum:
            write_checksums(stream, [zlib.crc32(np.ascontiguousarray(values).data)])


@contextmanager
def npy_stream(path: Path, dtype: str, shape: tuple[int, ...]) -> Iterator[IO[bytes]]:
    """Write the data of a ``.npy`` file piece by piece; it appears, whole, when the block ends normally.

    Plain writes raise an error when the disk is full, where a memory map would end the process without a message.

    Args:
        path: The file.
        dtype: As numpy describes it in a header: ``<f4``.
        shape: Of the whole array, in C order.

    Yields:
        The file, behind its header.

    Raises:
        OutputError: If an ``OSError`` occurs in the block or while moving the file.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
        yield stream


def write_checksums(stream: IO[bytes], checksums: Iterable[int]) -> None:
    """Write CRC-32 numbers of equal parts of the data of a ``.npy`` file (its rows, or all) behind the data."""
    numbers = np.array(list(checksums), dtype="<u4")
    stream.write(_CRC_MAGIC + np.array(len(numbers), "<u4").tobytes() + numbers.tobytes())


def load_checksums(path: Path) -> npt.NDArray[np.uint32] | None:
    """Return the CRC-32 numbers behind the data of a ``.npy`` file, (N,), or None if it has none that are whole.

    Raises:
        InputError: If the file is missing or not a ``.npy`` file.
    """
    size = check_regular(path, "a .npy file")
    with _open_to_read(path) as stream:
        shape, dtype = _array_header(stream, f"{path}")
        stream.seek(min(stream.tell() + math.prod(shape) * dtype.itemsize, size))
        # As many as the data has rows at most: what follows the data of a foreign file may be anything.
        tail = stream.read(len(_CRC_MAGIC) + 4 + 4 * max(1, *shape[:1]))
    rest = tail[len(_CRC_MAGIC) :]
    numbers: npt.NDArray[np.uint32] = np.frombuffer(rest[: len(rest) // 4 * 4], "<u4")
    whole = tail.startswith(_CRC_MAGIC) and len(numbers) > 0 and len(numbers) == 1 + int(numbers[0])
    return numbers[1:].astype(np.uint32) if whole else None


def save_npz(path: Path, /, **arrays: npt.ArrayLike) -> None:
    """Write named arrays to a ``.npz``, whole or not at all; compressed where that saves a fifth or more.

    Raises:
        OutputError: If it cannot be written.
        ValueError: If one is an object array, which could not be read back without pickle.
    """
    plain = {name: np.asarray(array) for name, array in arrays.items()}
    for name, array in plain.items():
        if array.dtype.hasobject:
            raise ValueError(f"{path}: {name!r} is an object array and cannot be saved without pickle")
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in plain.items():
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED if _compresses(array) else zipfile.ZIP_STORED
            # At level 3 measurements end 4 % larger than at the usual 6, in a third of the time. An entry that is given
            # its date does not take the archive's level.
            entry._compresslevel = 3  # type: ignore[attr-defined] # public from Python 3.13 on, under another name
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, array, allow_pickle=False)


def _compresses(array: npt.NDArray[Any]) -> bool:
    """Return whether compression is worth its time, as a part from the middle says: noise in floating point is not."""
    if array.dtype.kind == "U":
        return True  # four bytes per character; and a text may be one element, larger than the part
    part = array.reshape(-1)[array.size // 2 :][: _SAMPLE_BYTES // max(array.itemsize, 1)].tobytes()
    return len(zlib.compress(part, 1)) < _WORTH_COMPRESSING * len(part) or array.nbytes < _SAMPLE_BYTES


def load_npy(path: Path, *, memory_map: bool = False) -> npt.NDArray[Any]:
    """Read one numeric or boolean array of any shape from a ``.npy`` file.

    Args:
        path: The file.
        memory_map: Map the file read-only instead of reading it, so that only what is used is loaded.

    Raises:
        InputError: If the file is missing, truncated, not a ``.npy`` file, its dtype is not numeric, or, where it is
            read as a whole, it has a checksum that its data does not fit.
    """
    check_regular(path, "a .npy file")
    with _open_to_read(path) as stream:
        if stream.read(6) != np.lib.format.MAGIC_PREFIX:
            raise InputError(f"{path}: not a .npy file (or cut short); write it with numpy.save")
        size = path.stat().st_size
        stream.seek(0)
        shape, dtype = _array_header(stream, f"{path}")
        _check_size(shape, dtype, size - stream.tell(), f"{path}")
    if dtype.kind not in "biuf":
        raise InputError(f"{path}: dtype {dtype} is not numeric; write it again as numbers")
    if not memory_map and math.prod(shape) * dtype.itemsize > MAX_NPZ_BYTES:
        raise InputError(f"{path}: an array of shape {shape} takes more than {MAX_NPZ_BYTES // 1024**3} GiB; split it")
    try:
        array: npt.NDArray[Any] = np.load(path, mmap_mode="r" if memory_map and 0 not in shape else None)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as a .npy file ({error}); write it again") from error
    except MemoryError as error:
        raise InputError(f"{path}: an array of shape {shape} does not fit into memory") from error
    checksums = None if memory_map else load_checksums(path)
    if checksums is not None and len(checksums) == 1 and zlib.crc32(np.ascontiguousarray(array).data) != checksums[0]:
        raise InputError(f"{path}: is damaged, its checksum does not fit its data; make it again")
    return array


def forget_pages(array: npt.NDArray[Any]) -> None:
    """Let go of what was read of a memory-mapped array; it is read again when it is asked for."""
    mapped = getattr(array, "_mmap", None)
    if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)


def load_npz(
    path: Path,
    required: Mapping[str, int | None],
    optional: Mapping[str, int | None] | None = None,
    check: Callable[[dict[str, tuple[int, ...]]], None] | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """Read arrays from an ``.npz`` file that may come from anywhere; nothing in it is executed.

    Args:
        path: The file.
        required: Name to number of dimensions of the arrays that must be present. With a number the array
            must be numeric or boolean; with None it may have any rank and may hold strings.
        optional: The same for arrays that may be absent. None reads whatever else the file holds.
        check: Told the shapes of the arrays that are about to be read, before any of them is; raises to refuse them.

    Returns:
        Name to array: the required ones and those optional ones that are present.

    Raises:
        InputError: If the file is missing, truncated or not an ``.npz``, if an array is missing, has another
            rank, or is an object array, or if the arrays would take more than 16 GiB, or far more than data of that
            size on disk.
    """
    size = check_regular(path, "an .npz file")
    ranks = {**(optional or {}), **required}
    try:
        with zipfile.ZipFile(path) as archive:
            members = {
                info.filename.removesuffix(".npy"): info
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }
            missing = [name for name in required if name not in members]
            if missing:
                raise InputError(
                    f"{path}: lacks {', '.join(map(repr, missing))}; it holds "
                    f"{', '.join(map(repr, sorted(members))) or 'nothing'}"
                )
            wanted = [name for name in members if optional is None or name in ranks]
            declared = sum(members[name].file_size for name in wanted)
            if declared > MAX_NPZ_BYTES:
                raise InputError(
                    f"{path}: would take {declared / 1024**3:.1f} GiB when unpacked, more than "
                    f"{MAX_NPZ_BYTES // 1024**3} GiB; store large arrays as .npy instead"
                )
            if declared > max(FREE_BYTES, MAX_RATIO * size):
                raise InputError(
                    f"{path}: {size} bytes would unpack to {declared / 1024**2:.0f} MiB, as real data hardly does; "
                    "write it again with numpy.savez, uncompressed"
                )
            if check is not None:
                check({name: _member_header(archive, members[name], path)[0] for name in wanted})
            return {name: _read_member(archive, members[name], path, ranks.get(name)) for name in wanted}
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: its arrays do not fit into memory") from error
    except DAMAGED_ARCHIVE as error:
        if isinstance(error, PermissionError):
            raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
        raise InputError(
            f"{path}: not a readable .npz file, or cut short ({error}); write it again with numpy.savez"
        ) from error


@contextmanager
def _open_to_read(path: Path) -> Iterator[IO[bytes]]:
    try:
        stream = open(path, "rb")  # noqa: SIM115 - closed below; only the opening may become an InputError
    except OSError as error:
        raise read_failure(path, error) from error
    with stream:
        yield stream


def _array_header(stream: IO[bytes], where: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the header of a .npy stream and refuse object arrays. Returns shape and dtype."""
    try:
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        elif version == (2, 0):
            shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
        else:
            raise InputError(f"{where}: .npy format version {version} is not supported; save a plain array")
    except _BROKEN_HEADER as error:
        raise InputError(
            f"{where}: its header is not that of a .npy array ({type(error).__name__}); write it again"
        ) from error
    if dtype.hasobject:
        raise InputError(
            f"{where}: holds Python objects, which are not loaded because reading them can run code; "
            "save it as a plain numeric array"
        )
    if not all(type(n) is int for n in shape):  # numpy takes True for a number here, and fails on it later
        raise InputError(f"{where}: shape {shape} is not of whole numbers; write it again")
    return shape, dtype


def _check_size(shape: tuple[int, ...], dtype: np.dtype[Any], available: int, where: str) -> None:
    """Refuse a header that announces more data than there is, before memory is set aside for it."""
    expected = math.prod(shape) * dtype.itemsize
    if any(n < 0 for n in shape) or expected > available:
        raise InputError(
            f"{where}: cut short: shape {shape} of {dtype} takes {expected} bytes, "
            f"but only {available} follow; write it again"
        )


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path, ndim: int | None) -> npt.NDArray[Any]:
    where = f"{path}: array {info.filename.removesuffix('.npy')!r}"
    shape, dtype = _member_header(archive, info, path)
    if ndim is not None and len(shape) != ndim:
        raise InputError(f"{where} has shape {shape}, but {ndim} dimensions are expected")
    if ndim is not None and dtype.kind not in "biuf":
        raise InputError(f"{where} has dtype {dtype}, but numbers are expected")
    with archive.open(info) as stream:
        array: npt.NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array


def _member_header(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path
) -> tuple[tuple[int, ...], np.dtype[Any]]:
    where = f"{path}: array {info.filename.removesuffix('.npy')!r}"
    with archive.open(info) as stream:
        shape, dtype = _array_header(stream, where)
        _check_size(shape, dtype, info.file_size - stream.tell(), where)
    return shape, dtype
