"""What a run shows before it is finished."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from viewing_samples import copied, opened

from uni4d_fg.cli.viewing import open_run
from uni4d_fg.errors import InputError
from uni4d_fg.results.run import Run


@pytest.fixture
def unfinished(finished_run: Path, tmp_path: Path) -> Path:
    run = copied(finished_run, tmp_path)
    for name in ("summary.json", "reconstruction.npz", "depth.npy", "clouds/static.ply"):
        (run / name).unlink()
    return run


def test_every_stage_adds_what_it_found(unfinished: Path, finished_run: Path) -> None:
    whole = opened(finished_run).reconstruction
    run = open_run(unfinished, unfinished=True)
    np.testing.assert_allclose(run.reconstruction.world_T_cam, whole.world_T_cam)
    np.testing.assert_array_equal(run.reconstruction.landmark_color, whole.landmark_color)
    np.testing.assert_array_equal(run.reconstruction.dynamic_points, whole.dynamic_points)
    assert "not finished: this is what stage nonrigid found" in run.summary["warnings"][0]
    assert run.depth is None
    assert run.sequence is not None
    (unfinished / "stages" / "nonrigid.npz").unlink()
    run = open_run(unfinished, unfinished=True)
    assert len(run.reconstruction.landmarks) == len(whole.landmarks)
    assert run.reconstruction.dynamic_points.shape == (0, whole.num_frames, 3)
    (unfinished / "stages" / "bundle_adjustment.npz").unlink()
    run = open_run(unfinished, unfinished=True)
    assert run.reconstruction.num_frames == whole.num_frames
    assert len(run.reconstruction.landmarks) == 0
    assert "camera init" in run.summary["warnings"][0]
    (unfinished / "stages" / "camera_init.npz").unlink()
    with pytest.raises(InputError, match="no cameras to show yet"):
        open_run(unfinished, unfinished=True)
    # Of a video alone the cues are still being made: it is no sequence yet.
    with pytest.raises(InputError, match="no cameras to show yet"):
        Run(unfinished, lambda: pytest.fail("the sequence was opened"), unfinished=True)


def test_a_stage_of_an_earlier_run_is_not_shown(unfinished: Path) -> None:
    (unfinished / "stages" / "bundle_adjustment.npz").touch()
    run = open_run(unfinished, unfinished=True)
    assert len(run.reconstruction.landmarks) > 0
    assert len(run.reconstruction.dynamic_points) == 0


def test_only_who_asks_for_it_gets_an_unfinished_run(unfinished: Path) -> None:
    with pytest.raises(InputError, match="not finished; continue it"):
        open_run(unfinished)
