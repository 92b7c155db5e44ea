"""``--imu`` on the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from uni4d_fg.cli import main

Run = Callable[..., tuple[int, str, str]]
OPTIONS = [
    "--frames", "30", "--width", "96", "--height", "72", "--objects", "none", "--set", "focal=90",
    "--set", "grid_columns=14", "--set", "grid_rows=10", "--set", "margin_px=3", "--set", "camera_speed=0.84",
]  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("imu") / "scene"
    assert main.run(["synthesize", str(folder), "--imu", "--quiet", *OPTIONS]) == 0
    return folder


def test_a_synthetic_scene_is_reconstructed_with_its_imu(cli: Run, scene: Path, tmp_path: Path) -> None:
    words = ["reconstruct", scene, "--imu", scene, "--out", tmp_path / "run", "--config", "fast", "--quiet", "--json"]
    code, out, err = cli(*words, "--set", "output.pictures=false", "--set", "output.clouds=false")
    assert (code, err) == (0, "")
    stage = json.loads(out)["stages"]["bundle_adjustment"]
    assert stage["imu"]["parts"] == 1
    assert stage["imu"]["frames_by_imu_alone"] == []
    assert 0.95 < stage["imu"]["cue_scale"] < 1.05
    assert any(fact.startswith("IMU: the depth cue times") for fact in stage["facts"])


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--imu", "nowhere"], 3, "nowhere: no such file"),
        (["--imu", "SCENE", "--solver", "adam"], 2, "do not go with solver: adam"),
        (["--imu", "SCENE", "--window", "8", "--overlap", "2"], 2, "do not go with windows"),
        (["--imu", "LATE"], 3, "do not cover the frames"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_made(
    cli: Run, scene: Path, tmp_path: Path, options: list[str], code: int, message: str
) -> None:
    late = tmp_path / "late"
    late.mkdir()
    (late / "imu.csv").write_text((scene / "imu.csv").read_text())
    (late / "imu.yaml").write_text("time_offset: 60.0\n")
    words = [{"SCENE": str(scene), "LATE": str(late)}.get(word, word) for word in options]
    found, _, err = cli("reconstruct", scene, "--out", tmp_path / "run", "--quiet", *words)
    assert found == code
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_short_scene_has_no_path_for_an_imu(cli: Run, tmp_path: Path) -> None:
    code, _, err = cli("synthesize", tmp_path / "short", "--imu", "--frames", 4, "--width", 64, "--height", 48)
    assert code == 3
    assert "needs 6 frames" in err
    assert not (tmp_path / "short").exists()
