"""Tasks on real worker processes: killed ones, hung ones, broken ones, and the same bytes as without."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from worker_samples import page_faults, square_or_die

from uni4d_fg import optional
from uni4d_fg.errors import Cancelled, ConfigError, InputError, MissingDependencyError
from uni4d_fg.pipeline.benchmark.on_workers import hang_file, on_workers
from uni4d_fg.pipeline.benchmark.runner import one_after_the_other, run_tasks
from uni4d_fg.pipeline.benchmark.task import Configuration, Task
from uni4d_fg.pipeline.workers import cluster
from uni4d_fg.pipeline.workers.cluster import open_workers
from uni4d_fg.pipeline.workers.memory import free_bytes, reconstruction_bytes, worker_count
from uni4d_fg.pipeline.workers.options import WorkerOptions
from uni4d_fg.pipeline.workers.spread import Lost, _next_workers, spread

pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with open_workers(WorkerOptions(workers=2), 2, tmp_path_factory.mktemp("shared")) as opened:
        yield opened


def results(client: Any, fates: list[str], folder: Path, **changes: Any) -> dict[int, Any]:
    items = [(number, fate, folder) for number, fate in enumerate(fates)]
    traces = [folder / f"{number}.hang.txt" for number in range(len(fates))]
    return dict(spread(client, square_or_die, items, WorkerOptions(**changes), traces))


def attempts(folder: Path, count: int) -> list[int]:
    return [len((folder / f"{number}.tried").read_text()) for number in range(count)]


def test_tasks_that_die_hang_or_raise_cost_the_others_nothing(client: Any, tmp_path: Path) -> None:
    fates = ["", "killed", "always raised", "hung", "always killed", ""]
    found = results(client, fates, tmp_path, time_limit=4.0, retries=1, threads=3)
    assert [found[n][0] for n in (0, 1, 3, 5)] == [0, 1, 9, 25]
    assert {found[n][2] for n in (0, 1, 3, 5)} == {3}
    assert os.getpid() not in {found[n][1] for n in (0, 1, 3, 5)}
    assert found[2] == Lost("RuntimeError: number 2 is broken")  # raised: it would do so again
    assert isinstance(found[4], Lost)
    assert "its process died 2 times" in found[4].why
    assert attempts(tmp_path, 6) == [1, 2, 1, 2, 2, 1]
    assert not (tmp_path / "3.hang.txt").exists()  # it came through at last


def test_workers_are_given_the_next_task_before_results_are_handed_out(client: Any, tmp_path: Path) -> None:
    items = [(number, "", tmp_path) for number in range(8)]
    traces = [tmp_path / f"{number}.hang.txt" for number in range(8)]
    client.wait_for_workers(2, timeout=120)  # one that died in another test may still be starting
    found = spread(client, square_or_die, items, WorkerOptions(), traces)
    first = next(found)
    # Two are done or waiting to be handed out; while nobody asks for more, the others still begin.
    for _ in range(200):
        if len(list(tmp_path.glob("*.tried"))) >= 4:
            break
        time.sleep(0.05)
    begun = len(list(tmp_path.glob("*.tried")))
    assert 4 <= begun < 8
    assert dict([first, *found]).keys() == set(range(8))
    assert attempts(tmp_path, 8) == [1] * 8


def test_the_last_tasks_go_to_whoever_is_done_first() -> None:
    workers = {"a", "b", "c"}
    assert _next_workers(workers, [], 9) == ["a", "b", "c"]
    assert _next_workers(workers, ["a", "b"], 9) == ["c", "a", "b"]
    assert _next_workers(workers, ["a", "b", "c"], 9) == ["a", "b", "c"]
    assert _next_workers(workers, ["a", "b", "c"], 5) == ["a", "b"]
    assert _next_workers(workers, ["a", "b", "c"], 3) == []
    assert _next_workers(workers, ["a", "a", "b"], 9) == ["c", "b"]
    assert _next_workers(workers, ["a", "b"], 2) == ["c"]
    assert _next_workers({"b"}, ["a", "a", "b", "b"], 9) == []


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc's allocator")
def test_large_arrays_are_not_mapped_anew_each_time(client: Any) -> None:
    asked = [client.submit(page_faults, 200, pure=False) for _ in range(2)]
    faults = [future.result(timeout=120) for future in asked]
    # 200 arrays of 4 MB are 204,800 pages.
    assert max(faults) < 20_000


@pytest.mark.slow
def test_a_script_that_workers_cannot_load_is_told_so(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "from uni4d_fg.pipeline.workers.cluster import open_workers\n"
        "from uni4d_fg.pipeline.workers.options import WorkerOptions\n"
        f"with open_workers(WorkerOptions(workers=1), 1, Path({str(tmp_path)!r})) as client:\n"
        "    print(client.submit(len, 'ab').result())\n"
    )
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode != 0
    assert "\nuni4d_fg.errors.ConfigError: worker processes did not start" in ended.stderr
    guarded = script.read_text().replace("with open", 'if __name__ == "__main__":\n  with open')
    script.write_text(guarded)
    assert subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300).stdout == "2\n"


def test_one_that_hangs_again_and_again_is_given_up_and_says_where_it_was(client: Any, tmp_path: Path) -> None:
    found = results(client, ["always hung", ""], tmp_path, time_limit=1.0, retries=0)
    assert found[1][0] == 1
    assert f"ended after 1 s, the time limit; {tmp_path / '0.hang.txt'} says where" in found[0].why
    assert "square_or_die" in (tmp_path / "0.hang.txt").read_text()


@pytest.mark.slow
def test_when_every_worker_is_gone_the_wait_ends_with_one_error(tmp_path: Path) -> None:
    options = WorkerOptions(workers=1, workerless_limit=2.0)
    with open_workers(options, 1, tmp_path) as client:
        found = spread(client, square_or_die, [(0, "", tmp_path), (1, "always hung", tmp_path)], options, [
            tmp_path / "0.hang.txt", tmp_path / "1.hang.txt",
        ])  # fmt: skip
        index, value = next(found)
        assert (index, value[0]) == (0, 0)
        client.cluster.scale(0)
        with pytest.raises(
            InputError, match=r"no worker has been there for 2 s, while 1 task must still be done.*kept"
        ):
            next(found)


def test_without_workers_or_scheduler_there_is_one_error(tmp_path: Path) -> None:
    def lost() -> dict[str, int]:
        raise OSError("in <Client>:\n closed")

    for there, said in (
        (dict, "no worker has been there for 0.1 s"),
        (lost, r"no longer answers \(in <Client>: closed"),
    ):
        client = SimpleNamespace(nthreads=there, cancel=lambda futures, force: None)
        with pytest.raises(InputError, match=said):
            list(
                spread(
                    client, square_or_die, [(0, "", tmp_path)], WorkerOptions(workerless_limit=0.1), [tmp_path / "t"]
                )
            )
    with pytest.raises(ConfigError, match="without workers"):
        WorkerOptions(workerless_limit=0.0)


def test_a_stop_abandons_what_is_not_finished(client: Any, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        list(spread(client, square_or_die, [(0, "", tmp_path)], WorkerOptions(), [tmp_path / "t"], lambda: True))
    assert not (tmp_path / "0.tried").exists()


def test_runs_of_a_cluster_have_the_bytes_of_serial_ones(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also: a scheduler's address is all that is needed, and a restart does nothing."""
    from uni4d_fg.config.synthetic import SyntheticSceneConfig
    from uni4d_fg.frontend.sequence.write import write_native
    from uni4d_fg.frontend.synthetic import make_synthetic_sequence

    scene = SyntheticSceneConfig(
        num_frames=6, height=60, width=80, focal=75.0, margin_px=3.0, grid_columns=14, grid_rows=10, query_interval=4,
        render_images=False,
    )  # fmt: skip
    write_native(make_synthetic_sequence(scene), tmp_path / "root" / "one")
    row = Configuration("default", "default", ("output.clouds=false", "output.pictures=false"))

    def tasks(out: str) -> list[Task]:
        names = ("one", "nosuch")
        root = str(tmp_path / "root")
        (tmp_path / out).mkdir(exist_ok=True)
        return [Task("native", root, v, row, str(tmp_path / out), depth_protocols=("uni4d-scale",)) for v in names]

    far = WorkerOptions(scheduler=client.scheduler.address)
    serial = {result.video: result for result, _ in run_tasks(tasks("serial"), one_after_the_other())}
    spread_out = {result.video: result for result, _ in run_tasks(tasks("far"), on_workers(far))}
    assert serial["one"].failed is None
    assert spread_out["one"].scores == serial["one"].scores
    assert "nosuch" in (spread_out["nosuch"].failed or "")
    here, there = (tmp_path / out / "runs" / "default" / "one" for out in ("serial", "far"))
    files = {p.relative_to(here) for p in here.rglob("*") if p.suffix in (".npz", ".npy", ".txt")}
    assert {p.name for p in files} >= {"reconstruction.npz"}
    for file in files:
        if file.suffix == ".npz":
            with np.load(here / file) as a, np.load(there / file) as b:
                arrays = set(a.files) - {"summary"}  # with the times of the solves
                assert all(a[name].tobytes() == b[name].tobytes() for name in arrays), file
        else:
            assert (here / file).read_bytes() == (there / file).read_bytes(), file
    assert not hang_file(tasks("far")[0]).exists()
    again = list(run_tasks(tasks("far")[:1], on_workers(far)))
    assert [there for _, there in again] == [True]
    told = json.loads(tasks("far")[1].result_file.read_text())
    assert told["failed"] == serial["nosuch"].failed
    monkeypatch.setattr(cluster, "_version", lambda: "0.0")
    with pytest.raises(ConfigError, match=r"here is 0\.0; install the same"):
        list(run_tasks(tasks("other"), on_workers(far)))
    monkeypatch.undo()
    with pytest.raises(InputError, match="sees no folder"):
        list(on_workers(far)([Task("native", "", "one", row, str(tmp_path / "absent"))]))


def test_a_scheduler_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_SECONDS", 0.5)
    with (
        pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"),
        open_workers(WorkerOptions(scheduler="tcp://127.0.0.1:9"), 1, tmp_path),
    ):
        pass


def test_without_dask_the_command_to_install_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise ModuleNotFoundError(name=name)

    # Not in sys.modules: workers of other tests may be starting again at this moment.
    monkeypatch.setattr(optional, "importlib", SimpleNamespace(import_module=absent))
    with pytest.raises(MissingDependencyError, match=r"cluster"), open_workers(WorkerOptions(), 1, tmp_path):
        pass


def test_as_many_run_at_once_as_cores_and_memory_allow() -> None:
    gb = 2**30
    assert worker_count(tasks=10, need_bytes=2 * gb, cores=8, free=9 * gb) == 4
    assert worker_count(tasks=10, need_bytes=2 * gb, cores=3, free=99 * gb) == 3
    assert worker_count(tasks=2, need_bytes=2 * gb, cores=8, free=None) == 2
    assert worker_count(tasks=9, need_bytes=2 * gb, cores=8, free=gb) == 1
    free = free_bytes()
    assert free is None or free > 2**20
    assert reconstruction_bytes(60, (480, 640)) > 60 * 480 * 640 * 16


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"workers": 0}, "--workers 0"),
        ({"threads": 0}, "--threads 0"),
        ({"retries": -1}, "--retries -1"),
        ({"time_limit": 0.0}, "time limit of 0 s"),
        ({"workers": 2, "scheduler": "tcp://x:1"}, "give one of them"),
    ],
)
def test_options_that_make_no_sense_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        WorkerOptions(**changes)
