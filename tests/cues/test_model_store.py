"""Models are listed, fetched from a local server with the checksum that it publishes, and added from files."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from uni4d_fg.cli.main import run
from uni4d_fg.cues import card, model_store
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.reading import read_text

CONTENT = bytes(range(256)) * 40
DIGEST = hashlib.sha256(CONTENT).hexdigest()


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A server on the loopback, and the folder that it shows."""
    shown = tmp_path / "shown"
    shown.mkdir()
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(shown))) as http:
        thread = threading.Thread(target=http.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{http.server_address[1]}", shown
        http.shutdown()
        thread.join()


@pytest.fixture
def cards(tmp_path: Path, server: tuple[str, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of cards with one that is published by the server, and an empty folder of models."""
    base, shown = server
    (shown / "net.onnx").write_bytes(CONTENT)
    (shown / "pointer").write_text(
        f"version https://git-lfs.github.com/spec/v1\noid sha256:{DIGEST}\nsize {len(CONTENT)}\n"
    )
    folder = tmp_path / "cards"
    folder.mkdir()
    template = read_text(card.cards_folder() / "depth_anything_v2.yaml")
    before, _, rest = template.partition("download:")
    rest = rest[rest.index("input:") :]
    spec = f"download: {{url: '{base}/net.onnx', pointer: '{base}/pointer'}}\n"
    (folder / "tiny.yaml").write_text(before.replace("depth_anything_v2.onnx", "tiny.onnx") + spec + rest)
    (folder / "made.yaml").write_text(before.replace("depth_anything_v2.onnx", "made.onnx") + rest)
    for module in (card, model_store):
        monkeypatch.setattr(module, "cards_folder", lambda: folder)
        monkeypatch.setattr(module, "card_names", lambda: ("made", "tiny"))
    monkeypatch.setenv("UNI4D_FG_MODELS", str(tmp_path / "models"))
    return folder


def test_a_published_file_is_fetched_and_found(cards: Path, tmp_path: Path) -> None:
    file = model_store.published("tiny")
    assert (file.sha256, file.size_bytes) == (DIGEST, len(CONTENT))
    path = model_store.fetch("tiny", file)
    assert path == tmp_path / "models" / "tiny.onnx"
    assert path.read_bytes() == CONTENT
    assert card.find_model("tiny", "depth").weights == path
    assert model_store.installed_cards() == {"made": None, "tiny": path}


def test_what_differs_from_its_checksum_is_not_kept(cards: Path, server: tuple[str, Path], tmp_path: Path) -> None:
    file = model_store.published("tiny")
    (server[1] / "net.onnx").write_bytes(CONTENT[:-1])
    with pytest.raises(InputError, match=r"net.onnx: what came has SHA-256 .* nothing was kept"):
        model_store.fetch("tiny", file)
    assert list((tmp_path / "models").iterdir()) == []


@pytest.mark.parametrize(("gone", "said"), [("pointer", "404"), ("net.onnx", "404")])
def test_a_source_that_does_not_answer_is_one_error(
    cards: Path, server: tuple[str, Path], tmp_path: Path, gone: str, said: str
) -> None:
    file = model_store.published("tiny")
    (server[1] / gone).unlink()
    ask = (lambda: model_store.published("tiny")) if gone == "pointer" else (lambda: model_store.fetch("tiny", file))
    with pytest.raises(InputError, match=f"{gone}: cannot be fetched .*{said}.*models add FILE"):
        ask()
    assert not (tmp_path / "models" / "tiny.onnx").exists()


def test_a_pointer_without_a_checksum_is_refused(cards: Path, server: tuple[str, Path]) -> None:
    (server[1] / "pointer").write_text("<html>log in</html>")
    with pytest.raises(InputError, match="not a Git LFS pointer"):
        model_store.published("tiny")


def test_a_card_that_is_not_published_says_how_to_make_the_file(cards: Path) -> None:
    with pytest.raises(ConfigError, match="doctor --cards"):
        model_store.published("made")


def test_every_card_that_names_a_download_names_a_checksum_as_well(tmp_path: Path) -> None:
    text = read_text(card.cards_folder() / "depth_anything_v2.yaml")
    pointer = next(line for line in text.splitlines() if "pointer:" in line)
    (tmp_path / "bare.yaml").write_text(text.replace(pointer + "\n", ""))
    with pytest.raises(ConfigError, match="needs a checksum"):
        card.load_card(tmp_path / "bare.yaml")


def test_a_file_that_was_made_is_added(cards: Path, tmp_path: Path) -> None:
    file = tmp_path / "made.onnx"
    file.write_bytes(CONTENT)
    assert model_store.add(file) == ("made", tmp_path / "models" / "made.onnx")
    other = tmp_path / "other.onnx"
    other.write_bytes(CONTENT)
    with pytest.raises(ConfigError, match="no card has a file of that name"):
        model_store.add(other)
    assert model_store.add(other, "tiny")[1].read_bytes() == CONTENT
    with pytest.raises(ConfigError, match="no such model card"):
        model_store.add(other, "huge")


def test_fetching_asks_first(
    cards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("typer.confirm", lambda text: bool(asked.append(text)))
    assert run(["models", "fetch", "tiny"]) == ConfigError.exit_code
    assert asked == ["Download it?"]
    assert not (tmp_path / "models").exists()
    assert DIGEST in capsys.readouterr().out
    assert run(["models", "fetch", "tiny", "--yes", "--quiet"]) == 0
    assert run(["models", "fetch", "tiny"]) == 0
    assert "already there" in capsys.readouterr().out


def test_the_list_names_license_size_and_state(cards: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "to be made" in next(line for line in lines if line.strip().startswith("made"))
    assert "can be fetched" in next(line for line in lines if line.strip().startswith("tiny"))
    assert all("Apache-2.0" in line for line in lines[1:3])
