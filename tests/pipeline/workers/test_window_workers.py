"""The windows of one video on real worker processes: the bytes of a serial run, and a killed worker costs a retry."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worker_samples import describe_window

from uni4d_fg.config.load import load_config
from uni4d_fg.errors import ConfigError, InputError, SolverError
from uni4d_fg.factors.priors import log_scale_prior
from uni4d_fg.factors.variable_types import LOG_SCALE
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.optim.stage import run_stage
from uni4d_fg.optim.stage_graph import RecordingRunner
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.window_tasks import MadeItems
from uni4d_fg.pipeline.window_workers import NOT_ON_WORKERS, WindowWorkers
from uni4d_fg.pipeline.workers.options import WorkerOptions

pytest.importorskip("distributed")
psutil = pytest.importorskip("psutil")

WINDOWS = ("windows.frames=12", "windows.overlap=4", "output.clouds=false", "output.pictures=false")


def scene() -> Sequence:
    return make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=28, height=60, width=80, focal=75.0, margin_px=3.0, grid_columns=16, grid_rows=12,
            render_images=False,
        )
    )  # fmt: skip


def kill_one(mark: Path, killed: list[int]) -> None:
    """Wait until a worker has begun with a window and kill it."""
    own = psutil.Process()
    end = time.monotonic() + 120.0
    while not mark.exists() and time.monotonic() < end:
        time.sleep(0.01)
    for child in own.children(recursive=True):
        # What starts them on Linux has their command line, and is no worker.
        command = " ".join(child.cmdline())
        if "spawn_main" in command or ("forkserver" in command and child.ppid() != own.pid):
            child.kill()
            killed.append(child.pid)
            return


def test_windows_on_workers_have_the_bytes_of_serial_ones_though_one_is_killed(tmp_path: Path) -> None:
    sequence, config = scene(), load_config("default", WINDOWS)
    serial, spread_out, killed = tmp_path / "serial", tmp_path / "workers", list[int]()
    reconstruct(sequence, serial, config, workers=WorkerOptions(workers=1))
    mark = spread_out / "stages" / "windows" / "window_0.hang.txt"
    killer = threading.Thread(target=kill_one, args=(mark, killed))
    killer.start()
    summary = reconstruct(sequence, spread_out, config, workers=WorkerOptions(workers=2))
    killer.join()
    assert len(killed) == 1
    assert any("3 windows" in fact for fact in summary.stages["bundle_adjustment"]["facts"])
    files = sorted(p.relative_to(serial) for p in serial.rglob("*") if p.suffix in (".npz", ".npy", ".txt", ".values"))
    assert files == sorted(
        p.relative_to(spread_out) for p in spread_out.rglob("*") if p.suffix in (".npz", ".npy", ".txt", ".values")
    )
    names = {file.name for file in files}
    assert {"reconstruction.npz", "scene_000000.npz", "bundle_adjustment.graph.npz", "nonrigid.graph.npz"} <= names
    for file in files:
        if file.suffix == ".npz":
            with np.load(serial / file) as a, np.load(spread_out / file) as b:
                arrays = set(a.files) - {"summary"}  # with the times of the solves
                assert set(a.files) == set(b.files)
                assert all(a[name].tobytes() == b[name].tobytes() for name in arrays), file
        else:
            assert (serial / file).read_bytes() == (spread_out / file).read_bytes(), file


def test_what_goes_wrong_with_a_window_is_said_and_graphs_are_those_of_the_last(tmp_path: Path) -> None:
    config, recorder = load_config("default", WINDOWS), RecordingRunner(run_stage)

    def workers(**changes: Any) -> WindowWorkers:
        return WindowWorkers(WorkerOptions(**changes), 1, tmp_path, config, recorder, lambda: False)

    items = MadeItems(range(3), lambda index: (index, "ok", tmp_path))
    with workers() as each:
        assert sorted(each(describe_window, items)) == [(0, 0), (1, 1), (2, 4)]
        # The last window has no solve of the kind 'structure': the one before has the last of it.
        counts = {kind: len(graph.final_state[LOG_SCALE]) for kind, graph in recorder.solved.items()}
        assert counts == {"structure": 2, "nonrigid": 3}
        (batch,) = recorder.solved["nonrigid"].problem.batches
        assert batch.factor_type is log_scale_prior
        with pytest.raises(InputError, match="window 1 is gone"):
            list(each(describe_window, MadeItems([1], lambda index: (index, "gone", tmp_path))))
    with workers(time_limit=2.0) as each:
        hung = MadeItems([2], lambda index: (index, "hung", tmp_path))
        assert list(each(describe_window, hung)) == [(0, 4)]  # at the second attempt
        assert (tmp_path / "hung").exists()
    with workers(retries=0) as each, pytest.raises(SolverError, match="cannot be solved on the workers: its process"):
        list(each(describe_window, MadeItems([1], lambda index: (index, "killed", tmp_path))))


def test_workers_without_windows_are_refused_and_additions_stay_here(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"set windows\.frames"):
        reconstruct(scene(), tmp_path / "a", load_config("default"), workers=WorkerOptions(workers=2))
    source = [lambda stage, state: None]
    summary = reconstruct(
        scene(), tmp_path / "b", load_config("fast", WINDOWS), workers=WorkerOptions(workers=2), additions=source
    )
    assert NOT_ON_WORKERS in summary.warnings
