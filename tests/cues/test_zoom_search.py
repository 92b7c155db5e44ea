"""A focal length per frame from tracks alone: across the view, along it, and where it undoes the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cues.camera_scenes import FRAMES, path_error, ramp, structure, through
from cues.start_scenes import SIZE, K, TrackedScene, camera_path, forward, sideways, tracked

from uni4d_fg.cues.structure.zoom_search import similarities
from uni4d_fg.slam.lens.camera_model import CameraModel

WIDE = K * np.array([1.2, 1.2, 1.0, 1.0])


def zooming(path: np.ndarray, ratio: float, seed: int = 0) -> tuple[TrackedScene, np.ndarray]:
    """Return what a camera sees that zooms on its way, and its focal lengths (T,), px: at most those of WIDE."""
    plain = tracked(path, seed, points=1500)
    # Tracks of K, as a camera would have them whose longest focal length is 1.2 times K's.
    uv = K[2:] + (plain.observations.uv - K[2:]) * WIDE[:2] / K[:2]
    zoom = ramp(ratio)
    scene = replace(plain, observations=replace(plain.observations, uv=uv))
    return through(scene, CameraModel(WIDE, zoom=zoom)), WIDE[0] * zoom


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.6, 0.6])
def test_a_zoom_is_found_from_tracks_alone(ratio: float) -> None:
    scene, focal = zooming(sideways(FRAMES), ratio)
    found = structure(scene)
    assert found.camera.zoom is not None
    assert found.camera.lens.is_pinhole
    np.testing.assert_allclose(found.intrinsics[0] * found.camera.zoom, focal, rtol=0.03)
    assert path_error(found, scene) < 0.004
    off = structure(scene, "camera.zoom=off", "camera.model=pinhole")
    assert path_error(off, scene) > 5 * path_error(found, scene)


HAND_HELD = camera_path(FRAMES, (0.3, 0.1, 1.2), (0.05, -0.2, 0.03))
"""Mostly forward, so that a zoom of 0.6 undoes much of the motion."""


@pytest.mark.parametrize(
    ("ratio", "seed"),
    [(1.6, 0), *(pytest.param(ratio, seed, marks=pytest.mark.slow) for ratio, seed in ((0.6, 1), (0.6, 0), (1.6, 2)))],
)
def test_a_zoom_on_the_way_forward_is_told_from_the_motion(ratio: float, seed: int) -> None:
    scene, focal = zooming(HAND_HELD, ratio, seed)
    found = structure(scene)
    assert found.camera.zoom is not None
    np.testing.assert_allclose(found.intrinsics[0] * found.camera.zoom, focal, rtol=0.03)
    assert path_error(found, scene) < 0.003
    worst = np.abs(np.log(found.intrinsics[0] * found.camera.zoom / focal)).max()
    assert worst < 3.0 * found.focal.deviation < 0.15  # what the zoom leaves open is told with the rest


@pytest.mark.slow
def test_a_zoom_out_straight_forward_is_found_to_what_the_run_says() -> None:
    scene, focal = zooming(forward(FRAMES), 0.6)
    found = structure(scene)
    zoom = found.camera.zoom
    assert zoom is not None
    assert zoom[-1] / zoom[0] == pytest.approx(0.6, rel=0.03)
    assert path_error(found, scene) < 0.004
    low, high = found.focal.relative(found.intrinsics[0])
    assert low < focal.max() / found.intrinsics[0] - 1.0 < high


@pytest.mark.slow
def test_a_zoom_in_straight_forward_that_few_tracks_tell_is_held_open() -> None:
    scene, focal = zooming(forward(FRAMES), 1.6)
    found = structure(scene)
    assert found.camera.zoom is None
    assert found.focal.low == pytest.approx(focal.min(), rel=0.1)  # 0.36 of what is found without a zoom


def test_a_zoom_that_is_asked_for_is_taken_and_one_beside_another_model_not_sought() -> None:
    scene = tracked(sideways(FRAMES))
    asked = structure(scene, "camera.zoom=on").camera.zoom
    assert asked is not None
    assert np.ptp(asked) < 0.02
    zoomed = through(scene, CameraModel(K, zoom=ramp(1.6)))
    assert structure(zoomed, "camera.model=pinhole").camera.is_plain


def test_a_similarity_tells_a_zoom_of_a_camera_that_only_turns() -> None:
    turning = sideways(FRAMES)
    turning[:, :3, 3] = 0.0
    scene = through(tracked(turning, noise_px=0.1), CameraModel(K, zoom=ramp(1.6)))
    np.testing.assert_allclose(
        similarities(scene.observations, FRAMES, SIZE), np.linspace(0, np.log(1.6), 20), atol=0.02
    )


@pytest.mark.parametrize("ratio", [1.6, 1.0])
def test_a_zoom_that_was_found_among_things_that_move_must_be_asked_for_without_them(ratio: float) -> None:
    """As ripples of water had asked for one, of which the tracks that are left after masking know nothing."""
    scene, focal = zooming(sideways(FRAMES), ratio)
    known = CameraModel(WIDE, zoom=ramp(1.6))
    found = structure(scene, camera=known)
    assert (found.camera.zoom is None) is (ratio == 1.0)
    zoom = np.ones(FRAMES) if found.camera.zoom is None else found.camera.zoom
    np.testing.assert_allclose(found.intrinsics[0] * zoom, focal, rtol=0.03)
    assert path_error(found, scene) < 0.004
