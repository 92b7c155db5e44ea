"""Run folders of strangers that are shown: pages, films, previews of unfinished runs, shots, cues; and models."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import changed_array, changed_json, damaged, judged, judged_verb, special_files, state_of
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.cli.runs import stored_input
from uni4d_fg.cues.manifest import MANIFEST, load_cues
from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz, save_npz
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.tracks.io import save_tracks
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run import Run
from uni4d_fg.results.shot_list import Shot, write_shots
from uni4d_fg.results.view.share import write_page

hostile = settings(settings.get_profile("hostile"))
slower = settings(hostile, max_examples=max(1, hostile.max_examples // 4))
few = settings(hostile, max_examples=max(1, hostile.max_examples // 10))

SHOWN: list[list[Any]] = [
    ["report"],
    ["evaluate"],
    ["graph"],
    ["export", "--to", "tum", "--overwrite"],
    ["share", "--quiet"],
    ["render", "--to", "png", "--stills", "1", "--height", "32", "--quiet"],
]


def copied(run: Path, factory: pytest.TempPathFactory, name: str) -> Path:
    folder = factory.getbasetemp() / name
    shutil.rmtree(folder, ignore_errors=True)
    return Path(shutil.copytree(run, folder))


def with_everything(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of a reconstruction with what only some runs have: a zoom, a lens, a rigid object."""
    frames = len(arrays["world_T_cam"])
    return arrays | {
        "zoom": np.linspace(1.0, 1.1, frames),
        "lens_model": np.array([1]),
        "lens_parameters": np.array([0.01, 0.0, 0.0, 0.0]),
        "object_instance": np.array([1], np.int32),
        "object_reference": np.array([0], np.int32),
        "object_observed": np.ones((1, frames), bool),
        "object_world_T_object": np.tile(np.eye(4), (1, frames, 1, 1)),
        "object_covariance": np.tile(np.eye(6), (1, frames, 1, 1)),
        "object_velocity": np.zeros((1, frames, 6)),
    }


@hostile
@given(data=st.data())
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that are read from the files
def test_reconstructions_of_other_numbers(
    run_folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    run = copied(run_folder, tmp_path_factory, "other-numbers")
    path = run / data.draw(st.sampled_from(["reconstruction.npz", "reconstruction.npz", "labels.npz"]))
    arrays = load_npz(path, {}, None)
    if path.name == "reconstruction.npz" and data.draw(st.booleans()):
        arrays = with_everything(arrays)
    for name in data.draw(st.lists(st.sampled_from(sorted(arrays)), min_size=1, max_size=2, unique=True)):
        arrays[name] = data.draw(changed_array(arrays[name]))
    save_npz(path, **arrays)
    judged(load_reconstruction, run / "reconstruction.npz")
    words = data.draw(st.sampled_from(SHOWN[:4]))
    judged_verb(words[0], run, *words[1:])


def test_a_run_with_everything_is_shown(run_folder: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(run_folder, tmp_path / "run"))
    save_npz(run / "reconstruction.npz", **with_everything(load_npz(run / "reconstruction.npz", {}, None)))
    for words in SHOWN:
        code, _, err = judged_verb(words[0], run, *words[1:])
        assert code == 0, (words, err)


@few
@given(data=st.data())
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_damaged_runs_as_pages_and_films(
    run_folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    run = copied(run_folder, tmp_path_factory, "shown")
    name = data.draw(
        st.sampled_from(["reconstruction.npz", "labels.npz", "depth.npy", "clouds/static.ply", "summary.json"])
    )
    if name.endswith("npz"):
        arrays = load_npz(run / name, {}, None)
        changed = data.draw(st.sampled_from(sorted(arrays)))
        arrays[changed] = data.draw(changed_array(arrays[changed]))
        save_npz(run / name, **arrays)
    else:
        (run / name).write_bytes(data.draw(damaged((run / name).read_bytes())))
    words = data.draw(st.sampled_from(SHOWN[4:]))
    judged_verb(words[0], run, *words[1:])


@slower
@given(data=st.data())
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_unfinished_runs(run_folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    run = copied(run_folder, tmp_path_factory, "unfinished")
    (run / "reconstruction.npz").unlink()
    stages = sorted((run / "stages").glob("*.npz"))
    for path in data.draw(st.lists(st.sampled_from([*stages, run / "labels.npz"]), min_size=1, max_size=2)):
        kind = data.draw(st.sampled_from(["array", "array", "damage", "remove"]))
        if kind == "remove" or not path.exists():
            path.unlink(missing_ok=True)
        elif kind == "damage":
            path.write_bytes(data.draw(damaged(path.read_bytes())))
        else:
            try:
                arrays = load_npz(path, {}, None)
            except InputError:
                continue
            name = data.draw(st.sampled_from(sorted(arrays)))
            arrays[name] = data.draw(changed_array(arrays[name]))
            save_npz(path, **arrays)
    opened = judged(Run, run, lambda: stored_input(run).read(), unfinished=True)
    if isinstance(opened, Run) and data.draw(st.integers(0, 3)) == 0:
        judged(write_page, opened, run / "share.html", 25.0)


def test_an_unfinished_run_is_shown(run_folder: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(run_folder, tmp_path / "run"))
    (run / "reconstruction.npz").unlink()
    opened = judged(Run, run, lambda: stored_input(run).read(), unfinished=True)
    assert isinstance(opened, Run)
    assert "not finished" in opened.summary["warnings"][0]
    for words in SHOWN:
        code, _, err = judged_verb(words[0], run, *words[1:])
        assert code in (0, 3), (words, err)  # graphs of finished stages are there


SHOTS = [Shot("shots/000", 0, 6, 6, 0, ate_m=0.01), Shot(None, 6, 8, 2, message="too short")]


@pytest.fixture(scope="module")
def split_folder(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in shots, one of them finished; not to be changed."""
    run = tmp_path_factory.mktemp("split") / "run"
    shutil.copytree(run_folder, run / "shots" / "000")
    for name in ("run.json", "config.yaml", "input.json"):
        shutil.copy(run_folder / name, run)
    write_shots(run, SHOTS)
    return run


@slower
@given(data=st.data())
def test_lists_of_shots(split_folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    run = copied(split_folder, tmp_path_factory, "changed-split")
    whole = json.loads((run / "shots.json").read_text())
    (run / "shots.json").write_text(json.dumps(data.draw(changed_json(whole))))
    words = data.draw(st.sampled_from([["evaluate"], ["evaluate", "--json"], *SHOWN[2:]]))
    judged_verb(words[0], run, *words[1:])


def test_a_list_of_shots_reaches_no_further_than_its_folder(split_folder: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(split_folder, tmp_path / "run"))
    for folder in ("../elsewhere", "/etc", "shots/001", "shots/../../elsewhere"):
        write_shots(run, [Shot(folder, 0, 6, 6, 0)])
        for verb in ("report", "evaluate"):
            code, _, err = judged_verb(verb, run)
            assert code == 3
            assert "shots.json" in err


@pytest.fixture(scope="module")
def cue_folder(sequence_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cues with their list, as a run keeps them; not to be changed."""
    folder = tmp_path_factory.mktemp("cues") / "cues"
    folder.mkdir()
    sequence = read_sequence(sequence_folder)
    assert sequence.tracks is not None
    for frame in range(sequence.num_frames):
        np.save(folder / f"depth{frame}.npy", np.asarray(sequence.depths[frame]))
    shutil.copytree(sequence_folder / "masks", folder / "masks")
    save_tracks(folder / "tracks.npz", sequence.tracks)
    np.save(folder / "poses.npy", np.tile(np.eye(4), (sequence.num_frames, 1, 1)))
    manifest = {
        "format": 1,
        "num_frames": sequence.num_frames,
        "image_size": list(sequence.image_size),
        "depth": [f"depth{frame}.npy" for frame in range(sequence.num_frames)],
        "masks": [f"masks/{path.name}" for path in sorted((folder / "masks").iterdir())],
        "static": False,
        "tracks": "tracks.npz",
        "intrinsics": sequence.intrinsics.tolist(),
        "initial_world_T_cam": "poses.npy",
        "report": {"sources": {"depth": "made"}, "facts": [], "warnings": [], "metric": True, "start": {}},
    }
    (folder / MANIFEST).write_text(json.dumps(manifest))
    return folder


@hostile
@given(data=st.data())
def test_lists_of_cues(
    cue_folder: Path, sequence_folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = copied(cue_folder, tmp_path_factory, "changed-cues")
    if data.draw(st.booleans()):
        whole = json.loads((folder / MANIFEST).read_text())
        (folder / MANIFEST).write_text(json.dumps(data.draw(changed_json(whole))))
    else:
        path = data.draw(st.sampled_from(sorted(path for path in folder.rglob("*") if path.is_file())))
        path.write_bytes(data.draw(damaged(path.read_bytes())))

    def read() -> None:
        sequence, _ = load_cues(open_video(sequence_folder / "rgb"), folder)
        for frames in (sequence.depths, sequence.masks):
            list(frames)

    judged(read)


def test_a_whole_list_of_cues_is_read(cue_folder: Path, sequence_folder: Path) -> None:
    sequence, report = load_cues(open_video(sequence_folder / "rgb"), cue_folder)
    assert sequence.num_frames == 6
    assert report.sources == {"depth": "made"}


@pytest.mark.parametrize("verb", ["report", "evaluate", "graph", "export", "share", "render", "view"])
def test_pipes_devices_and_links_in_place_of_a_run_or_its_files(run_folder: Path, tmp_path: Path, verb: str) -> None:
    (tmp_path / "special").mkdir()
    words = {"export": ["--to", "tum"], "render": SHOWN[5][1:]}.get(verb, [])
    specials = [path for path in special_files(tmp_path / "special") if not path.is_dir()]
    for special in specials:
        assert judged_verb(verb, special, *words)[0] == 3
    run = Path(shutil.copytree(run_folder, tmp_path / "run"))
    for name, special in zip(("summary.json", "reconstruction.npz"), specials[:2], strict=True):
        (run / name).rename(tmp_path / name)
        (run / name).symlink_to(special)
        # Some need neither.
        assert judged_verb(verb, run, *words)[0] in ((0, 3) if verb in ("graph", "evaluate", "export") else (3,))
        (run / name).unlink()
        (tmp_path / name).rename(run / name)
    if verb != "view":  # which would show what is left
        for name, special in zip(("input.json", "labels.npz"), specials[1:3], strict=True):
            (run / name).unlink()
            (run / name).symlink_to(special)
        judged_verb(verb, run, *words)


def test_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "special").mkdir()
    (tmp_path / "file").write_text("mine")
    specials = special_files(tmp_path / "special")
    for folder in [*specials, tmp_path / "file", tmp_path / ("x" * 300), "~nosuchuser/x"]:
        monkeypatch.setenv("UNI4D_FG_MODELS", os.fspath(folder))
        assert judged_verb("models")[0] in (0, 3)
        assert judged_verb("models", "--json")[0] in (0, 3)
        assert judged_verb("models", "add", tmp_path / "file", "--card", "yolo_seg")[0] in (3, 6, 0)
    monkeypatch.setenv("UNI4D_FG_MODELS", str(tmp_path / "models"))
    for file in [*specials, tmp_path / "absent"]:
        assert judged_verb("models", "add", file, "--card", "yolo_seg")[0] == 3
    assert judged_verb("models", "add", tmp_path / "file", "--card", "../../x")[0] == 2
    assert judged_verb("models", "add", tmp_path / "file")[0] == 2
    for name in ("nosuch", "../x", "x" * 300, "/dev/zero", ""):
        assert judged_verb("models", "fetch", name, "--yes")[0] == 2
    assert state_of(tmp_path)["file"] == b"mine"
