"""A stream goes on only with the frames that it came from; and it warns of what a batch run warns of."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stream_samples import stream, stream_config

from uni4d_fg.errors import Cancelled, ConfigError, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.pipeline.stream import not_in_streams, stream_sequence
from uni4d_fg.pipeline.warnings import focal_warnings, scene_warnings

FRAMES, TAKEN = 10, 6
CONFIG = stream_config("incremental.window=4", "incremental.nonrigid_lag=2", "incremental.nonrigid_window=5")


def scene() -> Sequence:
    return stream(FRAMES, grid_columns=12, grid_rows=9)


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("interrupted")
    polls = iter(range(FRAMES))
    with pytest.raises(Cancelled):
        stream_sequence(scene(), folder, CONFIG, should_stop=lambda: next(polls) == TAKEN)
    return folder


def changed(source: Any, frame: int, change: Any) -> ArrayFrames:
    array = np.stack(list(source))
    array[frame] = change(array[frame])
    return ArrayFrames(array)


def others() -> dict[str, Sequence]:
    own = scene()
    assert own.tracks is not None
    replace = dataclasses.replace
    moved = replace(own.tracks, uv=own.tracks.uv + np.float32(0.01))
    return {
        "another scene": stream(FRAMES, seed=99, grid_columns=12, grid_rows=9),
        "another image": replace(own, images=changed(own.images, 1, lambda a: a ^ 1)),
        "another depth": replace(own, depths=changed(own.depths, 0, lambda a: a * np.float32(1.0001))),
        "another mask": replace(own, masks=changed(own.masks, TAKEN - 1, lambda a: a + 1)),
        "another stride": replace(own, timestamps=2.0 * own.timestamps),
        "another end": replace(
            own, images=ArrayFrames(np.stack(list(own.images))[:8]), depths=ArrayFrames(np.stack(list(own.depths))[:8]),
            masks=ArrayFrames(np.stack(list(own.masks))[:8]), timestamps=own.timestamps[:8], tracks=None,
        ),
        "online tracks": replace(own, tracks=None),
        "other tracks": replace(own, tracks=moved),
        "another calibration": replace(own, intrinsics=own.intrinsics * 1.01),
    }  # fmt: skip


@pytest.mark.parametrize("name", list(others()))
def test_a_stream_of_anything_else_does_not_go_on(interrupted: Path, name: str) -> None:
    before = {path: path.read_bytes() for path in sorted(interrupted.rglob("*")) if path.is_file()}
    with pytest.raises(InputError, match=r"stream\.npz.*start anew with --overwrite"):
        stream_sequence(others()[name], interrupted, CONFIG, resume=True)
    assert {path: path.read_bytes() for path in sorted(interrupted.rglob("*")) if path.is_file()} == before


def test_what_is_not_reached_yet_may_be_repaired(interrupted: Path, tmp_path: Path) -> None:
    import shutil

    folder = Path(shutil.copytree(interrupted, tmp_path / "run"))
    own = scene()
    repaired = dataclasses.replace(own, images=changed(own.images, TAKEN + 1, lambda a: a ^ 1))
    assert stream_sequence(repaired, folder, CONFIG, resume=True).resumed_from == TAKEN


def test_a_stream_warns_of_what_a_batch_run_warns_of() -> None:
    given, poses = np.array([160.0, 160.0, 80.0, 60.0]), np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 0.5, 1.0]
    points = np.array([[0.0, 0.0, 5.0]])
    assert scene_warnings(given, poses, points) == []
    assert "moved by 159 %" in focal_warnings(given, given[:2] * [415 / 160, 1])[0]
    assert "no landmarks" in scene_warnings(given, poses, np.zeros((0, 3)))[0]
    covariance = np.zeros((3, 6, 6))
    path = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    for part, expected in ((0.03, []), (0.06, ["camera positions are uncertain by 6 % of the path's length"])):
        covariance[1:, 3:, 3:] = np.diag([0.0, (part * path) ** 2, 0.0])
        found = scene_warnings(given, poses, points, covariance)
        assert [text.split(":")[0] for text in found] == expected
    assert scene_warnings(given, poses, points, np.full((3, 6, 6), np.nan)) == []
    still = np.tile(np.eye(4), (3, 1, 1))
    assert "moves by only 0.00 %" in scene_warnings(given, still, points)[0]
    assert "cue alone" in scene_warnings(given, still, points)[0]
    for parallax, origin in ((True, "from which all depth was found"), (False, "which was assumed")):
        (little,) = scene_warnings(given, still, points, depth_parallax=parallax)
        assert f"moves by only 0.00 % of the scene's depth, {origin}" in little


@pytest.mark.parametrize(("sigma_px", "poor"), [(0.0, False), (3.0, False), (16.0, True), (np.nan, True)])
def test_a_camera_at_rest_determines_its_focal_length_if_it_turns(sigma_px: float, poor: bool) -> None:
    given, still = np.array([160.0, 160.0, 80.0, 60.0]), np.tile(np.eye(4), (3, 1, 1))
    covariance = np.diag([sigma_px**2, sigma_px**2, 0.0, 0.0])
    found = scene_warnings(given, still, np.array([[0.0, 0.0, 5.0]]), None, covariance)
    assert ["focal length is poorly determined" in text for text in found] == [poor]


@pytest.mark.parametrize(
    ("sigma_px", "baseline", "said"),
    [(0.0, 1.0, False), (4.0, 1.0, False), (12.0, 1.0, True), (12.0, 0.0, False), (np.nan, 1.0, False)],
)
def test_a_focal_length_that_is_known_badly_is_said_with_its_interval(
    sigma_px: float, baseline: float, said: bool
) -> None:
    intrinsics, poses = np.array([160.0, 160.0, 80.0, 60.0]), np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, baseline, 3)
    covariance = np.diag([sigma_px**2, sigma_px**2, 0.0, 0.0])
    points = np.array([[0.0, 0.0, 5.0]])

    def open_focal_warnings(covariance: np.ndarray | None, points: np.ndarray, *, doubted: bool = False) -> list[str]:
        found = scene_warnings(intrinsics, poses, points, None, covariance, focal_was_doubted=doubted)
        return [text for text in found if "leaves the focal length open" in text]

    found = open_focal_warnings(covariance, points)
    assert ["160 px was found, give or take 15 % (95 %)" in text for text in found] == ([True] if said else [])
    assert open_focal_warnings(None, points) == []
    assert open_focal_warnings(covariance, points[:0]) == []
    assert open_focal_warnings(covariance, points, doubted=True) == []


def test_a_stream_without_static_tracks_says_so(tmp_path: Path) -> None:
    own = scene()
    masks = np.ones((FRAMES, *own.image_size), np.int32)
    masks[:, 0, 0] = 0  # nothing is tracked there
    moving = dataclasses.replace(own, masks=ArrayFrames(masks))
    summary = stream_sequence(moving, tmp_path, CONFIG)
    assert any("no landmarks" in text for text in summary.warnings())
    assert any("no landmarks" in text for text in summary.to_dict()["warnings"])


@pytest.mark.parametrize("setting", ["camera.zoom=on", "input.poses=fixed"])
def test_what_a_stream_cannot_do_is_refused(tmp_path: Path, setting: str) -> None:
    with pytest.raises(ConfigError, match=setting.split("=")[0]):
        stream_sequence(scene(), tmp_path / "run", stream_config(setting))
    assert not (tmp_path / "run").exists()


def test_what_a_stream_leaves_out_is_said() -> None:
    assert not_in_streams(CONFIG) == []
    (said,) = not_in_streams(stream_config("joint.enabled=true", "windows.frames=8", "input.poses=initial"))
    assert "leaves out input.poses, joint.enabled, windows.frames;" in said
