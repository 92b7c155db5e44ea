"""Reading what may come from anywhere: regular files only, no more of them than is sensible, every failure an error.

A pipe, a device or a socket in place of a file would hang the reader or fill the memory. A link that leads nowhere is
not the same as no file: whoever made it meant something to be there.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

from uni4d_fg.errors import InputError

MAX_TEXT_BYTES = 64 * 1024**2
MAX_JSON_BYTES = 1024**3
MAX_IMAGE_BYTES = 1024**3

_KINDS = (
    (stat.S_ISDIR, "is a folder"),
    (stat.S_ISFIFO, "is a pipe, not a file"),
    (stat.S_ISSOCK, "is a socket, not a file"),
    (stat.S_ISCHR, "is a device, not a file"),
    (stat.S_ISBLK, "is a device, not a file"),
)


def read_failure(path: Path | str, error: OSError | ValueError | RuntimeError) -> InputError:
    """Return the error to raise when reading ``path`` failed: what, where, and what to do."""
    number = getattr(error, "errno", None)
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if number == errno.ELOOP or "ymlink loop" in str(error):
        return InputError(f"{path}: is a link that leads in a circle; replace it by the file that is meant")
    if number == errno.ENAMETOOLONG:
        return InputError(f"{str(path)[:60]}...: the name is too long for this file system; choose a shorter one")
    if number == errno.ENOENT:
        return InputError(f"{path}: no such file or folder; check the path")
    if number in (errno.EACCES, errno.EPERM):
        return InputError(f"{path}: cannot be read ({reason}); check its permissions")
    return InputError(f"{path}: cannot be read ({reason}); check the path")


def is_present(path: Path) -> bool:
    """Tell whether something is there.

    Raises:
        InputError: If a link is there that leads nowhere or in a circle, or the name cannot be looked up.
    """
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError) as error:
        raise read_failure(path, error) from error
    _stat(path, "a file or folder")
    return True


def expanded(name: str | Path) -> Path:
    """Return a path with ``~`` and ``~user`` replaced by home folders.

    Raises:
        InputError: If there is no such user.
    """
    try:
        return Path(name).expanduser()
    except RuntimeError as error:
        raise InputError(f"{name}: there is no such user, or no home folder; write the path out") from error


def resolved(path: Path) -> Path:
    """Return the absolute path without links.

    Raises:
        InputError: If links lead in a circle, or the working directory is gone.
    """
    try:
        return path.resolve()
    except FileNotFoundError as error:
        raise InputError(f"{path}: the working directory no longer exists; change to another one") from error
    except (OSError, RuntimeError) as error:
        raise read_failure(path, error) from error


def check_regular(path: Path, what: str = "a file") -> int:
    """Make sure that there is a regular file that can be read to its end; a link to one will do.

    Args:
        path: The file.
        what: What is expected there, with its article, for the message.

    Returns:
        Its size in bytes.

    Raises:
        InputError: If it is missing, a folder, a pipe, a device, a socket, or a link that leads nowhere or in a circle.
    """
    found = _stat(path, what)
    for is_kind, text in _KINDS:
        if is_kind(found.st_mode):
            raise InputError(f"{path}: {text}, but {what} is expected here")
    return found.st_size


def _stat(path: Path, what: str) -> os.stat_result:
    try:
        return os.stat(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        if os.path.islink(path):
            raise InputError(
                f"{path}: is a link to {os.readlink(path)}, where there is nothing; repair or remove it"
            ) from error
        raise InputError(f"{path}: no such file; {what} is expected here") from error
    except (OSError, ValueError) as error:
        raise read_failure(path, error) from error


def read_bytes(path: Path, limit: int, what: str = "a file") -> bytes:
    """Return the content of a regular file.

    Raises:
        InputError: If it is none, cannot be read, or is larger than ``limit`` bytes.
    """
    size = check_regular(path, what)
    if size > limit:
        raise InputError(f"{path}: has {size} bytes, but {what} has {limit} at most; check that it is the right file")
    try:
        with open(path, "rb") as stream:
            # One byte more than there should be shows that the file has grown since. Asked for as many as are allowed,
            # Python would map memory for all of them first.
            data = stream.read(size + 1)
            if len(data) > size:
                data += stream.read(limit + 1 - len(data))
    except OSError as error:
        raise read_failure(path, error) from error
    except MemoryError as error:
        raise InputError(f"{path}: its {size} bytes do not fit into memory; free some, or make it smaller") from error
    if len(data) > limit:
        raise InputError(f"{path}: has grown beyond {limit} bytes; check that it is the right file")
    return data


def read_text(path: Path, limit: int = MAX_TEXT_BYTES, what: str = "a text file") -> str:
    """Return the content of a regular file in UTF-8.

    Raises:
        InputError: If it cannot be read, is too large, or is not UTF-8.
    """
    try:
        return read_bytes(path, limit, what).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 (byte {error.start}); save it as UTF-8") from error


def read_json(path: Path, limit: int = MAX_JSON_BYTES) -> Any:
    """Return the content of a JSON file; NaN and infinities, which are not JSON, are refused.

    Raises:
        InputError: If it cannot be read, is too large, or is not JSON.
    """
    data = read_bytes(path, limit, "a .json file")
    try:
        return json.loads(data, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON, or is cut short ({error}); write it again") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory; make it smaller") from error


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def list_folder(folder: Path) -> list[Path]:
    """Return what is in a folder, sorted by name.

    Raises:
        InputError: If it is no folder, or cannot be read.
    """
    try:
        return [Path(folder, name) for name in sorted(os.listdir(folder))]
    except NotADirectoryError as error:
        raise InputError(f"{folder}: is a file, but a folder is expected here; check the path") from error
    except OSError as error:
        raise read_failure(folder, error) from error
