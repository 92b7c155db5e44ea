"""Which folders are runs, and which files in them are the program's own: those alone are ever removed.

A run is marked by ``run.json``, which is the first file that is written into it. What the program writes there has
known names; anything else belongs to somebody else and stays.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import atomic_write_json, remove_file, write_failure
from uni4d_fg.reading import read_json

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None  # type: ignore[assignment]

MARKER = "run.json"
STORED_INPUT = "input.json"
"""What the run is made from; the second file that the command line writes."""
EXPORT_MARKER = "export.json"
"""In the folder of every export; names its files, and says that they may be replaced."""

_PROGRAM, _FORMAT = "uni4d-fg", 1
_MAX_MARKER_BYTES = 64 * 1024**2

_TEMPORARY = re.compile(r"\.tmp-[0-9a-f]{8}-(?P<name>.+)")
_ROOT_FILES = (
    MARKER, STORED_INPUT, "config.yaml", "summary.json", "reconstruction.npz", "trajectory.tum", "depth.npy",
    "confidence.npy", "labels.npz", "report.html", "share.html", "shots.json",
)  # fmt: skip
_KNOWN = {
    "": re.compile("|".join(map(re.escape, _ROOT_FILES))),
    "clouds": re.compile(r"static\.ply"),
    "clouds/dynamic": re.compile(r"\d{5,}\.ply"),
    "pictures": re.compile(r"(trajectory|depth|scene)\.png"),
    "graphs": re.compile(r"\w+\.(graph\.npz|initial\.values|final\.values)"),
    "stages": re.compile(
        r"(tracks|rolling_shutter|lens|camera_init|structure_from_motion|bundle_adjustment|nonrigid|joint|fusion|stream|"
        r"tracks-[0-9a-f]{32})\.npz"
    ),
    "stages/windows": re.compile(r"(scene|motion|calibration)_\d{6,}\.npz"),
    "stages/stream": re.compile(r"\d{6,}\.npz"),
    "cues": re.compile(r"cues\.json"),
}
"""Folder of a run to the names of the files that are written into it."""


@dataclass(frozen=True)
class Remedies:
    """What a caller is told to give where the folder of a run is in the way."""

    resume: str
    overwrite: str
    elsewhere: str


COMMAND_LINE = Remedies("--resume", "--overwrite", "choose another --out")
PYTHON = Remedies("resume=True", "overwrite=True", "choose another folder")


def is_temporary(path: Path, folder: str = "") -> bool:
    """Tell whether a name is that of a file which was being written into a folder of a run when its process died."""
    found = _TEMPORARY.fullmatch(path.name)
    return found is not None and _KNOWN[folder].fullmatch(found["name"]) is not None


def mark_run(root: Path) -> None:
    """Mark a folder as that of a run, unless it is already. Raises OutputError."""
    if not (root / MARKER).is_file():
        atomic_write_json(root / MARKER, {"program": _PROGRAM, "format": _FORMAT})


def is_run(root: Path) -> bool:
    """Tell whether a folder is marked as that of a run, finished or not."""
    try:
        found = read_json(root / MARKER, _MAX_MARKER_BYTES)
    except InputError:
        return False
    return isinstance(found, dict) and found.get("program") == _PROGRAM


def is_free(root: Path) -> bool:
    """Tell whether a folder is absent, or holds nothing but what a dying process of ours left before it marked it."""
    if not root.is_dir():
        return not os.path.lexists(root)
    return all(is_temporary(path) for path in root.iterdir())


def is_barely_begun(root: Path) -> bool:
    """Tell whether a run ended before it made anything: it is marked, and says at most what it was to be made from."""
    return is_run(root) and all(path.name in (MARKER, STORED_INPUT) or is_temporary(path) for path in root.iterdir())


def claim_folder(root: Path, *, resume: bool, overwrite: bool, remedies: Remedies) -> bool:
    """Make sure that a run may be written to a folder, and mark it.

    Args:
        root: Of the run.
        resume: Continue an earlier run.
        overwrite: Remove an earlier run's results.
        remedies: How the caller spells these.

    Returns:
        Whether the folder holds an earlier run, which is to be continued.

    Raises:
        OutputError: If the folder holds anything but a run, or a run that is neither to be continued nor replaced.
    """
    if resume and overwrite:
        raise OutputError(f"{remedies.resume} and {remedies.overwrite} exclude each other; give one of them")
    if root.exists() and not root.is_dir():
        raise OutputError(f"{root}: is a file; {remedies.elsewhere}")
    try:
        free = is_free(root) or is_barely_begun(root)
    except OSError as error:
        raise OutputError(f"{root}: cannot be read ({error.strerror}); {remedies.elsewhere}") from error
    if free:
        remove_leftovers(root)
    elif not is_run(root):
        raise OutputError(f"{root}: is not empty and holds no run; {remedies.elsewhere}")
    elif overwrite:
        remove_results(root)
    elif not resume:
        raise OutputError(
            f"{root}: holds a run already; continue it with {remedies.resume} or replace it with {remedies.overwrite}"
        )
    mark_run(root)
    return resume and not free


def remove_leftovers(root: Path) -> None:
    """Remove temporary files that a killed run could not remove. Raises OutputError."""
    for path in list(_files(root, temporary=True)):
        remove_file(path)
    for path in list(_below(root / "cues")):
        if _TEMPORARY.fullmatch(path.name):
            remove_file(path)


def remove_results(root: Path) -> None:
    """Remove what runs write, and nothing else; maps of networks stay, as they go by content and take long to make.

    Files of other names stay, and with them their folders; links to folders are not followed.

    Raises:
        OutputError: If something cannot be removed.
    """
    remove_leftovers(root)
    for path in list(_files(root, temporary=False)):
        if path.name != MARKER:
            remove_file(path)
    for path in sorted((root / "export").iterdir()) if _is_own_folder(root / "export") else ():
        if is_export(path):
            remove_export(path)
    for path in sorted((root / "shots").iterdir()) if _is_own_folder(root / "shots") else ():
        if re.fullmatch(r"\d{3,}", path.name) and _is_own_folder(path) and is_run(path):
            remove_results(path)
            if [own.name for own in path.iterdir()] == [MARKER]:
                remove_file(path / MARKER)
            _remove_if_empty(path)
    for name in (*sorted(filter(None, _KNOWN), reverse=True), "export", "shots"):
        _remove_if_empty(root / name)


def is_export(folder: Path) -> bool:
    """Tell whether a folder holds an export of its name."""
    try:
        return bool(_is_own_folder(folder) and read_json(folder / EXPORT_MARKER).get("format") == folder.name)
    except (InputError, AttributeError):
        return False


def export_files(folder: Path) -> list[str]:
    """Return the files in a folder and below, as paths relative to it, sorted."""
    return sorted(path.relative_to(folder).as_posix() for path in _below(folder))


def foreign_files(folder: Path) -> list[str]:
    """Return the files in the folder of an export that are not of it."""
    own = _listed(folder)
    return [name for name in export_files(folder) if name not in own]


def remove_export(folder: Path) -> None:
    """Remove the files of an export, and its folders as far as nothing else is in them. Raises OutputError."""
    own = _listed(folder)
    for name in export_files(folder):
        if name in own:
            remove_file(folder / name)
    for path in sorted((p for p in folder.rglob("*") if _is_own_folder(p)), reverse=True):
        _remove_if_empty(path)
    _remove_if_empty(folder)


_held: dict[str, int] = {}
_guard = threading.Lock()


@contextmanager
def run_lock(root: Path, remedies: Remedies = PYTHON) -> Iterator[None]:
    """Keep other processes and threads from writing into the folder of a run; it is made if absent.

    The lock goes with the process, however that ends. Within one thread it may be taken again.

    Args:
        root: Of the run.
        remedies: How the caller spells what to do.

    Raises:
        OutputError: If another process or thread writes there, or the folder cannot be made.
    """
    me, name = threading.get_ident(), os.path.realpath(root)
    with _guard:
        owner = _held.get(name)
        if owner not in (None, me):
            raise OutputError(f"{root}: another thread is writing there; wait for it to end or {remedies.elsewhere}")
        if owner is None:
            _held[name] = me
    if owner is not None:
        yield
        return
    try:
        with _locked_folder(root, remedies):
            yield
    finally:
        with _guard:
            del _held[name]


@contextmanager
def _locked_folder(root: Path, remedies: Remedies) -> Iterator[None]:
    try:
        root.mkdir(parents=True, exist_ok=True)
        descriptor = None if fcntl is None else os.open(root, os.O_RDONLY)
    except OSError as error:
        raise write_failure(root, error) from error
    if descriptor is None:
        yield
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(
                f"{root}: another process is writing there; wait for it to end or {remedies.elsewhere}"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(descriptor)


def _files(root: Path, *, temporary: bool) -> Iterator[Path]:
    """Yield the files of a run: those of known names, or what was being written under them."""
    for folder, names in _KNOWN.items():
        parent = root / folder
        if not (parent.is_dir() if folder == "" else _is_own_folder(parent)):
            continue
        for path in sorted(parent.iterdir()):
            own = is_temporary(path, folder) if temporary else names.fullmatch(path.name) is not None
            if own and (path.is_symlink() or not path.is_dir()):
                yield path


def _listed(folder: Path) -> set[str]:
    try:
        names = read_json(folder / EXPORT_MARKER).get("files", [])
    except (InputError, AttributeError):
        return set()
    return {EXPORT_MARKER, *(name for name in names if isinstance(name, str))} if isinstance(names, list) else set()


def _below(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and below; links to folders are not followed."""
    for parent, _, names in os.walk(folder) if _is_own_folder(folder) else ():
        yield from (Path(parent) / name for name in names)


def _is_own_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _remove_if_empty(folder: Path) -> None:
    try:
        if _is_own_folder(folder) and not any(folder.iterdir()):
            folder.rmdir()
    except OSError as error:
        raise write_failure(folder, error) from error
