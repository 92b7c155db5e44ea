"""What the second search for cameras, once what moves is masked, takes over from the first."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.cues import gather
from uni4d_fg.cues.geometric_depth import GeometricDepth
from uni4d_fg.cues.plan import plan_cues
from uni4d_fg.cues.structure.search import StartCameras
from uni4d_fg.frontend.sequence.model import ArrayFrames, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.camera_model import CameraModel

FRAMES, SIZE = 4, (60, 80)
INTRINSICS = np.array([70.0, 70.0, 39.5, 29.5])
GUESS = 80.0
LENS = CameraModel(INTRINSICS, Lens("SIMPLE_RADIAL", (-0.1,)))
ZOOM = CameraModel(INTRINSICS, zoom=np.linspace(0.8, 1.0, FRAMES))


def passes(
    camera: CameraModel,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    has_parallax: bool = True,
    at_once: bool = True,
    given: np.ndarray | None = None,
    warnings: list[str] | None = None,
    strays: np.ndarray | None = None,
    tracked: list[Tracks] | None = None,
) -> tuple[list[tuple[CameraModel | None, StartCameras | None]], list[Any], np.ndarray]:
    """Gather cues of frames alone, or with given intrinsics, with a structure from motion that finds a camera.

    Warnings of the report are added to ``warnings``, and to ``tracked`` the tracks that each pass and the masks are
    given; of these every pass finds ``strays`` (3, T).

    Returns:
        Cameras that are known and to start from in each pass; poses that masks are made with; those that were found.
    """
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = np.arange(FRAMES)
    depths = ArrayFrames(np.ones((FRAMES, *SIZE), np.float32))
    visible = np.ones((3, FRAMES), bool)
    tracks = Tracks(np.full((3, FRAMES, 2), 20.0, np.float32), visible, np.zeros(3, np.int32))
    calls: list[tuple[CameraModel | None, StartCameras | None]] = []
    masked: list[Any] = []

    def depth(
        _video: Any, given_tracks: Tracks, _static: Any, _intrinsics: Any, known: Any, start: Any, *_: Any
    ) -> GeometricDepth:
        calls.append((known, start))
        sparse, moving = np.ones(visible.shape, np.float32), np.zeros(3, bool)
        if tracked is not None:
            tracked.append(given_tracks)
        stray = np.zeros(visible.shape, bool) if strays is None else strays
        return GeometricDepth(depths, poses, camera, sparse, moving, stray, has_parallax, 0.01, (), (), at_once)

    def masks(*arguments: Any) -> tuple[ArrayFrames, list[str], list[str]]:
        masked.append(arguments[7])
        if tracked is not None:
            tracked.append(arguments[2])
        return ArrayFrames(np.zeros((FRAMES, *SIZE), np.int32)), [], []

    monkeypatch.setattr(gather, "geometric_depth", depth)
    monkeypatch.setattr(gather, "moving_masks", masks)
    monkeypatch.setattr(gather, "load_or_track", lambda *_: tracks)
    monkeypatch.setattr(gather, "save_manifest", lambda *_: None)
    images = ArrayFrames(np.zeros((FRAMES, *SIZE, 3), np.uint8))
    video = Video("clip", images, SIZE, np.arange(FRAMES) / 30.0, intrinsics=given)
    _, report = gather.gather_cues(video, plan_cues(video, bare=True), folder, load_config("default", []))
    if warnings is not None:
        warnings += report.warnings
    return calls, masked, poses


def test_the_first_pass_knows_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, _, _ = passes(CameraModel(INTRINSICS), tmp_path, monkeypatch)
    assert len(calls) == 2
    assert calls[0] == (None, None)


@pytest.mark.parametrize(("focal", "odd"), [(70.0, False), (2000.0, True)])
def test_odd_intrinsics_that_motion_starts_from_are_warned_of(
    focal: float, odd: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warnings: list[str] = []
    given = np.array([focal, focal, 39.5, 29.5])
    passes(CameraModel(INTRINSICS), tmp_path, monkeypatch, given=given, warnings=warnings)
    said = [text for text in warnings if "the given intrinsics are odd: focal length 2000.0 px is unusual" in text]
    assert len(said) == odd


def test_where_all_tracks_ask_for_a_pinhole_no_other_camera_is_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, masked, poses = passes(CameraModel(INTRINSICS), tmp_path, monkeypatch)
    known, start = calls[1]
    assert known is not None
    assert known.is_plain
    assert known.intrinsics[0] == GUESS  # what the first pass found is no knowledge for the second
    assert start is not None
    np.testing.assert_array_equal(start.world_T_cam, poses)
    np.testing.assert_array_equal(start.intrinsics, INTRINSICS)
    np.testing.assert_array_equal(masked[0], poses)


@pytest.mark.parametrize(("camera", "at_once"), [(LENS, True), (CameraModel(INTRINSICS), False)])
def test_a_lens_or_a_rolling_shutter_among_things_that_move_is_looked_for_again(
    camera: CameraModel, at_once: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, _, _ = passes(camera, tmp_path, monkeypatch, at_once=at_once)
    assert calls[1][0] is None
    assert calls[1][1] is not None


def test_a_zoom_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, _, _ = passes(ZOOM, tmp_path, monkeypatch)
    assert calls[1][0] is ZOOM


def test_cameras_without_parallax_are_no_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, masked, poses = passes(CameraModel(INTRINSICS), tmp_path, monkeypatch, has_parallax=False)
    assert all(call == (None, None) for call in calls)
    np.testing.assert_array_equal(masked[0], poses)  # their rotations are real


def test_what_is_of_another_surface_is_dropped_for_all_that_comes_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    strays, tracked = np.zeros((3, FRAMES), bool), list[Tracks]()
    strays[1, 2:] = True
    passes(CameraModel(INTRINSICS), tmp_path, monkeypatch, strays=strays, tracked=tracked)
    first, of_masks, second = tracked
    assert first.visible.all()
    for tracks in (of_masks, second):
        np.testing.assert_array_equal(tracks.visible, ~strays)
        np.testing.assert_array_equal(np.isnan(tracks.uv[..., 0]), strays)
