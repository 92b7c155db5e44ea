"""``fg.reconstruct``: what of a folder it may replace, and what it says of arguments that cannot be used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pipeline_scenes import NO_VIEWS, TINY, make_scene

import uni4d_fg as fg
from uni4d_fg.errors import ConfigError, InputError, OutputError, SolverError
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_contents import MARKER
from uni4d_fg.results.shot_list import Shot, write_shots
from uni4d_fg.slam.reconstruction import Reconstruction


@fg.factor(fg.variables.POSE, data={"xyz": 3}, dim=3)
def measured_center(world_T_cam: Any, *, xyz: Any) -> Any:
    """Where a camera is, minus where it was measured, meters."""
    return world_T_cam[..., :3, 3] - xyz


def reconstruct(run: Path, **options: Any) -> Reconstruction:
    return fg.reconstruct(make_scene(TINY), run, "fast", NO_VIEWS, **options)


def resumed(run: Path) -> dict[str, bool]:
    stages = json.loads((run / "summary.json").read_text())["stages"]
    return {name: stages[name]["resumed"] for name in ("camera_init", "bundle_adjustment", "nonrigid")}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_earlier_run_is_replaced_or_continued_only_where_that_is_asked_for(tmp_path: Path) -> None:
    run = tmp_path / "run"
    first = reconstruct(run)
    before = contents(run)
    with pytest.raises(OutputError, match=r"holds a run already; .*resume=True .*overwrite=True") as refused:
        reconstruct(run)
    assert "--" not in str(refused.value)
    with pytest.raises(OutputError, match="exclude each other"):
        reconstruct(run, resume=True, overwrite=True)
    assert contents(run) == before
    again = reconstruct(run, resume=True)
    assert all(resumed(run).values())
    np.testing.assert_array_equal(again.world_T_cam, first.world_T_cam)

    fg.export_run(Run(run), ["tum"])
    for page in ("report.html", "share.html"):
        (run / page).write_text("of the earlier run")
    (run / "notes.txt").write_text("mine")
    reconstruct(run, overwrite=True)
    assert not any(resumed(run).values())
    assert not (run / "export").exists()
    assert not (run / "report.html").exists()
    assert not (run / "share.html").exists()
    assert (run / "notes.txt").read_text() == "mine"


def test_a_folder_that_is_no_run_is_never_written_to(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    for options in ({}, {"resume": True}, {"overwrite": True}):
        with pytest.raises(OutputError, match="is not empty and holds no run; choose another folder"):
            reconstruct(tmp_path, **options)
    assert contents(tmp_path) == {"thesis.txt": b"mine"}
    (tmp_path / "empty").mkdir()
    reconstruct(tmp_path / "empty")


def test_a_run_in_several_shots_is_not_continued_as_one(tmp_path: Path) -> None:
    (tmp_path / MARKER).write_text('{"program": "uni4d-fg", "format": 1}')
    write_shots(tmp_path, [Shot("shots/000", 0, 6, 6)])
    before = contents(tmp_path)
    with pytest.raises(OutputError, match=r"several shots, and this one is in one; .*overwrite=True"):
        reconstruct(tmp_path, resume=True)
    assert contents(tmp_path) == before


def test_what_cannot_be_solved_does_not_cost_an_earlier_run(tmp_path: Path) -> None:
    reconstruct(tmp_path)
    before = contents(tmp_path)
    with pytest.raises(InputError, match="no such folder or file"):
        fg.reconstruct(tmp_path / "nosuch.mp4", tmp_path, "fast", overwrite=True)
    measured = fg.MeasurementFiles(odometry=tmp_path / "odometry.tum")
    with pytest.raises(InputError, match="odometry"):
        reconstruct(tmp_path, overwrite=True, measurements=measured)
    assert contents(tmp_path) == before


def test_wrong_arguments_are_named_before_anything_is_made(tmp_path: Path) -> None:
    run, scene = tmp_path / "run", make_scene(TINY)
    with pytest.raises(ConfigError, match=r"a list of section.field=VALUE is expected, such as \['solver=lm'\]"):
        fg.reconstruct(scene, run, "fast", "solver=lm")
    with pytest.raises(ConfigError, match="built already takes none"):
        fg.reconstruct(scene, run, fg.load_config("fast"), ["solver=lm"])
    with pytest.raises(SolverError, match="additions: a list of sources is expected, not one alone"):
        fg.reconstruct(scene, run, "fast", additions=lambda stage, state: None)  # type: ignore[arg-type]
    assert not run.exists()


def test_own_factors_on_more_frames_than_there_are(tmp_path: Path) -> None:
    def positions(stage: Any, state: Any) -> fg.Addition | None:
        measured = np.zeros((8, 3))
        return fg.Addition([measured_center(np.arange(8), xyz=measured, sigma=0.05)]) if stage.finds_cameras else None

    with pytest.raises(
        SolverError, match=r"measured_center reads row 6 of pose \(camera pose, frame 6\).*rows below 6"
    ):
        reconstruct(tmp_path, additions=[positions])
