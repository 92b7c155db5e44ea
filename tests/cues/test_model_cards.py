"""Model cards: those that come with the package, and what is said of wrong ones."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_networks import weighted_channels, write_card

from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.card import MODELS_VARIABLE, card_names, cards_folder, find_model, load_card
from uni4d_fg.cues.depth_network import DepthNetwork
from uni4d_fg.cues.session import weights_hash
from uni4d_fg.errors import ConfigError, InputError, Uni4dFgError

CPU = NetworkConfig(threads=1)


def test_the_package_brings_cards_for_the_usual_networks() -> None:
    kinds = {name: load_card(cards_folder() / f"{name}.yaml").kind for name in card_names()}
    assert {name for name, kind in kinds.items() if kind == "depth"} >= {
        "unidepth_v2", "depth_anything_v2", "depth_anything_v2_metric", "metric3d_v2", "depth_pro"
    }  # fmt: skip
    assert {name for name, kind in kinds.items() if kind == "tracks"} == {"cotracker3", "tapir"}
    assert {name for name, kind in kinds.items() if kind == "segmentation"} == {"sinet_person", "yolo_seg"}


@pytest.mark.parametrize("name", card_names())
def test_every_card_says_how_to_get_the_network(name: str) -> None:
    card = load_card(cards_folder() / f"{name}.yaml")
    assert len(card.export) > 20
    assert card.source.startswith("https://")
    assert card.file.endswith(".onnx")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"dpth": 3}, "dpth: unknown field, did you mean depth?"),
        ({"input": {"nam": "x"}}, "input.nam: unknown field"),
        ({"input": {"layout": "HWC"}}, "one of NCHW, NHWC"),
        ({"size": {"rule": "fixed", "height": 4}}, "rule 'fixed' needs height and width"),
        ({"size": {"rule": "longest"}}, "needs length"),
        ({"depth": {"kind": "canonical_depth"}}, "canonical_focal_px goes with"),
        ({"depth": {"kind": "depth"}}, "metric_depth, canonical_depth, inverse_depth, affine_disparity"),
        ({"kind": "sound"}, "depth, segmentation, tracks"),
        ({"input": {"scale": float("nan")}}, "finite"),
        ({"title": None}, "title"),
    ],
)
def test_a_wrong_card_is_one_error_that_names_file_and_field(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    path = write_card(tmp_path / "mine.yaml", **changes)
    with pytest.raises(ConfigError) as caught:
        load_card(path)
    assert str(path) in str(caught.value)
    assert said in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "a: [", "kind: depth", "\x00"])
def test_what_is_no_card_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"bad\.yaml"):
        load_card(tmp_path / "bad.yaml")
    with pytest.raises(ConfigError, match="no such file; a YAML file"):
        load_card(tmp_path / "absent.yaml")


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.text(max_size=5), st.lists, max_leaves=5))
@settings(max_examples=40, deadline=None)
def test_no_value_of_a_field_breaks_the_reader(tmp_path_factory: pytest.TempPathFactory, value: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.yaml"
    for field in ("input", "size", "depth", "sha256", "kind", "file"):
        card = yaml.safe_load(write_card(path).read_text())
        card[field] = value
        path.write_text(yaml.safe_dump(card))
        with contextlib.suppress(ConfigError):
            load_card(path)


def test_models_are_found_by_name_path_and_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = write_card(tmp_path / "mine.yaml")
    network = weighted_channels(tmp_path / "tiny.onnx", (1, 1, 1))
    assert find_model(str(card), "depth").weights == network
    other = weighted_channels(tmp_path / "other.onnx", (2, 2, 2))
    assert find_model(f"{card}={other}", "depth").weights == other
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / "tiny.onnx").write_bytes(network.read_bytes())
    monkeypatch.setenv(MODELS_VARIABLE, str(folder))
    assert find_model(str(card), "depth").weights == folder / "tiny.onnx"


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ("nosuch", "choose one of depth_anything_v2"),
        ("net.onnx", "needs a card"),
        ("sinet_person", "for segmentation"),
        ("depth_pro=/no/such.onnx", "no such file; the ONNX file of depth_pro="),
    ],
)
def test_a_wrong_choice_is_one_error(choice: str, said: str) -> None:
    with pytest.raises(Uni4dFgError, match=said):
        find_model(choice, "depth")


def test_a_missing_file_says_where_it_was_looked_for_and_a_wrong_one_is_refused(tmp_path: Path) -> None:
    card = write_card(tmp_path / "mine.yaml", sha256="00")
    with pytest.raises(InputError, match=r"doctor --cards.*mine=FILE"):
        weights_hash(find_model(str(card), "depth"))
    weighted_channels(tmp_path / "tiny.onnx", (1, 1, 1))
    with pytest.raises(InputError, match="SHA-256"):
        weights_hash(find_model(str(card), "depth"))


def _open(tmp_path: Path, **changes: Any) -> DepthNetwork:
    return DepthNetwork(find_model(str(write_card(tmp_path / "mine.yaml", **changes)), "depth"), CPU)


@pytest.mark.parametrize("content", [b"", b"not a network", b"\x08\x07\x12\x04"])
def test_a_corrupt_file_is_one_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "tiny.onnx").write_bytes(content)
    with pytest.raises(InputError, match="cannot be loaded as an ONNX network") as caught:
        _open(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_truncated_file_is_one_error(tmp_path: Path) -> None:
    network = weighted_channels(tmp_path / "tiny.onnx", (1, 1, 1))
    network.write_bytes(network.read_bytes()[:-40])
    with pytest.raises(InputError, match="cannot be loaded"):
        _open(tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"input": {"name": "pixels"}}, r"no input 'pixels'; its inputs are 'image'"),
        ({"input": {"layout": "NHWC"}}, r"by the card it is \(1, any, any, 3\)"),
        ({"depth": {"name": "depth"}}, r"no output 'depth'; its outputs are 'out'"),
        ({"size": {"rule": "fixed", "height": 32, "width": 32}}, r"shape \(1, 3, 24, 32\).*\(1, 3, 32, 32\)"),
    ],
)
def test_a_network_that_does_not_fit_its_card_is_one_error(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    weighted_channels(tmp_path / "tiny.onnx", (1, 1, 1), size=(24, 32))
    with pytest.raises(InputError, match=said) as caught:
        _open(tmp_path, **changes)
    assert "does not fit card mine" in str(caught.value)


def test_a_second_input_that_the_card_does_not_have_is_named(tmp_path: Path) -> None:
    import onnx

    path = weighted_channels(tmp_path / "tiny.onnx", (1, 1, 1))
    model = onnx.load(str(path))
    model.graph.input.append(onnx.helper.make_tensor_value_info("camera", onnx.TensorProto.FLOAT, [1, 3]))
    onnx.save(model, str(path))
    with pytest.raises(InputError, match="also needs the input 'camera'"):
        _open(tmp_path)


def test_cuda_is_refused_where_it_is_not_there(tmp_path: Path) -> None:
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("there is a GPU here")
    weighted_channels(tmp_path / "tiny.onnx", (1, 1, 1))
    with pytest.raises(Uni4dFgError, match="onnxruntime-gpu"):
        DepthNetwork(find_model(str(write_card(tmp_path / "mine.yaml")), "depth"), NetworkConfig(provider="cuda"))
