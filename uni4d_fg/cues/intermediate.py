"""Cues that only led to others, as the first depth from which masks are found: they can go when a run has ended."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path, PurePosixPath

from uni4d_fg.cues.manifest import has_manifest, read_manifest
from uni4d_fg.files import write_failure

_FOLDERS = ("depth", "masks")
_MADE = re.compile(r"motion-[0-9a-f]{20}")
"""Names of folders of cues that were found from motion; what networks made stays: it takes long to make."""
_FILES = re.compile(r"\d{6,}\.(map\.npz|png)|start\.npz|said\.npz")


def drop_intermediate(folder: Path) -> int:
    """Remove cues from motion that the finished cues do not consist of; ``--resume`` makes them again.

    Args:
        folder: That of :func:`~uni4d_fg.cues.gather.gather_cues`; without a manifest in it, nothing is removed.

    Returns:
        Bytes that were removed.

    Raises:
        InputError: If the manifest cannot be read.
        OutputError: If a file cannot be removed.
    """
    if not has_manifest(folder):
        return 0
    stored = read_manifest(folder)
    used = {PurePosixPath(name).parent for names in (stored.depth, stored.masks) for name in names or ()}
    removed = 0
    for kind in _FOLDERS:
        for made in sorted((folder / kind).glob("motion-*")):
            if _MADE.fullmatch(made.name) and not made.is_symlink() and PurePosixPath(kind, made.name) not in used:
                removed += _remove(made)
    return removed


def _remove(folder: Path) -> int:
    """Remove the files of known names in a folder, and the folder if it is empty then; returns their bytes."""
    removed = 0
    try:
        for path in sorted(folder.iterdir()):
            if _FILES.fullmatch(path.name) and path.is_file() and not path.is_symlink():
                size = path.stat().st_size
                path.unlink()
                removed += size
    except OSError as error:
        raise write_failure(folder, error) from error
    with suppress(OSError):
        folder.rmdir()
    return removed
