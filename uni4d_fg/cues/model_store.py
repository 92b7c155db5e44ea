"""The user's folder of ONNX files: what is there, fetching one that is published, adding one that was made."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uni4d_fg.cues.card import Card, DownloadSpec, card_names, cards_folder, find_model, load_card, models_folder
from uni4d_fg.cues.session import file_sha256
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.files import atomic_path
from uni4d_fg.optional import import_pooch
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.reading import check_regular

_TIMEOUT_S = 30
_MAX_POINTER_BYTES = 1024
_POINTER = re.compile(r"oid sha256:([0-9a-f]{64})\s+size (\d+)")


@dataclass(frozen=True)
class Publication:
    """A published ONNX file and what it must be."""

    url: str
    sha256: str
    size_bytes: int | None
    """None where neither the card nor the source says it."""


def installed_cards() -> dict[str, Path | None]:
    """Return the cards that come with the package, each with its ONNX file, None where it is not there."""
    out: dict[str, Path | None] = {}
    for name in card_names():
        model = find_model(name, load_card(cards_folder() / f"{name}.yaml").kind)
        out[name] = model.weights if model.weights.is_file() else None
    return out


def published(name: str) -> Publication:
    """Ask the source of a card for the checksum of its file; nothing else is fetched.

    Raises:
        ConfigError: If there is no such card, or its file is not published as ONNX.
        InputError: If the source cannot be reached, or gives no checksum.
        MissingDependencyError: If pooch is not installed.
    """
    card = _card(name)
    spec = card.download
    if spec is None:
        raise ConfigError(
            f"{name}: {card.title} is not published as ONNX; `uni4d-fg doctor --cards` says how to make the file, then "
            "`uni4d-fg models add FILE` puts it where it is found"
        )
    if not spec.pointer:
        return Publication(spec.url, str(card.sha256).lower(), spec.size_bytes)
    found = _POINTER.search(_read_pointer(spec))
    if found is None:
        raise InputError(f"{spec.pointer}: is not a Git LFS pointer, so there is no checksum to compare with")
    digest, size = found.group(1), int(found.group(2))
    if card.sha256 is not None and card.sha256.lower() != digest:
        raise InputError(f"{spec.pointer}: the source has SHA-256 {digest}, card {name} expects {card.sha256.lower()}")
    return Publication(spec.url, digest, size)


def fetch(name: str, file: Publication, reporter: Reporter | None = None) -> Path:
    """Download the file of a card into :func:`~uni4d_fg.cues.card.models_folder` and compare its checksum.

    Raises:
        InputError: If the source cannot be reached, or what came is not the file that it publishes.
        OutputError: If it cannot be written.
        MissingDependencyError: If pooch is not installed.
    """
    target = models_folder() / Path(_card(name).file).name
    reporter = reporter or SilentReporter()
    reporter.begin(f"fetch {name}", file.size_bytes)
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as temporary:
        _download(file.url, temporary, _Bar(reporter))
        found = file_sha256(temporary)
        if found != file.sha256:
            raise InputError(
                f"{file.url}: what came has SHA-256 {found}, its source publishes {file.sha256}; nothing was kept. Try "
                "again, or fetch it by hand and use `uni4d-fg models add FILE`"
            )
    reporter.end()
    return target


def add(file: Path, name: str | None = None) -> tuple[str, Path]:
    """Copy an ONNX file to where its card looks for it.

    Args:
        file: The ONNX file.
        name: The card; None: the one whose file has this name.

    Returns:
        The card's name and the copy.

    Raises:
        ConfigError: If no card fits.
        InputError: If the file cannot be read or is not the one that the card names.
        OutputError: If it cannot be written.
    """
    check_regular(file, "an ONNX file")
    if name is None:
        fitting = [card for card in card_names() if Path(_card(card).file).name == file.name]
        if len(fitting) != 1:
            raise ConfigError(
                f"{file}: no card has a file of that name; say which one it is for with --card, one of "
                f"{', '.join(card_names())}"
            )
        name = fitting[0]
    card = _card(name)
    if card.sha256 is not None and file_sha256(file) != card.sha256.lower():
        raise InputError(f"{file}: SHA-256 is {file_sha256(file)}, but card {name} expects {card.sha256.lower()}")
    target = models_folder() / Path(card.file).name
    if target.exists() and target.samefile(file):
        return name, target
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as temporary:
        shutil.copyfile(file, temporary)
    return name, target


def _card(name: str) -> Card:
    if name not in card_names():
        raise ConfigError(f"{name}: no such model card; choose one of {', '.join(card_names())}")
    return load_card(cards_folder() / f"{name}.yaml")


def _read_pointer(spec: DownloadSpec) -> str:
    import_pooch()
    # A dependency of pooch, which has no way to read a page without keeping it.
    import requests

    try:
        with requests.get(spec.pointer, timeout=_TIMEOUT_S, stream=True) as answer:
            answer.raise_for_status()
            content = next(answer.iter_content(_MAX_POINTER_BYTES), b"")
    except requests.RequestException as error:
        raise _unreachable(spec.pointer, error) from error
    return bytes(content).decode("ascii", "replace")


def _download(url: str, target: Path, bar: _Bar) -> None:
    pooch = import_pooch()
    import requests

    try:
        pooch.HTTPDownloader(progressbar=bar, timeout=_TIMEOUT_S)(url, str(target), None)
    except (requests.RequestException, ValueError) as error:
        raise _unreachable(url, error) from error


def _unreachable(url: str, error: Exception) -> InputError:
    reason = " ".join(str(error).split())[:200]
    return InputError(f"{url}: cannot be fetched ({reason}); check the connection, or fetch it by hand and use "
                      "`uni4d-fg models add FILE`")  # fmt: skip


class _Bar:
    """What pooch takes for a progress bar."""

    def __init__(self, reporter: Reporter) -> None:
        self.reporter = reporter
        self.total = 0
        self._done = 0

    def update(self, count: int) -> None:
        """``count`` more bytes have come."""
        self._done += count
        self.reporter.advance(self._done)

    def reset(self) -> None:
        """Pooch fills the bar at the end: reset, then ``update(total)``."""
        self._done = 0

    def close(self) -> None:
        """Do nothing: the reporter ends its task."""


def entry(name: str, path: Path | None) -> dict[str, Any]:
    """Return what the list of models says of a card, as plain data."""
    card = _card(name)
    size = card.download.size_bytes if card.download else None
    return {
        "title": card.title,
        "makes": card.kind,
        "license": card.license,
        "source": card.source,
        "path": path,
        "size_bytes": path.stat().st_size if path else size,
        "published": card.download is not None,
    }
