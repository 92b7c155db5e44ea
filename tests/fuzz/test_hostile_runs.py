"""Run folders that are damaged, foreign or malicious, verbs with any words, and kills with resume."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hostile import changed_json, damaged, judged, judged_verb, state_of
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.cli.runs import stored_input
from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.run_contents import is_run, mark_run, remove_results, run_lock
from uni4d_fg.results.summary_file import read_summary

hostile = settings(settings.get_profile("hostile"))
slower = settings(hostile, max_examples=max(1, hostile.max_examples // 4))

VERBS: list[list[Any]] = [
    ["report"],
    ["evaluate"],
    ["graph"],
    ["export", "--to", "tum", "--overwrite"],
    ["export", "--to", "colmap", "--overwrite"],
]


@slower
@given(data=st.data())
def test_damaged_runs(run_folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    run = tmp_path_factory.getbasetemp() / "damaged-run"
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(run_folder, run)
    name = data.draw(
        st.sampled_from(
            [
                "summary.json",
                "input.json",
                "config.yaml",
                "reconstruction.npz",
                "labels.npz",
                "depth.npy",
                "clouds/static.ply",
                "graphs/bundle_adjustment.graph.npz",
            ]
        )
    )
    path = run / name
    if path.suffix == ".json" and data.draw(st.booleans()):
        path.write_text(json.dumps(data.draw(changed_json(json.loads(path.read_text())))))
    else:
        path.write_bytes(data.draw(damaged(path.read_bytes())))
    judged_verb(*(words := data.draw(st.sampled_from(VERBS)))[:1], run, *words[1:])


RIVAL = {"first": 0, "second": 4, "focal": 70.0, "unexplained": 0.3, "degrees": 9.0, "degrees_per_frame": 2.0}
START = {
    "focal_px": 75.0,
    "focal_interval_px": [60.0, 95.0],
    "focal_is_open": [True, False],
    "stretch_along_view": [0.8, 1.3],
    "parallax_px": 40.0,
    "noise_px": 0.3,
    "unexplained": 0.25,
    "registered": 1.0,
    "starts": [RIVAL, {**RIVAL, "first": 1}],
}

CUES = {
    "sources": {"depth": "from camera motion"},
    "facts": ["a fact"],
    "warnings": ["a warning"],
    "metric": False,
    "seconds": 3.5,
    "start": START,
}


@hostile
@given(data=st.data())
def test_summaries_and_inputs(run_folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    from uni4d_fg.results.report.build import report_page
    from uni4d_fg.results.run import Run

    run = tmp_path_factory.getbasetemp() / "changed-run"
    if not run.exists():
        shutil.copytree(run_folder, run)
        (run / "depth.npy").unlink()  # the page is made of the summary; pictures take long
        (run / "labels.npz").unlink()
    for name in ("summary.json", "input.json"):
        whole = json.loads((run_folder / name).read_text())
        if name == "summary.json":  # with what runs from video alone record too
            whole["cues"] = CUES
        (run / name).write_text(json.dumps(data.draw(changed_json(whole))))
    judged(stored_input, run)
    if isinstance(judged(read_summary, run / "summary.json"), dict):
        page = judged(lambda: report_page(Run(run)))
        assert not isinstance(page, str) or "<script>" not in page


@pytest.mark.parametrize(
    "change",
    [
        {"stages": []},
        {"stages": {"x": 5}},
        {"stages": {"x": {"solves": [5]}}},
        {"stages": {"x": {"seconds": "long"}}},
        {"stages": {"x": {"solves": [{"energy_curve": [[0, None], [1, "a"]]}]}}},
        {"warnings": "text"},
        {"warnings": [5]},
        {"sequence": 5},
        {"sequence": {"name": ["a"]}},
        {"cues": {"sources": []}},
        {"cues": {"facts": 3}},
        {"solver": 3},
        {"versions": [1]},
        {"stages": {"x": {"peak_memory_mb": 1e400}}},
        {"stages": {"x": {"dropped": {"a": "b"}}}},
        {"cues": {"seconds": "long"}},
        {"cues": {"start": [1]}},
        {"cues": {"start": {"focal_px": 0.0}}},
        {"cues": {"start": {"focal_interval_px": [60.0]}}},
        {"cues": {"start": {"focal_interval_px": ["a", "b"]}}},
        {"cues": {"start": {"stretch_along_view": ["a", "b"]}}},
        {"cues": {"start": {"starts": [5]}}},
        {"cues": {"start": {"starts": {"degrees": 5}}}},
        {"cues": {"start": {"starts": [{"degrees": "many"}]}}},
    ],
)
def test_a_summary_of_other_types_is_refused(run_folder: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    whole = json.loads((run_folder / "summary.json").read_text())
    (tmp_path / "summary.json").write_text(json.dumps({**whole, **change}))
    assert "run the reconstruction again" in str(judged(read_summary, tmp_path / "summary.json"))


SOLVE = {"name": "a", "initial_energy": 2.0, "final_energy": 1.0, "energy_curve": [[1, 1.0]], "num_factors": 3}
NOTHING_KNOWN = {name: None for name in ("focal_px", "parallax_px", "noise_px", "unexplained")} | {
    "focal_interval_px": [None, None],
    "stretch_along_view": [None, None],
    "starts": [{"first": 1, "second": 2, "degrees": None, "degrees_per_frame": None, "unexplained": None}],
}


@pytest.mark.parametrize(
    "change",
    [
        {"stages": {"x": {"solves": [{**SOLVE, "energy_curve": [[0, 1.7e308], [1, 1e308]]}]}}},
        {"stages": {"x": {"solves": [{**SOLVE, "initial_energy": 5e-324, "energy_curve": [[1, 5e-324]]}]}}},
        {"stages": {"x": {"solves": [{**SOLVE, "energy_curve": [[-1.7e308, 1.0], [1.7e308, 1.0]]}]}}},
        {"stages": {"x": {"solves": [{**SOLVE, "energy_curve": [[1e200, 1.0], [1e200, 1.0]]}]}}},
        {"stages": {"x": {"solves": [{**SOLVE, "initial_energy": None}]}}},
        {"stages": {"x": {"solves": [{"energy_curve": [[1, 1.0]]}]}}},
        {"stages": {"x": {"solves": [{**SOLVE, "initial_energy": None, "final_energy": None}] * 9}}},
        {"stages": {"x": {"solves": [{}] * 9}}},
        {"stages": {"x": {"solves": [{**SOLVE, "num_factors": 2**53, "final_energy": -1.7e308}] * 9}}},
        {"stages": {"x": {"seconds": 1.7e308}, "y": {"seconds": 1.7e308, "peak_memory_mb": -1e308}}},
        {"cues": {"seconds": 1.7e308, "start": START}},
        {"cues": {"start": NOTHING_KNOWN}},
        {"cues": {"start": {**START, "focal_px": 5e-324, "unexplained": -1e308}}},
        {"cues": {"start": {**START, "parallax_px": 1.7e308, "noise_px": -1e308}}},
        {"cues": {"start": {}}},
    ],
)
def test_a_summary_of_odd_numbers_still_makes_a_page(run_folder: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    from uni4d_fg.results.report.build import report_page
    from uni4d_fg.results.run import Run

    shutil.copy(run_folder / "reconstruction.npz", tmp_path)
    whole = json.loads((run_folder / "summary.json").read_text())
    (tmp_path / "summary.json").write_text(json.dumps({**whole, **change}))
    page = judged(lambda: report_page(Run(tmp_path)))
    assert isinstance(page, str)
    assert "What was run" in page


def test_a_whole_summary_reads_back_as_it_was_written(run_folder: Path) -> None:
    assert read_summary(run_folder / "summary.json") == json.loads((run_folder / "summary.json").read_text())


WORDS = st.one_of(
    st.sampled_from(
        [
            "--start",
            "--stop",
            "--stride",
            "--max-size",
            "--set",
            "--config",
            "--masks",
            "--depth",
            "--tracks",
            "--window",
            "--resume",
            "--overwrite",
            "--layout",
            "--json",
            "--quiet",
            "--intrinsics",
            "--depth-model",
            "--classes",
            "--out",
        ]
    ),
    st.sampled_from(
        [
            "0",
            "-1",
            str(10**400),
            "nan",
            "~nosuchuser",
            "/dev/null",
            "/dev/zero",
            "/",
            ".",
            "none",
            "motion",
            "x" * 300,
            "native",
            "uni4d",
            "fast",
            "camera_init.window=1e999",
            "depth_pro=/dev/zero",
            "\udcff",
            "tracking=",
            "=",
            "",
        ]
    ),
    st.text(max_size=5),
)


@hostile
@given(
    verb=st.sampled_from(["validate", "config", "evaluate", "report", "export", "graph", "synthesize", "track"]),
    words=st.lists(WORDS, max_size=5),
)
def test_any_words(tmp_path_factory: pytest.TempPathFactory, verb: str, words: list[str]) -> None:
    folder = tmp_path_factory.getbasetemp() / "working"
    folder.mkdir(exist_ok=True)
    here = Path.cwd()
    os.chdir(folder)
    try:
        judged_verb(verb, *(word for word in words if word != "/"))
    finally:
        os.chdir(here)


@slower
@given(words=st.lists(WORDS, max_size=5))
def test_any_words_with_a_sequence(
    sequence_folder: Path, tmp_path_factory: pytest.TempPathFactory, words: list[str]
) -> None:
    run = tmp_path_factory.getbasetemp() / "any-words"
    shutil.rmtree(run, ignore_errors=True)
    before = state_of(sequence_folder)
    # Whatever else is asked for, the solve is short: this is about the way there.
    judged_verb("reconstruct", sequence_folder, *words, "--max-size", "20", "--out", run, "--quiet")
    assert state_of(sequence_folder) == before


def test_enormous_numbers(sequence_folder: Path, tmp_path: Path) -> None:
    for option in ("--start", "--stop", "--stride", "--max-size"):
        words = [
            "reconstruct",
            sequence_folder,
            option,
            10**400,
            "--out",
            tmp_path / "run",
            "--set",
            "output.pictures=false",
        ]
        if option in ("--start", "--stride"):
            assert judged_verb(*words)[0] == 3


def test_a_foreign_folder_is_no_run(sequence_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "stages").mkdir()
    for name in ("config.yaml", "stages/notes.txt", "summary.json", "depth.npy"):
        (tmp_path / name).write_text("mine")
    before = state_of(tmp_path)
    for option in ("--overwrite", "--resume", "--quiet"):
        assert judged_verb("reconstruct", sequence_folder, "--out", tmp_path, option)[0] == 6
    assert judged_verb("stream", sequence_folder, "--out", tmp_path, "--overwrite")[0] == 6
    assert judged_verb("demo", "--out", tmp_path)[0] == 6
    assert state_of(tmp_path) == before


FOREIGN = (
    "thesis.txt",
    "clouds/mine.ply",
    "clouds/dynamic/holiday.jpg",
    "pictures/cat.png",
    "stages/notes.txt",
    "stages/windows/notes.txt",
    "export/notes.txt",
    "export/colmap/mine.txt",
    "export/tum/photos/a.jpg",
    "graphs/mine.dot",
    "cues/mine.npy",
    ".tmp-0a0a0a0a-notes.txt",
)


def test_files_of_others_in_a_run_stay(run_folder: Path, tmp_path: Path) -> None:
    run, elsewhere = Path(shutil.copytree(run_folder, tmp_path / "run")), tmp_path / "elsewhere"
    assert judged_verb("export", run, "--to", "tum")[0] == 0
    code, _, err = judged_verb("export", run, "--to", "tum")
    assert code == 6
    assert "replace it with --overwrite or choose another --out" in err
    elsewhere.mkdir()
    (elsewhere / "static.ply").write_text("mine")
    shutil.rmtree(run / "clouds")
    for name in FOREIGN:
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text("mine")
    assert judged_verb("export", run, "--to", "tum", "--overwrite")[0] == 6
    shutil.rmtree(run / "pictures")
    (run / "pictures").symlink_to(elsewhere)
    (elsewhere / "scene.png").write_text("mine")
    remove_results(run)
    found = state_of(run)
    expected = {name for name in FOREIGN if name != "pictures/cat.png"} | {"run.json"}
    assert set(found) == expected
    assert state_of(elsewhere) == {"static.ply": b"mine", "scene.png": b"mine"}


def test_the_list_of_an_export_reaches_no_further_than_its_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    mark_run(tmp_path / "run")
    folder = tmp_path / "run" / "export" / "tum"
    folder.mkdir(parents=True)
    names = ["../../../thesis.txt", str(tmp_path / "thesis.txt"), "a.txt"]
    (folder / "export.json").write_text(json.dumps({"format": "tum", "files": names}))
    (folder / "a.txt").write_text("theirs")
    remove_results(tmp_path / "run")
    assert set(state_of(tmp_path)) == {"thesis.txt", "run/run.json"}


def test_a_run_that_died_before_it_was_marked_does_not_stand_in_the_way(sequence_folder: Path, tmp_path: Path) -> None:
    words = [
        "reconstruct",
        sequence_folder,
        "--stop",
        "3",
        "--config",
        "fast",
        "--quiet",
        "--set",
        "output.pictures=false",
    ]
    for left in ((".tmp-0a0a0a0a-run.json",), (".tmp-0a0a0a0a-input.json", "run.json")):
        for option in ([], ["--resume"], ["--overwrite"]):
            run = tmp_path / f"{len(left)}{''.join(option)}"
            mark_run(run)
            for name in left:
                (run / name).write_text((run / "run.json").read_text())
            if "run.json" not in left:
                (run / "run.json").unlink()
            elif not option:
                continue
            code, _, err = judged_verb(*words, "--out", run, *option)
            assert code in (0, 4), err
            assert is_run(run)
            assert not list(run.glob(".tmp-*"))


@pytest.mark.parametrize("change", [["--start", "1"], ["--stride", "2"], ["--stop", "4"], ["other"]])
def test_a_run_is_resumed_with_its_own_video_only(run_folder: Path, tmp_path: Path, change: list[str]) -> None:
    run, sequence = Path(shutil.copytree(run_folder, tmp_path / "run")), run_folder.parent / "room"
    if change == ["other"]:
        sequence, change = Path(shutil.copytree(sequence, tmp_path / "other")), []
    before = state_of(run)
    for verb in ("reconstruct", "stream"):
        code, _, err = judged_verb(verb, sequence, "--out", run, "--resume", *change)
        assert code == 6, err
        assert "holds a run of" in err
    assert state_of(run) == before


def test_a_flipped_bit_in_the_depth_is_noticed(run_folder: Path, sequence_folder: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(run_folder, tmp_path / "run"))
    whole = (run / "depth.npy").read_bytes()
    changed = bytearray(whole)
    changed[128 + 4 * 60 * 80 * 2 + 999] ^= 1
    (run / "depth.npy").write_bytes(changed)
    depth = read_depth(run / "depth.npy")
    assert len([depth[frame] for frame in (0, 1, 3, 4, 5)]) == 5
    with pytest.raises(InputError, match=r"depth of frame 2 is damaged.*--resume"):
        depth[2]
    words = ["reconstruct", sequence_folder, "--out", run, "--config", "fast", "--quiet", "--set", "output.clouds=true"]
    assert judged_verb(*words, "--resume")[0] == 0
    assert (run / "depth.npy").read_bytes() == whole


def test_two_processes_do_not_write_into_one_folder(tmp_path: Path, sequence_folder: Path) -> None:
    program = (
        "import sys\nfrom pathlib import Path\nfrom uni4d_fg.results.run_contents import run_lock\n"
        "with run_lock(Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.readline()\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "run")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline() == "held\n"
        for verb in ("reconstruct", "stream"):
            code, _, err = judged_verb(verb, sequence_folder, "--out", tmp_path / "run")
            assert code == 6
            assert "another process is writing there; wait for it to end or choose another --out" in err
        with pytest.raises(OutputError, match=r"process .* or choose another folder$"), run_lock(tmp_path / "run"):
            pass
        process.kill()
    with run_lock(tmp_path / "run"), run_lock(tmp_path / "run"):
        pass
    with (
        pytest.raises(OutputError, match=r"File exists|is a file|Not a directory"),
        run_lock(sequence_folder / "K.npy"),
    ):
        pass


def test_a_lock_is_not_shared_with_another_thread(tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    def enter() -> None:
        with run_lock(tmp_path):
            pass

    with run_lock(tmp_path), ThreadPoolExecutor(1) as pool:
        refused = judged(pool.submit(enter).result)
        assert isinstance(refused, OutputError)
        assert str(refused).endswith("another thread is writing there; wait for it to end or choose another folder")
    enter()
