"""From a video file on the command line: reconstruct, cues, doctor."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import yaml
from onnx import TensorProto, helper, numpy_helper

from uni4d_fg.cli import main
from uni4d_fg.cli.runs import stored_input
from uni4d_fg.config.load import load_config
from uni4d_fg.cues.scale_notes import NOT_METRIC, NOT_METRIC_GIVEN
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig

pytest.importorskip("open3d")

Run = Callable[..., tuple[int, str, str]]
QUICK = ["--config", "fast", "--quiet", "--set", "output.pictures=false", "--set", "output.clouds=false"]
SCENE = SyntheticSceneConfig(num_frames=10, width=160, height=120, focal=150.0, frame_rate=5.0, objects="none")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence folder, and clip.mp4 of its frames beside it."""
    from uni4d_fg.frontend.synthetic import make_synthetic_sequence

    folder = tmp_path_factory.mktemp("video") / "room"
    sequence = make_synthetic_sequence(SCENE)
    write_native(sequence, folder)
    height, width = sequence.image_size
    writer = cv2.VideoWriter(
        str(folder.parent / "clip.mp4"), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"mp4v"), 5.0, (width, height)
    )
    for image in sequence.images:
        writer.write(np.ascontiguousarray(image[:, :, ::-1]))
    writer.release()
    return folder


@pytest.fixture(scope="module")
def clip(room: Path) -> Path:
    return room.parent / "clip.mp4"


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """A depth network that says 2 m + red / 255."""
    weight = numpy_helper.from_array(np.array([1.0, 0, 0], np.float32).reshape(1, 3, 1, 1), "w")
    bias = numpy_helper.from_array(np.array([2.0], np.float32), "b")
    shape = [1, 3, "h", "w"]
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "w", "b"], ["depth"])], "tiny",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, "h", "w"])], [weight, bias],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(tmp_path / "tiny.onnx"))
    values = {
        "kind": "depth", "title": "tiny", "file": "tiny.onnx", "license": "none", "export": "made by a test",
        "input": {"name": "image"}, "depth": {"name": "depth", "kind": "metric_depth"},
    }  # fmt: skip
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(values))
    return tmp_path / "tiny.yaml"


def summary_of(run: Path) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads((run / "summary.json").read_text())
    return stored


def test_a_video_file_with_cues_beside_it(cli: Run, clip: Path, room: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = [
        "reconstruct", clip, "--out", run, "--depth", room / "depth_cue", "--masks", "none", "--intrinsics",
        room / "K.npy", "--start", 1, "--stop", 9, "--stride", 1, *QUICK,
    ]  # fmt: skip
    code, out, err = cli(*words)
    assert (code, err) == (0, "")
    assert "clip: 8 frames" in out
    assert not (run / "cues").exists()
    again = stored_input(run).read()
    given = read_sequence(room)
    assert again.num_frames == 8
    np.testing.assert_array_equal(again.depths[0], given.depths[1])
    np.testing.assert_allclose(again.intrinsics, given.intrinsics)
    code, out, _ = cli(*words, "--resume")
    assert code == 0
    assert "camera_init (resumed)" in out


def test_the_same_accuracy_from_a_video_file_as_from_the_folder(
    cli: Run, clip: Path, room: Path, tmp_path: Path
) -> None:
    errors = []
    for name, words in (
        ("folder", [room]),
        ("file", [clip, "--depth", room / "depth_cue", "--masks", "none", "--intrinsics", room / "K.npy"]),
    ):
        assert cli("reconstruct", *words, "--out", tmp_path / name, *QUICK)[0] == 0
        code, out, _ = cli("evaluate", tmp_path / name, "--sequence", room, "--json")
        assert code == 0
        errors.append(json.loads(out)["trajectory"]["ate_m"])
    assert errors[1] < 2 * errors[0] + 0.002  # the file is compressed, and the folder brings better tracks


@pytest.fixture(scope="module")
def frames_only(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("frames_only") / "run"
    words = ["reconstruct", str(clip), "--out", str(run), "--set", "tracking.grid_columns=24", *QUICK]
    assert main.run(words) == 0
    return run


def test_a_bare_video_is_reconstructed_up_to_scale_and_says_so(frames_only: Path) -> None:
    summary = summary_of(frames_only)
    assert summary["cues"]["metric"] is False
    assert summary["cues"]["sources"] == {
        "depth": "from camera motion", "masks": "from motion", "tracks": "built-in tracker",
        "intrinsics": "from camera motion",
    }  # fmt: skip
    assert NOT_METRIC in summary["warnings"]
    poses = np.loadtxt(frames_only / "trajectory.tum")
    assert poses.shape == (10, 8)
    assert np.isfinite(poses).all()


def test_the_cues_of_a_run_are_opened_again(cli: Run, frames_only: Path, clip: Path) -> None:
    opened = stored_input(frames_only).read()
    assert isinstance(opened, Sequence)
    assert opened.tracks is not None
    assert not opened.depth_is_metric
    assert np.isfinite(opened.depths[5]).all()
    before = {p: p.stat().st_mtime_ns for p in (frames_only / "cues").rglob("*.np[yz]") if p.name != "tracks.npz"}
    words = ["reconstruct", clip, "--out", frames_only, "--set", "tracking.grid_columns=24", *QUICK, "--json"]
    code, out, err = cli(*words, "--resume")
    assert (code, err) == (0, "")
    assert all(stage["resumed"] for name, stage in json.loads(out)["stages"].items() if name != "output")
    kept = {p: p.stat().st_mtime_ns for p in before if p.exists() and "initial" not in p.name}
    assert kept == {p: t for p, t in before.items() if "initial" not in p.name}
    assert cli("reconstruct", clip, "--out", frames_only, *QUICK)[0] == 6


def test_ctrl_c_while_cues_are_made_names_a_folder_that_exists(
    cli: Run, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise Cancelled("structure from motion stopped")

    monkeypatch.setattr("uni4d_fg.cues.gather.gather_cues", stopped)
    code, _, err = cli("reconstruct", clip, "--out", tmp_path / "run", *QUICK)
    assert code == 130
    found = re.search(r"what is done is in (\S+); continue with: ", err)
    assert found is not None
    assert Path(found.group(1)) == tmp_path / "run"
    assert (tmp_path / "run").is_dir()


@pytest.mark.slow
def test_cues_up_to_scale_are_up_to_scale_in_another_run(cli: Run, clip: Path, tmp_path: Path) -> None:
    words = ["cues", clip, "--out", tmp_path / "made", "--set", "tracking.grid_columns=24", "--quiet"]
    code, _, err = cli(*words)
    assert code == 0
    assert "not metric" in err
    code, out, _ = cli("reconstruct", tmp_path / "made", "--out", tmp_path / "run", *QUICK)
    assert code == 0
    assert "cues: depth given, in a unit of its own" in out
    summary = summary_of(tmp_path / "run")
    assert summary["cues"]["metric"] is False
    assert summary["warnings"].count(NOT_METRIC_GIVEN) == 1
    # As on the video itself: what moves has depth only where it stands.
    used, usual = load_config(tmp_path / "run" / "config.yaml"), load_config("default")
    assert usual.nonrigid.depth_sigma is None
    assert used.nonrigid.depth_sigma == usual.geometric_depth.moving_depth_sigma
    (tmp_path / "made" / "depth_cue.json").write_text('{"metric": false, "from_motion": {"parallax": false}}')
    assert cli("reconstruct", tmp_path / "made", "--out", tmp_path / "turned", *QUICK)[0] == 0
    assert load_config(tmp_path / "turned" / "config.yaml").input.intrinsics == "fixed"


def test_cues_writes_a_sequence_that_reads_back(cli: Run, clip: Path, card: Path, tmp_path: Path) -> None:
    words = ["cues", clip, "--depth-model", card, "--masks", "none", "--quiet", "--stop", 6]
    code, out, err = cli(*words, "--out", tmp_path / "native")
    assert (code, err) == (0, "")
    assert "depth: tiny" in out
    assert not (tmp_path / "native-unfinished").exists()
    code, out, _ = cli("validate", tmp_path / "native", "--json")
    assert (code, json.loads(out)["layout"], json.loads(out)["ok"]) == (0, "native", True)
    native = read_sequence(tmp_path / "native")
    np.testing.assert_allclose(native.depths[2], 2 + native.images[2][..., 0] / 255, rtol=2.5e-4, atol=6e-4)
    assert native.tracks is not None
    assert native.tracks.num_frames == 6
    code, out, _ = cli(*words, "--out", tmp_path / "uni4d", "--layout", "uni4d", "--json", "--keep")
    assert json.loads(out)["sources"]["depth"] == "tiny"
    assert (tmp_path / "uni4d-unfinished" / "cues.json").is_file()
    other = read_sequence(tmp_path / "uni4d", "uni4d")
    np.testing.assert_allclose(other.depths[2], native.depths[2], atol=1e-3)
    code, _, err = cli(*words, "--out", tmp_path / "uni4d")
    assert code == 6
    assert "exists already" in err


def test_doctor_says_what_is_there(cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNI4D_FG_MODELS", str(tmp_path))
    (tmp_path / "SINet_Softmax.onnx").write_bytes(b"x")
    code, out, err = cli("doctor")
    assert (code, err) == (0, "")
    for text in ("Python", "threads", "C++ extension", "CPUExecutionProvider", "extras", "unidepth_v2"):
        assert text in out
    assert f"ready, {tmp_path / 'SINet_Softmax.onnx'}" in out
    assert "unidepthv2.onnx is not there" in out
    found = json.loads(cli("doctor", "--json")[1])
    assert found["cards"]["sinet_person"]["exists"] is True
    assert found["cards"]["depth_pro"]["exists"] is False
    assert found["onnxruntime"]["providers"]
    assert found["threads"]["usable_cores"] >= 1
    assert "torch.onnx.export" in cli("doctor", "--cards")[1]


def test_without_onnxruntime_one_sentence_says_what_to_install(
    cli: Run, clip: Path, card: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    code, out, err = cli("reconstruct", clip, "--depth-model", card, "--out", tmp_path / "run")
    assert (code, out) == (7, "")
    assert err.count("\n") == 1
    assert "pip install 'uni4d-fg[cues]'" in err
    assert not (tmp_path / "run").exists()
    code, out, _ = cli("doctor")
    assert code == 0
    assert "pip install 'uni4d-fg[cues]'" in out


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--depth-model", "nosuch"], 2, "choose one of"),
        (["--depth-model", "unidepth_v2"], 3, "no ONNX file of UniDepthV2"),
        (["--depth-model", "net.onnx"], 2, "needs a card"),
        (["--mask-model", "depth_pro"], 2, "this card is for depth"),
        (["--classes", "dog"], 2, "--mask-model"),
        (["--mask-model", "yolo_seg", "--classes", " , "], 2, "separated by commas"),
        (["--depth", "/no/such/depth"], 3, "/no/such/depth"),
        (["--masks", "/no/such/masks"], 3, "/no/such/masks"),
        (["--tracks", "/no/such.npz"], 3, "/no/such.npz"),
        (["--depth", "/tmp", "--depth-model", "depth_pro"], 3, "/tmp"),
        (["--start", "-1"], 3, "start"),
        (["--stop", "1"], 3, "1 frame"),
        (["--stride", "0"], 3, "stride"),
        (["--max-size", "2"], 3, "largest size"),
    ],
)
def test_a_wrong_choice_is_one_line_and_leaves_nothing(
    cli: Run, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int, said: str
) -> None:
    monkeypatch.setenv("UNI4D_FG_MODELS", str(tmp_path / "models"))
    got, out, err = cli("reconstruct", clip, "--out", tmp_path / "run", *words)
    assert (got, out) == (code, "")
    assert err.count("\n") == 1
    assert said in err
    assert not (tmp_path / "run").exists()


def test_options_that_contradict_each_other(cli: Run, room: Path, tmp_path: Path) -> None:
    for words in (
        ["--depth", "depth_cue", "--depth-model", "depth_pro"],
        ["--masks", room / "masks", "--mask-model", "yolo_seg"],
        ["--tracks", room / "tracks.npz", "--track-model", "tapir"],
    ):
        code, _, err = cli("reconstruct", room, "--out", tmp_path / "run", *words)
        assert code == 2
        assert "give one of them" in err


@pytest.mark.parametrize("content", [b"", b"not a video"])
def test_what_is_no_video_is_one_error(cli: Run, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.mp4").write_bytes(content)
    code, out, err = cli("reconstruct", tmp_path / "bad.mp4", "--out", tmp_path / "run")
    assert (code, out) == (3, "")
    assert err.count("\n") == 1
    assert not (tmp_path / "run").exists()
