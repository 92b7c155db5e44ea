"""A video with a cut: a run for every shot in one folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence

pytest.importorskip("open3d")

Run = Callable[..., tuple[int, str, str]]
QUICK = [
    "--config", "fast", "--quiet", "--set", "output.pictures=false", "--set", "output.clouds=false", "--set",
    "bundle_adjustment.camera_motion.translation_weight=0",
]  # fmt: skip
FRAMES = 8


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of a scene, the same upside down, and three frames of it upright again."""
    folder = tmp_path_factory.mktemp("cuts") / "joined"
    scene = SyntheticSceneConfig(num_frames=FRAMES, width=160, height=120, focal=150.0, objects="none")
    one = make_synthetic_sequence(scene)
    order = [*range(FRAMES), *range(FRAMES), *range(3)]
    turned = [FRAMES <= i < 2 * FRAMES for i in range(len(order))]

    def taken(source: object) -> ArrayFrames:
        frames = [np.asarray(source[t]) for t in order]  # type: ignore[index]
        return ArrayFrames(np.stack([f[::-1, ::-1] if turn else f for f, turn in zip(frames, turned, strict=True)]))

    truth = one.ground_truth.world_T_cam
    assert truth is not None
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    poses = np.stack([truth[t] @ half_turn if turn else truth[t] for t, turn in zip(order, turned, strict=True)])
    count = len(order)
    write_native(
        replace(
            one, images=taken(one.images), depths=taken(one.depths), masks=taken(one.masks), tracks=None,
            timestamps=np.arange(count) / 15.0, frame_names=tuple(f"{t:05d}" for t in range(count)),
            initial_world_T_cam=None, ground_truth=GroundTruth(world_T_cam=poses),
        ),
        folder,
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def split(joined: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from uni4d_fg.cli import main

    run = tmp_path_factory.mktemp("runs") / "split"
    assert main.run(["reconstruct", str(joined), "--out", str(run), *QUICK]) == 0
    return run


def test_every_shot_is_a_run_of_its_own(split: Path) -> None:
    shots = json.loads((split / "shots.json").read_text())["shots"]
    assert [(s["folder"], s["start"], s["stop"], s["exit_code"]) for s in shots] == [
        ("shots/000", 0, FRAMES, 0), ("shots/001", FRAMES, 2 * FRAMES, 0), (None, 2 * FRAMES, 2 * FRAMES + 3, None)
    ]  # fmt: skip
    assert "shots.min_frames" in shots[2]["message"]
    assert all(shot["ate_m"] < 0.02 for shot in shots[:2])
    assert not (split / "reconstruction.npz").exists()
    assert np.loadtxt(split / "shots" / "001" / "trajectory.tum").shape == (FRAMES, 8)


def test_a_shot_is_what_its_frames_alone_give(cli: Run, joined: Path, split: Path, tmp_path: Path) -> None:
    words = ["--start", FRAMES, "--stop", 2 * FRAMES]
    assert cli("reconstruct", joined, "--out", tmp_path / "alone", *words, *QUICK)[0] == 0
    assert not (tmp_path / "alone" / "shots.json").exists()
    alone, shot = (np.loadtxt(f / "trajectory.tum") for f in (tmp_path / "alone", split / "shots" / "001"))
    np.testing.assert_array_equal(alone, shot)


def test_resume_takes_every_shot_over(cli: Run, joined: Path, split: Path) -> None:
    code, out, err = cli("reconstruct", joined, "--out", split, *QUICK, "--resume")
    assert code == 0
    assert out.count("bundle_adjustment (resumed)") == 2
    assert "frames 16 to 18" in err
    code, _, err = cli("reconstruct", joined, "--out", split, *QUICK, "--resume", "--one-shot")
    assert code == 6
    assert "several shots" in err


def test_verbs_go_over_the_shots_or_list_them(cli: Run, split: Path) -> None:
    code, out, _ = cli("evaluate", split, "--json")
    assert code == 0
    assert len(json.loads(out)) == 2
    assert cli("evaluate", split / "shots" / "000")[0] == 0
    code, out, _ = cli("report", split)
    assert code == 0
    assert (split / "shots" / "001" / "report.html").is_file()
    for words in (["export", split, "--to", "tum"], ["view", split], ["graph", split]):
        code, out, err = cli(*words)
        assert (code, out) == (3, "")
        assert "shots/000" in err
        assert "shots/001" in err


def test_one_shot_refuses_to_split_and_warns(cli: Run, joined: Path, split: Path, tmp_path: Path) -> None:
    run = tmp_path / "one"
    shutil.copytree(split, run)
    code, out, _ = cli("reconstruct", joined, "--out", run, "--overwrite", "--one-shot", *QUICK)
    assert code == 0
    assert "warning: there are cuts at frame 8, 16" in out
    assert not (run / "shots").exists()
    assert not (run / "shots.json").exists()
    assert (run / "reconstruction.npz").is_file()


def test_a_video_without_a_shot_of_any_length_is_an_error(cli: Run, joined: Path, tmp_path: Path) -> None:
    """It was taken for reconstructed: exit status 0, and a folder of nothing."""
    words = ["reconstruct", joined, "--out", tmp_path / "run", "--start", FRAMES - 3, "--stop", FRAMES + 4, *QUICK]
    code, out, err = cli(*words)
    assert (code, out) == (3, "")
    assert f"only {FRAMES - 3} to {FRAMES - 1}, {FRAMES} to {FRAMES + 3}; solve it as one with --one-shot" in err
    assert cli(*words, "--one-shot")[0] == 0  # nothing is in the way of the corrected command
    assert cli(*words, "--one-shot")[0] == 6
