"""Rolling shutters: tracks at one time, and the readout that tracks ask for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slam.lens.shutter_scenes import FRAMES, RATE, SIZE, TIMES, K, shutter_scene

from uni4d_fg.config.load import load_config
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.readout_fit import ReadoutFit
from uni4d_fg.slam.lens.rolling_shutter import Readout, at_one_time, readout_of_array, readout_to_array
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver


def shift_px(moved: np.ndarray, still: np.ndarray, visible: np.ndarray) -> float:
    """Root mean square of the distance of observations to where they are at the middle row's time."""
    return float(np.sqrt(np.mean(np.sum((moved - still)[visible] ** 2, axis=1))))


@settings(deadline=None, max_examples=12)
@given(st.floats(-0.03, 0.03), st.sampled_from(["rows", "columns"]))
def test_tracks_are_moved_to_where_they_are_at_one_time(seconds: float, axis: str) -> None:
    readout = Readout(seconds, axis)  # type: ignore[arg-type]
    scene = shutter_scene(readout)
    tracks = scene.labelled.tracks
    moved = at_one_time(scene.labelled, readout, TIMES, SIZE).tracks
    inner = tracks.visible.copy()
    inner[:, 1:-1] &= tracks.visible[:, 2:] & tracks.visible[:, :-2]
    inner[:, [0, -1]] = False
    before, after = (shift_px(t.uv, scene.still, inner) for t in (tracks, moved))
    assert after < 0.03 + 0.05 * before
    if abs(seconds) > 0.01:
        assert before > 0.5
    # At the ends of tracks a line takes the place of the parabola.
    assert shift_px(moved.uv, scene.still, tracks.visible) < 0.05 + 0.2 * before


def test_a_point_that_is_seen_once_and_one_at_the_middle_stay() -> None:
    scene = shutter_scene(None)
    visible = np.zeros_like(scene.labelled.tracks.visible)
    visible[:, 3] = scene.labelled.tracks.visible[:, 3]
    once = replace(scene.labelled, tracks=replace(scene.labelled.tracks, visible=visible))
    moved = at_one_time(once, Readout(0.03), TIMES, SIZE).tracks.uv
    np.testing.assert_array_equal(moved[visible], scene.labelled.tracks.uv[visible])
    uv = np.array([[10.0, 0.0], [0.0, 119.5], [319.0, 239.0]])
    np.testing.assert_allclose(Readout(0.02).delay(uv, SIZE), [-0.01, 0.0, 0.01])
    np.testing.assert_allclose(Readout(-0.02, "columns").delay(uv, SIZE), [0.01 - 10 * 0.02 / 319, 0.01, -0.01])


def test_intervals_that_differ_are_told_apart() -> None:
    """A frame that is missing: velocities are per second."""
    readout = Readout(0.02)
    scene = shutter_scene(readout)
    kept = np.delete(np.arange(FRAMES), 9)
    tracks = scene.labelled.tracks
    cut = replace(scene.labelled, tracks=replace(tracks, uv=tracks.uv[:, kept], visible=tracks.visible[:, kept]))
    moved = at_one_time(cut, readout, TIMES[kept], SIZE).tracks
    beside = (slice(None), [8, 9])  # frames 8 and 10 of the whole
    inner = (tracks.visible[:, 7] & tracks.visible[:, 8] & tracks.visible[:, 10] & tracks.visible[:, 11])[:, None]
    inner = np.repeat(inner, 2, axis=1)
    before = shift_px(cut.tracks.uv[beside], scene.still[:, kept][beside], inner)
    assert shift_px(moved.uv[beside], scene.still[:, kept][beside], inner) < 0.1 * before


@pytest.mark.parametrize("true", [Readout(0.015), Readout(-0.02), Readout(0.025, "columns"), Readout(0.03)])
def test_the_readout_is_found(true: Readout) -> None:
    scene = shutter_scene(true, noise_px=0.2)
    found = ReadoutFit(scene.labelled, TIMES, SIZE, CameraModel(K), load_config("default", [])).find()
    assert found.readout is not None
    assert found.readout.axis == true.axis
    assert found.readout.seconds == pytest.approx(true.seconds, abs=0.04 / RATE)
    assert found.evidence > 0.3


def test_a_readout_that_no_shutter_has_is_not_believed() -> None:
    scene = shutter_scene(Readout(1.15 / RATE), noise_px=0.2)
    found = ReadoutFit(scene.labelled, TIMES, SIZE, CameraModel(K), load_config("default", [])).find()
    assert found.is_asked_for
    assert found.best is not None
    assert found.best.seconds == pytest.approx(1.0 / RATE)
    assert found.readout is None


def test_a_readout_is_the_same_after_it_was_stored() -> None:
    for readout in (None, Readout(-0.02), Readout(0.01, "columns")):
        assert readout_of_array(readout_to_array(readout)) == readout


def test_a_global_shutter_asks_for_none() -> None:
    scene = shutter_scene(None, noise_px=0.2)
    found = ReadoutFit(scene.labelled, TIMES, SIZE, CameraModel(K), load_config("default", [])).find()
    assert found.readout is None
    assert found.evidence < 0.01


def test_exact_tracks_are_not_asked() -> None:
    found = ReadoutFit(shutter_scene(None).labelled, TIMES, SIZE, CameraModel(K), load_config("default", [])).find()
    assert found.readout is None
    assert found.best is None


def test_cameras_are_those_of_the_middle_rows() -> None:
    true = Readout(0.015)
    scene = shutter_scene(true, noise_px=0.2)
    solver = StaticSceneSolver(load_config("default", []))
    errors = []
    for labelled in (scene.labelled, at_one_time(scene.labelled, true, TIMES, SIZE)):
        cameras = solver.solve(labelled, K, K, free_intrinsics=True).cameras
        metrics = evaluate_trajectory(cameras.world_T_cam, scene.world_T_cam)
        assert metrics.rpe_rotation_deg is not None
        errors.append((metrics.ate_m, metrics.rpe_rotation_deg))
    (ate, turns), (ate_moved, turns_moved) = errors
    assert ate_moved < 0.25 * ate
    assert turns_moved < 0.5 * turns
    assert ate_moved < 0.004
