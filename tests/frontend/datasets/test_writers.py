"""Scenes written as videos of the datasets: the bytes that the layouts' documentation asks for, and read back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import miniatures
import numpy as np
import pytest

from uni4d_fg.frontend.datasets.registry import find_dataset
from uni4d_fg.frontend.datasets.writers import WRITERS
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence

Run = Callable[..., tuple[int, str, str]]


def sequence_of(truth: miniatures.Truth, times: np.ndarray) -> Sequence:
    count = len(times)
    return Sequence(
        name="x", images=ArrayFrames(truth.images), depths=ArrayFrames(truth.depths),
        masks=ArrayFrames(truth.masks), intrinsics=truth.intrinsics,
        image_size=(miniatures.HEIGHT, miniatures.WIDTH), timestamps=times,
        frame_names=tuple(f"{i:05d}" for i in range(count)),
        ground_truth=GroundTruth(
            world_T_cam=truth.poses, depths=ArrayFrames(truth.depths), masks=ArrayFrames(truth.masks),
            intrinsics=truth.intrinsics,
        ),
    )  # fmt: skip


def test_sintel_is_written_byte_by_byte_as_documented(tmp_path: Path) -> None:
    truth = miniatures.sintel(tmp_path / "a")
    WRITERS["sintel"](sequence_of(truth, np.arange(6) / 24), tmp_path / "b", "alley_2")
    for kind, suffix in (("depth", "dpt"), ("camdata_left", "cam")):
        for name in truth.names:
            path = f"training/{kind}/alley_2/{name}.{suffix}"
            ours, theirs = ((tmp_path / side / path).read_bytes() for side in "ba")
            if kind == "depth":
                assert ours == theirs
            else:  # the inverse of a rigid transform is its transpose here, and solved for there
                assert len(ours) == len(theirs)
                assert ours[:76] == theirs[:76]
                np.testing.assert_allclose(np.frombuffer(ours[76:]), np.frombuffer(theirs[76:]), atol=1e-12)


@pytest.mark.parametrize(
    ("layout", "dataset", "video", "used"),
    [
        ("sintel", "sintel", "alley_2", slice(0, 36)),
        ("tum", "tum-dynamics", "walking_xyz", slice(0, 36, 3)),
        ("bonn", "bonn", "balloon2", slice(30, 36)),
        ("bonn", "bonn-associated", "balloon2", slice(30, 36)),
        ("kitti", "kitti", "2011_09_26_drive_0002_sync", slice(0, 36)),
    ],
)
def test_what_is_written_is_read_back(layout: str, dataset: str, video: str, used: slice, tmp_path: Path) -> None:
    truth, times = miniatures.content(36), np.arange(36) / 30.0
    WRITERS[layout](sequence_of(truth, times), tmp_path, video)
    opened = find_dataset(dataset).open(tmp_path, video)
    found = opened.ground_truth
    np.testing.assert_array_equal(np.stack(list(opened.images)), truth.images[used])
    assert found.depths is not None
    units = {"sintel": np.inf, "kitti": 256.0}.get(layout, 5000.0)
    np.testing.assert_allclose(np.stack(list(found.depths)), truth.depths[used], rtol=0, atol=0.501 / units + 1e-6)
    if layout != "kitti":
        assert found.world_T_cam is not None
        np.testing.assert_allclose(found.world_T_cam, truth.poses[used], atol=1e-6)
    assert found.intrinsics is not None
    np.testing.assert_allclose(found.intrinsics, truth.intrinsics)
    if layout != "sintel":  # which has a frame rate of its own
        np.testing.assert_allclose(np.diff(opened.timestamps), np.diff(times[used]), atol=2e-6)


def test_the_command_adds_videos_to_a_dataset(cli: Run, tmp_path: Path) -> None:
    pytest.importorskip("open3d")
    scene = [
        "--frames", "34", "--width", "64", "--height", "48", "--set", "focal=60", "--set", "grid_columns=6",
        "--set", "grid_rows=5", "--set", "margin_px=2", "--set", "render_images=false", "--quiet",
    ]  # fmt: skip
    for expected in ("balloon2", "crowd2"):
        code, out, _ = cli("synthesize", tmp_path, "--as", "bonn", *scene)
        assert (code, out.split(":")[0]) == (0, expected)
        assert "4 used" in out
    dataset = find_dataset("bonn")
    assert dataset.found(tmp_path) == ("balloon2", "crowd2")
    assert len(list((tmp_path / "cues" / "crowd2" / "depth_cue").iterdir())) == 4
    assert cli("synthesize", tmp_path, "--as", "bonn", "--video", "crowd2", *scene)[0] == 6
    assert cli("synthesize", tmp_path, "--as", "davis", *scene)[0] == 2
    few = [word if word != "34" else "20" for word in scene]
    code, _, err = cli("synthesize", tmp_path, "--as", "bonn", *few)
    assert code == 3
    assert "make more frames" in err
    assert cli("synthesize", tmp_path / "x", "--video", "y", *scene)[0] == 2
