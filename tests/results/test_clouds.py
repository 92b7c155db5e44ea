"""PLY files: round trip, empty clouds, refusal."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.errors import InputError, MissingDependencyError, OutputError
from uni4d_fg.optional import import_open3d
from uni4d_fg.results import clouds
from uni4d_fg.results.clouds import read_ply, write_clouds, write_ply
from uni4d_fg.results.run_folder import RunFolder


@pytest.fixture(autouse=True)
def _open3d_present() -> None:
    try:
        import_open3d()
    except MissingDependencyError as error:
        pytest.skip(str(error))


def random_cloud(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)), rng.integers(0, 256, (count, 3), dtype=np.uint8)


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_round_trip(tmp_path: Path, count: int) -> None:
    points, colors = random_cloud(0, count)
    path = tmp_path / "clouds" / "static.ply"
    write_ply(path, points, colors)
    assert [p.name for p in path.parent.iterdir()] == ["static.ply"]
    again_points, again_colors = read_ply(path)
    np.testing.assert_allclose(again_points, points, atol=1e-6)
    np.testing.assert_array_equal(again_colors, colors)
    assert path.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0")


def test_every_frame_gets_a_file(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    count = write_clouds(folder, random_cloud(1, 10), (random_cloud(i, 3 * i) for i in range(4)))
    assert count == 4
    names = sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.ply"))
    assert names == [*(f"clouds/dynamic/{i:05d}.ply" for i in range(4)), "clouds/static.ply"]
    assert len(read_ply(folder.dynamic_cloud(3))[0]) == 9


def test_what_is_no_cloud_is_refused(tmp_path: Path) -> None:
    points, colors = random_cloud(2, 4)
    with pytest.raises(OutputError, match="must both be"):
        write_ply(tmp_path / "a.ply", points, colors[:3])
    points[0, 0] = np.nan
    with pytest.raises(OutputError, match="NaN"):
        write_ply(tmp_path / "a.ply", points, colors)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="no such file"):
        read_ply(tmp_path / "a.ply")


def test_a_folder_in_the_way_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(OutputError, match="cannot write"):
        write_ply(tmp_path / "a.ply", *random_cloud(3, 4))


@pytest.mark.parametrize("with_normals", [False, True])
def test_own_files_are_read_as_open3d_reads_them(tmp_path: Path, with_normals: bool) -> None:
    rng = np.random.default_rng(0)
    points, colors = rng.normal(size=(500, 3)), rng.integers(0, 256, (500, 3)).astype(np.uint8)
    write_ply(tmp_path / "a.ply", points, colors, points if with_normals else None)
    theirs = clouds._read_any(tmp_path / "a.ply")
    own = clouds._read_own(
        tmp_path / "a.ply", (tmp_path / "a.ply").read_bytes()[:4096], (tmp_path / "a.ply").stat().st_size
    )
    assert own is not None
    for mine, other in zip(own, theirs, strict=True):
        np.testing.assert_array_equal(mine, other)
        assert mine.dtype == other.dtype


def test_a_part_of_a_file_is_spread_over_all_of_it(tmp_path: Path) -> None:
    points = np.stack((np.arange(1000.0), np.zeros(1000), np.zeros(1000)), axis=1)
    colors = (points % 256).astype(np.uint8)
    write_ply(tmp_path / "own.ply", points, colors)
    # Not as write_ply leaves it.
    (tmp_path / "other.ply").write_bytes((tmp_path / "own.ply").read_bytes().replace(b"uchar red", b"uint8 red"))
    for name in ("own.ply", "other.ply"):
        part, shade = read_ply(tmp_path / name, 50)
        np.testing.assert_array_equal(part[:, 0] // 20, np.arange(50))
        assert len(np.unique(np.diff(part[:, 0]))) > 5
        np.testing.assert_array_equal(shade[:, 0], part[:, 0] % 256)
        assert len(read_ply(tmp_path / name, 5000)[0]) == 1000


def test_files_of_others_and_cut_ones_are_not_taken_for_own(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, np.ones((4, 3)), np.ones((4, 3), np.uint8))
    data = path.read_bytes()
    assert clouds._read_own(path, data, len(data) - 1) is None
    other = data.replace(b"property float z", b"property double z")
    assert clouds._read_own(path, other, len(other)) is None
    assert clouds._read_own(path, b"", 0) is None


def test_the_viewer_starts_without_open3d_and_matplotlib() -> None:
    code = (
        "import sys, uni4d_fg.cli.main, uni4d_fg.results.view.viewer, uni4d_fg.results.view.server; "
        "print([name for name in ('open3d', 'matplotlib', 'torch', 'gtsam') if name in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"
