"""A disk that fills up at any moment: one clear error, nothing half-written, and --resume works once there is space."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pipeline_scenes import (
    TINY,
    arrays_of,
    assert_same_result,
    check_run,
    make_config,
    make_scene,
    run_sound,
    temporary_files,
)

from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.clouds import read_ply
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder

pytest.importorskip("open3d")

QUICK = ("bundle_adjustment.measure_noise=false", "bundle_adjustment.structure=keep")
WITHOUT_CLOUDS = make_config(*QUICK)
WITH_CLOUDS = make_config(*QUICK, "output.clouds=true")


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return make_scene(TINY, num_frames=4)


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory, sequence: Sequence) -> Path:
    run_dir = tmp_path_factory.mktemp("complete")
    run_sound(sequence, run_dir, WITH_CLOUDS)
    return run_dir


def assert_only_whole_files(run_dir: Path, sequence: Sequence) -> None:
    """Assert that whatever a failed run left can be read in full."""
    folder = RunFolder(run_dir)
    assert temporary_files(run_dir) == []
    assert not folder.summary.exists()
    for path in (run_dir / "stages").glob("*.npz"):
        assert "key" in arrays_of(path)
    if folder.labels.exists():
        assert load_labels(folder.labels).tracks.num_frames == sequence.num_frames
    if folder.depth.exists():
        assert read_depth(folder.depth).array.shape == (sequence.num_frames, *sequence.image_size)
    if folder.reconstruction.exists():
        arrays_of(folder.reconstruction)
    for path in run_dir.rglob("*.ply"):
        count = int(path.read_bytes().split(b"element vertex ")[1].split(b"\n")[0])
        assert len(read_ply(path)[0]) == count


def test_every_writer_fails_cleanly_and_the_run_goes_on_where_it_was(
    tmp_path: Path, sequence: Sequence, complete: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    move, failed = os.replace, []
    num_files = sum(path.is_file() for path in complete.rglob("*"))

    def full_for_every_new_file(source: Path, target: Path) -> None:
        if target.name not in failed:
            failed.append(target.name)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        move(source, target)

    monkeypatch.setattr(os, "replace", full_for_every_new_file)
    for attempt in range(1, num_files + 1):
        with pytest.raises(OutputError) as caught:
            reconstruct(sequence, tmp_path, WITH_CLOUDS, resume=True)
        assert len(failed) == attempt
        assert f"{failed[-1]}: No space left on device; free space or choose another --out" in str(caught.value)
        assert_only_whole_files(tmp_path, sequence)
        assert not list(tmp_path.rglob(failed[-1]))
    reconstruct(sequence, tmp_path, WITH_CLOUDS, resume=True)
    check_run(tmp_path, sequence)
    assert_same_result(tmp_path, complete)
    stages = [
        "tracks.npz", "rolling_shutter.npz", "lens.graph.npz", "lens.npz", "camera_init.graph.npz", "camera_init.npz",
        "bundle_adjustment.graph.npz",
        "bundle_adjustment.npz", "nonrigid.graph.npz", "nonrigid.npz",
    ]  # fmt: skip
    kinds = ("bundle_adjustment", "camera_init", "lens", "nonrigid")
    values = [f"{kind}.{end}.values" for kind in kinds for end in ("initial", "final")]
    views = ["static.ply", *(f"{t:05d}.ply" for t in range(4))]
    assert failed == [
        "run.json", "config.yaml", "labels.npz", *stages, "confidence.npy", "depth.npy", "fusion.npz",
        "reconstruction.npz", "trajectory.tum", *views, *values, "summary.json",
    ]  # fmt: skip


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system in memory, to be given its size by ``resize``."""
    mounted = tmp_path / "disk"
    mounted.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16k", "none", str(mounted)]
    try:
        done = subprocess.run(command, capture_output=True, check=False)
    except OSError:
        pytest.skip("no mount command here")
    if done.returncode != 0:
        pytest.skip("mounting a small file system needs root")
    yield mounted
    subprocess.run(["umount", str(mounted)], check=True)


def resize(disk: Path, kilobytes: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", str(disk)], check=True)


def used_kilobytes(folder: Path) -> int:
    return sum(used_kilobytes_of(path) for path in folder.rglob("*") if path.is_file())


def used_kilobytes_of(path: Path) -> int:
    return -(-path.stat().st_size // 4096) * 4


@pytest.mark.skipif(sys.platform != "linux", reason="needs tmpfs")
def test_a_disk_that_is_really_full(small_disk: Path, sequence: Sequence, complete: Path) -> None:
    run_dir, config = small_disk / "run", WITHOUT_CLOUDS
    needed = used_kilobytes(complete) - used_kilobytes(complete / "clouds")
    # The summary comes last, and how large it is differs by a block from run to run.
    half_a_summary = used_kilobytes_of(RunFolder(complete).summary) // 2
    for size in (*(int(part * needed) for part in (0.02, 0.3, 0.6, 0.8, 0.9)), needed - half_a_summary):
        resize(small_disk, size)
        with pytest.raises(OutputError, match=r"cannot write .*No space left on device; free space or choose another"):
            reconstruct(sequence, run_dir, config, resume=True)
        assert_only_whole_files(run_dir, sequence)
    resize(small_disk, 4 * needed)
    reconstruct(sequence, run_dir, config, resume=True)
    check_run(run_dir, sequence)
    assert_same_result(run_dir, complete)


@pytest.mark.skipif(sys.platform != "linux", reason="needs tmpfs")
def test_clouds_on_a_disk_that_is_really_full(small_disk: Path, sequence: Sequence, complete: Path) -> None:
    run_dir = small_disk / "run"
    resize(small_disk, 16 * used_kilobytes(complete))
    reconstruct(sequence, run_dir, WITHOUT_CLOUDS)
    # The next run starts by removing the one and replacing the other: their space is not to count twice.
    summary, config = RunFolder(run_dir).summary, RunFolder(run_dir).config
    kept = used_kilobytes(run_dir) - used_kilobytes_of(summary)
    summary.unlink()
    config.unlink()
    resize(small_disk, kept + used_kilobytes(complete / "clouds") // 3)
    with pytest.raises(OutputError, match=r"cannot write .*\.ply"):
        reconstruct(sequence, run_dir, WITH_CLOUDS, resume=True)
    assert_only_whole_files(run_dir, sequence)


def test_a_run_folder_that_is_a_file(tmp_path: Path, sequence: Sequence) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(OutputError, match=r"cannot write .*run"):
        reconstruct(sequence, tmp_path / "run", WITH_CLOUDS)
    assert (tmp_path / "run").read_text() == "a file"


def test_a_folder_in_the_place_of_a_result(tmp_path: Path, sequence: Sequence) -> None:
    (tmp_path / "reconstruction.npz").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*reconstruction\.npz: Is a directory"):
        reconstruct(sequence, tmp_path, WITH_CLOUDS)
    assert temporary_files(tmp_path) == []
