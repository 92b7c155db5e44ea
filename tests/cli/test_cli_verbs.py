"""Every verb through the one entry point: exit code, standard output, standard error."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from uni4d_fg.cli import demonstration, main, reconstruction
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.runs import SequenceInput
from uni4d_fg.config.load import load_config
from uni4d_fg.errors import Cancelled, InputError, SolverError
from uni4d_fg.files import load_npz, save_npy
from uni4d_fg.frontend.sequence.calibration import shared_intrinsics
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.tracks.io import load_tracks

pytest.importorskip("open3d")

Run = Callable[..., tuple[int, str, str]]

TINY_SCENE = SyntheticSceneConfig(num_frames=8, width=128, height=96, focal=120.0, grid_columns=20, grid_rows=15)
SCENE_OPTIONS = [
    "--frames", "8", "--width", "128", "--height", "96", "--set", "focal=120", "--set", "grid_columns=20",
    "--set", "grid_rows=15",
]  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "room"
    assert main.run(["synthesize", str(folder), "--quiet", *SCENE_OPTIONS]) == 0
    return folder


@pytest.fixture(scope="module")
def finished(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "room"
    words = ["reconstruct", str(scene), "--out", str(run), "--config", "fast", "--quiet"]
    assert main.run(words) == 0
    return run


def test_help_names_every_verb(cli: Run) -> None:
    code, out, _ = cli("--help")
    assert code == 0
    for verb in ("demo", "validate", "track", "reconstruct", "evaluate", "synthesize", "config"):
        assert verb in out
        assert cli(verb, "--help")[0] == 0


def test_help_has_no_types_of_python(cli: Run) -> None:
    for verb in ("export", "reconstruct", "render", "benchmark", "stream"):
        code, out, _ = cli(verb, "--help")
        assert code == 0
        options = out.split("Options", 1)[1]
        for word in ("<bool>", "<path>", "<int", "<list", "<str"):
            assert word not in options, (verb, word)
    out = cli("export", "--help")[1]
    assert all(name in out for name in ("colmap", "gsplat", "ply-frames", "uni4d"))


def test_a_verb_does_not_wait_for_the_modules_of_others() -> None:
    code = (
        "import sys; from uni4d_fg.cli.main import run; run(['view', '--help']); "
        "sys.exit(any('uni4d_fg.' + name in sys.modules for name in ('cli.benchmark', 'config.models', 'cues.plan')))"
    )
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0


def test_version(cli: Run) -> None:
    code, out, _ = cli("--version")
    assert (code, out.split()[0]) == (0, "uni4d-fg")


@pytest.mark.parametrize("words", [["nosuch"], ["reconstruct"], ["validate", "a", "b"], ["evaluate", "--nosuch"]])
def test_a_wrong_command_line_exits_with_2(cli: Run, words: list[str]) -> None:
    code, out, err = cli(*words)
    assert (code, out) == (2, "")
    assert "Usage" in err


def leaves(values: dict[str, Any]) -> list[Any]:
    return [leaf for value in values.values() for leaf in (leaves(value) if isinstance(value, dict) else [value])]


def test_config_prints_a_configuration_that_reads_back_the_same(cli: Run, tmp_path: Path) -> None:
    code, whole, _ = cli("config", "--all", "--preset", "paper", "--set", "camera_init.window=4")
    assert code == 0
    assert yaml.safe_load(whole) == load_config("paper", ["camera_init.window=4"]).model_dump(mode="json")
    code, out, _ = cli("config", "--preset", "paper", "--set", "camera_init.window=4")
    assert code == 0
    assert 0 < len(leaves(yaml.safe_load(out))) < 0.5 * len(leaves(yaml.safe_load(whole)))
    (tmp_path / "c.yaml").write_text(out)
    assert cli("config", "--config", tmp_path / "c.yaml")[1] == out
    assert cli("config", "--all", "--config", tmp_path / "c.yaml")[1] == whole


def test_a_configuration_error_is_one_line_and_exits_with_2(cli: Run) -> None:
    code, out, err = cli("config", "--set", "camera_init.windw=3")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert "camera_init.window?" in err


def test_synthesize_writes_a_readable_sequence_with_its_parameters(cli: Run, scene: Path) -> None:
    parameters = yaml.safe_load((scene / "scene.yaml").read_text())
    assert parameters == TINY_SCENE.model_dump(mode="json")
    code, out, _ = cli("validate", scene)
    assert code == 0
    assert "can be reconstructed" in out
    for item in ("images", "depth", "masks", "intrinsics", "tracks", "true poses"):
        assert item in out


def test_synthesize_in_the_other_layout(cli: Run, tmp_path: Path) -> None:
    words = ["synthesize", tmp_path / "u", "--layout", "uni4d", "--frames", 2, *SCENE_OPTIONS[2:], "--quiet"]
    assert cli(*words)[0] == 0
    code, out, _ = cli("validate", tmp_path / "u", "--json")
    report = json.loads(out)
    assert (code, report["layout"], report["ok"]) == (0, "uni4d", True)


def test_synthesize_refuses_what_is_in_the_way_and_wrong_values(cli: Run, scene: Path, tmp_path: Path) -> None:
    code, _, err = cli("synthesize", scene)
    assert code == 6
    assert "exists already" in err
    code, _, err = cli("synthesize", tmp_path / "s", "--path", "sideways")
    assert code == 2
    assert "handheld" in err
    assert not (tmp_path / "s").exists()


def test_validate_lists_findings_with_remedies_and_exits_with_3(cli: Run, scene: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    (broken / "rgb").mkdir(parents=True)
    for path in (scene / "rgb").iterdir():
        (broken / "rgb" / path.name).symlink_to(path)
    save_npy(broken / "depth_cue.npy", np.ones((3, 96, 128), np.float32))
    code, out, _ = cli("validate", broken)
    assert code == 3
    assert "error: depth" in out
    assert "to do: " in out
    assert out.splitlines()[-1] == "cannot be reconstructed as it is: 1 error, 1 warning"
    code, out, _ = cli("validate", broken, "--json")
    assert (code, json.loads(out)["ok"]) == (3, False)


def test_validate_checks_what_reconstruct_will_use(cli: Run, scene: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(scene, tmp_path / "room"))
    sorted((folder / "rgb").iterdir())[-1].write_bytes(b"broken")
    (folder / "K.npy").rename(tmp_path / "known.npy")
    (folder / "K.npy").write_bytes(b"broken")
    code, out, _ = cli("validate", folder)
    assert code == 3
    assert "error: images" in out
    assert "error: intrinsics" in out
    words = ["validate", folder, "--stop", "7", "--intrinsics", tmp_path / "known.npy"]
    assert cli(*words)[0] == 0
    code, out, _ = cli(*words, "--set", "input.max_depth_m=0.1")
    assert code == 3
    assert "lies outside 0.05 to 0.1 m in every frame" in out
    assert cli(*words, "--start", "3", "--stride", "4")[0] == 3


@pytest.mark.parametrize("verb", ["validate", "reconstruct", "track", "evaluate"])
def test_a_missing_folder_exits_with_3(cli: Run, verb: str, tmp_path: Path) -> None:
    code, out, err = cli(verb, tmp_path / "nosuch")
    assert code == 3
    assert "no such folder" in out + err


def test_track_writes_a_file_and_does_not_replace_one(cli: Run, scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "tracks.npz"
    words = ["track", scene, "--out", path, "--set", "tracking.grid_columns=8", "--set", "tracking.grid_rows=6"]
    code, out, err = cli(*words)
    assert code == 0
    assert str(path) in out
    assert "tracking: " in err
    tracks = load_tracks(path)
    assert tracks.num_frames == 8
    assert out.startswith(f"{tracks.num_tracks} tracks")
    code, _, err = cli(*words)
    assert code == 6
    assert "--overwrite" in err
    assert cli(*words, "--overwrite", "--quiet")[2] == ""
    assert cli("track", scene)[0] == 6  # the sequence has tracks of its own


def test_track_needs_images_only(cli: Run, scene: Path, tmp_path: Path) -> None:
    (tmp_path / "rgb").symlink_to(scene / "rgb")
    words = ["--quiet", "--set", "tracking.grid_columns=6", "--set", "tracking.grid_rows=4"]
    assert cli("track", tmp_path, *words)[0] == 0
    assert (tmp_path / "tracks.npz").is_file()
    (tmp_path / "deva" / "Annotations").mkdir(parents=True)
    code, _, err = cli("track", tmp_path, *words)
    assert code == 3
    assert "--out" in err
    code, _, err = cli("track", tmp_path / "deva")
    assert code == 3
    assert "no .png" in err or "rgb" in err
    images_alone = ["track", scene / "rgb", "--out", tmp_path / "bare.npz"]
    assert cli(*images_alone, *words)[0] == 0
    assert load_tracks(tmp_path / "bare.npz").num_frames == 8


def test_reconstruct_leaves_a_run_folder(finished: Path, scene: Path) -> None:
    for name in ("reconstruction.npz", "trajectory.tum", "depth.npy", "summary.json", "labels.npz", "config.yaml"):
        assert (finished / name).is_file(), name
    assert load_config(finished / "config.yaml") == load_config("fast")
    assert json.loads((finished / "input.json").read_text())["root"] == str(scene)
    assert len(load_npz(finished / "reconstruction.npz", {"world_T_cam": 3})["world_T_cam"]) == 8


def test_a_run_is_not_overwritten_by_accident(cli: Run, finished: Path, scene: Path, tmp_path: Path) -> None:
    code, _, err = cli("reconstruct", scene, "--out", finished)
    assert code == 6
    assert "--resume" in err
    assert "--overwrite" in err
    assert cli("reconstruct", scene, "--out", finished, "--resume", "--overwrite")[0] == 6
    (tmp_path / "thesis.txt").write_text("mine")
    for option in ([], ["--resume"], ["--overwrite"]):
        code, _, err = cli("reconstruct", scene, "--out", tmp_path, *option)
        assert code == 6
        assert "holds no run" in err
    assert (tmp_path / "thesis.txt").read_text() == "mine"
    (tmp_path / "input.json").write_text('{"root": "/"}')
    assert cli("reconstruct", scene, "--out", tmp_path, "--overwrite")[0] == 6
    assert cli("reconstruct", scene, "--out", tmp_path / "thesis.txt")[0] == 6


def test_resume_takes_finished_stages_over(cli: Run, finished: Path, scene: Path) -> None:
    code, out, _ = cli("reconstruct", scene, "--out", finished, "--config", "fast", "--resume", "--quiet", "--json")
    assert code == 0
    stages = json.loads(out)["stages"]
    assert all(stages[name]["resumed"] for name in ("tracks", "camera_init", "bundle_adjustment", "nonrigid"))


def test_overwrite_replaces_results_and_nothing_else(cli: Run, scene: Path, tmp_path: Path) -> None:
    words = ["reconstruct", scene, "--out", tmp_path, "--config", "fast"]
    assert cli(*words, "--quiet")[0] == 0
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "clouds" / "stale.ply").write_text("old")
    code, out, err = cli(*words, "--overwrite", "--set", "output.clouds=false")
    assert code == 0
    assert f"results: {tmp_path}" in out
    assert "bundle adjustment: " in err
    assert (tmp_path / "notes.txt").exists()
    assert [path.name for path in (tmp_path / "clouds").iterdir()] == ["stale.ply"]


def test_an_unusable_sequence_does_not_cost_an_earlier_run(cli: Run, finished: Path, tmp_path: Path) -> None:
    assert cli("reconstruct", tmp_path / "nosuch", "--out", finished, "--overwrite")[0] == 3
    assert (finished / "reconstruction.npz").exists()


def test_home_folders_that_the_shell_leaves_as_they_are(
    cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of ``--out=~/run`` a folder named ``~`` was made."""
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    assert cli("synthesize", "~/a room", "--quiet", *SCENE_OPTIONS)[0] == 0
    assert cli("track", "~/a room", "--out=~/tracks.npz")[0] == 0
    assert cli("validate", tmp_path / "home" / "a room")[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
    assert (tmp_path / "home" / "tracks.npz").is_file()


@pytest.mark.parametrize("verb", ["reconstruct", "stream"])
def test_frames_that_may_be_in_another_order_are_warned_of(cli: Run, scene: Path, tmp_path: Path, verb: str) -> None:
    """``ffmpeg -i clip.mp4 rgb/%d.png`` writes 10 before 2 in the order of names."""
    folder = Path(shutil.copytree(scene, tmp_path / "room"))
    for name in ("rgb", "depth_cue", "masks"):
        for index, path in enumerate(sorted((folder / name).iterdir())):
            path.rename(path.with_name(f"{3 * index + 1}{path.suffix}"))  # 1, 4, ..., 22
    assert cli(verb, folder, "--out", tmp_path / "run", "--config", "fast")[0] == 0
    warnings = json.loads((tmp_path / "run" / "summary.json").read_text())["warnings"]
    assert len([text for text in warnings if "in which 22 comes before 4;" in text]) == 1


@pytest.mark.parametrize(
    ("verb", "words", "code"),
    [
        ("reconstruct", ["--window", "6", "--overlap", "3"], 2),
        ("reconstruct", ["--overlap", "2"], 2),
        ("reconstruct", ["--time-limit", "5"], 2),
        ("reconstruct", ["--config", "paper", "--window", "6", "--overlap", "2"], 2),
        ("reconstruct", ["--config", "paper", "--set", "camera.model=radial"], 2),
        ("reconstruct", ["--config", "paper", "--set", "camera.zoom=on"], 2),
        ("reconstruct", ["--set", "input.poses=fixed"], 3),
        ("stream", ["--config", "paper"], 2),
        ("stream", ["--set", "incremental.window=3"], 2),
        ("stream", ["--set", "camera.model=radial"], 2),
        ("stream", ["--odometry", "nosuch.tum"], 3),
    ],
)
def test_what_cannot_be_asked_of_a_video_costs_no_run(
    cli: Run, finished: Path, scene: Path, tmp_path: Path, verb: str, words: list[str], code: int
) -> None:
    kept = (finished / "summary.json").read_bytes()
    assert cli(verb, scene, "--out", finished, "--overwrite", *words)[0] == code
    assert (finished / "summary.json").read_bytes() == kept
    assert cli(verb, scene, "--out", tmp_path / "run", *words)[0] == code
    assert not (tmp_path / "run" / "run.json").exists()  # the corrected command may write there


def test_intrinsics_that_are_replaced_are_not_read(scene: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(scene, tmp_path / "room"))
    (folder / "K.npy").rename(tmp_path / "known.npy")
    (folder / "K.npy").write_bytes(b"broken")

    def source(intrinsics: Path | None) -> SequenceInput:
        given = None if intrinsics is None else str(intrinsics)
        return SequenceInput.of(
            folder, LayoutChoice.auto, None, None, None, depth_gt_scale=1000.0, known_intrinsics=False, intrinsics=given
        )

    with pytest.raises(InputError, match=r"K\.npy"):
        source(None).open()
    expected = shared_intrinsics(np.load(tmp_path / "known.npy"), folder, 8, (96, 128))
    opened = source(tmp_path / "known.npy").open().video
    np.testing.assert_array_equal(opened.intrinsics, expected)
    np.testing.assert_array_equal(source(tmp_path / "known.npy").read().intrinsics, expected)


def test_evaluate_finds_the_sequence_of_the_run(cli: Run, finished: Path, scene: Path) -> None:
    code, out, _ = cli("evaluate", finished)
    assert code == 0
    assert "ATE" in out
    code, out, _ = cli("evaluate", finished, "--sequence", scene, "--json")
    report = json.loads(out)
    assert (code, report["frames"]) == (0, 8)
    assert report["trajectory"]["ate_m"] < 0.1


def test_evaluate_of_a_sequence_that_was_moved_says_how_to_give_it(
    cli: Run, finished: Path, scene: Path, tmp_path: Path
) -> None:
    for name in ("reconstruction.npz", "labels.npz", "summary.json"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    (tmp_path / "input.json").write_text(json.dumps({"root": str(tmp_path / "gone")}))
    code, _, err = cli("evaluate", tmp_path)
    assert code == 3
    assert f"{tmp_path / 'gone'}: no such folder or file" in err
    assert "if it was moved, give its folder with --sequence" in err
    assert cli("evaluate", tmp_path, "--sequence", scene)[0] == 0


def test_evaluate_takes_the_frames_of_a_sequence_that_the_run_was_made_from(
    cli: Run, scene: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    assert cli("reconstruct", scene, "--out", run, "--stride", "2", "--start", "1", "--config", "fast")[0] == 0
    code, out, _ = cli("evaluate", run, "--sequence", scene, "--json")
    report = json.loads(out)
    assert (code, report["frames"]) == (0, 4)
    assert report["trajectory"]["poses"] == 4
    assert report["trajectory"]["ate_m"] < 0.1


def test_evaluate_falls_back_to_the_summary_and_says_what_is_missing(cli: Run, finished: Path, tmp_path: Path) -> None:
    for name in ("reconstruction.npz", "labels.npz", "summary.json"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    assert cli("evaluate", tmp_path)[0] == 0
    (tmp_path / "summary.json").write_text('{"sequence": {"root": null}}')
    code, _, err = cli("evaluate", tmp_path)
    assert code == 3
    assert "--sequence" in err
    for text in ("{", "[]", '{"sequence": 3}', '{"sequence": {"root": 7}}', "\x00"):
        (tmp_path / "summary.json").write_text(text)
        assert cli("evaluate", tmp_path)[0] == 3
    (tmp_path / "summary.json").unlink()
    code, _, err = cli("evaluate", tmp_path)
    assert code == 3
    assert "summary.json" in err


def test_demo_reports_its_accuracy_and_reuses_its_scene(
    cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demonstration, "FAST_SCENE", TINY_SCENE)
    folder = tmp_path / "demo"
    code, out, err = cli("demo", "--fast", "--out", folder)
    assert code == 0
    for text in ("ATE", "RPE", "focal length", "dynamic points", "AbsRel", "uni4d-fg evaluate"):
        assert text in out
    assert "earlier demo" not in err
    image = folder / "sequence" / "rgb" / "00000.png"
    written = image.stat().st_mtime_ns
    code, out, err = cli("demo", "--fast", "--out", folder, "--json")
    assert code == 0
    assert set(json.loads(out)) == {"summary", "evaluation"}
    assert "earlier demo" in err
    assert image.stat().st_mtime_ns == written
    monkeypatch.setattr(demonstration, "FAST_SCENE", TINY_SCENE.model_copy(update={"seed": 1}))
    assert cli("demo", "--fast", "--out", folder, "--quiet")[0] == 0
    assert image.stat().st_mtime_ns != written


def test_demo_leaves_other_folders_alone(cli: Run, finished: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    for folder in (tmp_path, tmp_path / "thesis.txt", finished):
        code, _, err = cli("demo", "--fast", "--out", folder)
        assert code == 6
        assert "--out" in err


@pytest.mark.parametrize(
    ("error", "code", "kind"),
    [
        (SolverError("bundle adjustment:\nsingular"), 5, "error: bundle adjustment: singular\n"),
        (Cancelled("stopped"), 130, "stopped: "),
        (ZeroDivisionError("by zero"), 70, "error: unexpected ZeroDivisionError: by zero; please report"),
    ],
)
def test_what_goes_wrong_inside_is_one_line(
    cli: Run, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: int, kind: str
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(reconstruction, "run_pipeline", fail)
    got, out, err = cli("reconstruct", scene, "--out", tmp_path / "r")
    assert (got, out) == (code, "")
    assert err.startswith(kind)
    assert err.count("\n") == 1


def test_debug_shows_the_traceback(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(reconstruction, "run_pipeline", fail)
    assert main.run(["reconstruct", str(scene), "--out", str(tmp_path / "r"), "--debug"]) == 70
    assert "Traceback" in capsys.readouterr().err
