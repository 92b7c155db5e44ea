"""A lens is the same in all parts of a video."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cues.start_scenes import GUESS, SIZE, K, TrackedScene, sideways, tracked

from uni4d_fg.config.load import load_config
from uni4d_fg.cues.structure import camera_search, lens_agreement
from uni4d_fg.cues.structure.camera_fit import Fitted
from uni4d_fg.cues.structure.lens_agreement import bend, halves
from uni4d_fg.cues.structure.motion import Structure, structure_from_motion
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.progress import SilentReporter
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

FRAMES = 20
LENS = CameraModel(K, Lens("SIMPLE_RADIAL", (-0.12,)))


def through(scene: TrackedScene, below: float) -> TrackedScene:
    """Bend the tracks that begin below a height, as a part of the picture's, by the lens."""
    seen = scene.observations
    _, row = seen.rows()
    _, first = np.unique(row, return_index=True)
    is_below = (seen.uv[first, 1] > below * SIZE[0])[row]
    bent = LENS.real(seen.uv, seen.frame)
    uv = np.where(is_below[:, None], bent, seen.uv)
    return replace(scene, observations=replace(seen, uv=uv))


def solved(scene: TrackedScene) -> Structure:
    found = structure_from_motion(
        scene.observations, FRAMES, SIZE, GUESS, load_config("default", []), SilentReporter(), lambda: False,
        any_camera=True,
    )  # fmt: skip
    assert found is not None
    return found


@pytest.mark.slow
def test_what_bends_one_half_of_the_picture_is_no_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = through(tracked(sideways(FRAMES), points=1500), below=0.5)
    found = solved(scene)
    assert found.camera.lens.is_pinhole
    monkeypatch.setattr(camera_search, "halves_agree_on_lens", lambda *_: True)
    believed = solved(scene)
    assert not believed.camera.lens.is_pinhole
    assert -0.12 < believed.camera.lens.parameters[0] < -0.02


def test_what_bends_all_of_it_is_one() -> None:
    scene = through(tracked(sideways(FRAMES), points=1500), below=0.0)
    found = solved(scene)
    assert found.camera.lens.parameters[0] == pytest.approx(-0.12, abs=0.02)
    extent = np.linalg.norm(np.ptp(scene.world_T_cam[:, :3, 3], axis=0))
    assert evaluate_trajectory(found.world_T_cam, scene.world_T_cam).ate_m / extent < 0.004


def test_bend_is_that_of_pixels_at_half_the_shorter_side() -> None:
    radius = 0.5 * min(SIZE) / K[0]
    assert bend(LENS, SIZE) == pytest.approx(-0.12 * radius**2, rel=1e-9)
    assert bend(CameraModel(K), SIZE) == 0.0


def test_halves_are_of_time_and_place() -> None:
    # Four tracks of four frames, one per corner of the picture.
    track, frame = np.repeat(np.arange(4), 4), np.tile(np.arange(4), 4)
    uv = np.array([[10.0, 10.0], [90.0, 10.0], [10.0, 70.0], [90.0, 70.0]])[track]
    early, late, left, right, upper, lower = halves(Observations(track, frame, uv, np.full(16, np.nan), np.ones(16)))
    np.testing.assert_array_equal(early, frame < 2)
    np.testing.assert_array_equal(late, frame >= 2)
    np.testing.assert_array_equal(left, np.isin(track, [0, 2]))
    np.testing.assert_array_equal(right, np.isin(track, [1, 3]))
    np.testing.assert_array_equal(upper, track < 2)
    np.testing.assert_array_equal(lower, track >= 2)


ZOOM = CameraModel(K, zoom=1.3 ** np.linspace(-1.0, 0.0, FRAMES))


@pytest.mark.parametrize(
    ("parts", "agree"),
    [
        ((1.0, 1.0, 1.0, 1.0, 1.0, 1.0), True),
        ((1.0, 1.0, 0.9, 0.9, 1.2, 1.2), True),  # kitchen with dog, cropped from 1 to 1.6
        ((1.2, 1.1, 0.3, 0.6, 0.8, 0.3), False),  # cars that cross most of the picture
    ],
)
def test_halves_zoom_as_all_do(parts: tuple[float, ...], agree: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tracked(sideways(FRAMES))
    everything = SimpleNamespace(observations=scene.observations, registered=np.ones(FRAMES, bool))
    whole = Fitted(ZOOM, everything)  # type: ignore[arg-type]
    of_half = iter(parts)
    monkeypatch.setattr(lens_agreement, "_restricted", lambda fitted, _: fitted)
    # Its level, unlike its change, says nothing.
    monkeypatch.setattr(
        lens_agreement, "fit_zoom", lambda *_: Fitted(CameraModel(K, zoom=0.8 * ZOOM.zoom ** next(of_half)), everything)
    )
    assert lens_agreement.halves_agree_on_zoom(whole, load_config("default", [])) is agree


@pytest.mark.slow
def test_what_grows_in_all_of_the_picture_is_a_zoom() -> None:
    scene = tracked(sideways(FRAMES), points=1500)
    seen = scene.observations
    found = solved(replace(scene, observations=replace(seen, uv=ZOOM.real(seen.uv, seen.frame))))
    assert found.camera.zoom is not None
    np.testing.assert_allclose(found.intrinsics[0] * found.camera.zoom, K[0] * ZOOM.zoom, rtol=0.03)
