"""A lens that pairs of frames tell, and pans whose cameras do not lead to it."""

from __future__ import annotations

import numpy as np
import pytest
from cues.camera_scenes import FRAMES, panned, path_error, structure, through
from cues.start_scenes import GUESS, SIZE, K, TrackedScene
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.structure import search
from uni4d_fg.cues.structure.camera_search import FoundCamera
from uni4d_fg.cues.structure.lens_agreement import bend
from uni4d_fg.cues.structure.lens_of_pairs import lens_of_pairs
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.rolling_shutter import Readout


def told(scene: TrackedScene, intrinsics: np.ndarray = GUESS) -> CameraModel | None:
    return lens_of_pairs(scene.observations, FRAMES, SIZE, intrinsics, GeometricDepthConfig())


@settings(max_examples=6, deadline=None)
@given(k1=st.floats(-0.2, -0.04), seed=st.integers(0, 20))
@example(k1=-0.15, seed=0)
@example(k1=0.08, seed=1)
def test_pairs_of_a_pan_tell_the_lens_and_its_focal_length(k1: float, seed: int) -> None:
    real = CameraModel(K, Lens("SIMPLE_RADIAL", (k1,)))
    found = told(through(panned(seed, 1200), real))
    assert found is not None
    assert bend(found, SIZE) == pytest.approx(bend(real, SIZE), abs=0.005)
    assert found.intrinsics[0] == pytest.approx(K[0], rel=0.1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_pinhole_is_none(seed: int) -> None:
    assert told(panned(seed, 1200)) is None


def test_where_pairs_tell_no_focal_length_the_given_one_goes_with_the_same_bend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Lenses of other focal lengths that bend the same pixels are one to pairs of frames."""
    monkeypatch.setattr("uni4d_fg.cues.structure.lens_of_pairs.focal_of_pairs", lambda *_: None)
    real = CameraModel(K, Lens("SIMPLE_RADIAL", (-0.15,)))
    scene = through(panned(0, 1200), real)
    found = [told(scene, GUESS * np.array([ratio, ratio, 1.0, 1.0])) for ratio in (1.0, 1.6)]
    one, other = (camera for camera in found if camera is not None)
    assert other.intrinsics[0] == pytest.approx(1.6 * one.intrinsics[0])
    assert bend(one, SIZE) == pytest.approx(bend(other, SIZE), rel=0.02)
    assert bend(one, SIZE) == pytest.approx(bend(real, SIZE), abs=0.005)


@pytest.mark.parametrize("points", [600, pytest.param(1500, marks=pytest.mark.slow)])
def test_cameras_of_a_pan_through_a_lens_are_found(points: int) -> None:
    """A pinhole that is fitted to it is stiff: steps with a lens do not leave it, at 1.6 times the focal length."""
    scene = through(panned(0, points), CameraModel(K, Lens("SIMPLE_RADIAL", (-0.15,))))
    found = structure(scene)
    assert found.camera.lens.parameters[0] == pytest.approx(-0.15, abs=0.01)
    assert found.intrinsics[0] == pytest.approx(K[0], rel=0.01)
    assert path_error(found, scene) < 0.012
    pinhole = structure(scene, "camera.model=pinhole")
    assert path_error(pinhole, scene) > 4.0 * path_error(found, scene)


def test_of_a_lens_and_what_pairs_told_the_sharper_scene_is_taken_and_no_readout_of_the_bent_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right, wrong = (CameraModel(K, Lens("SIMPLE_RADIAL", (k1,))) for k1 in (-0.15, -0.2))
    scene = through(panned(0, 600), right)
    asked = []

    def columns(*_: object) -> Readout:
        asked.append(1)
        return Readout(-0.5, "columns")

    monkeypatch.setattr(search, "find_readout", columns)
    monkeypatch.setattr(search, "lens_of_pairs", lambda *_: right)
    monkeypatch.setattr(search, "find_camera", lambda *_: FoundCamera(wrong, 0.5, told=right))
    found = structure(scene)
    assert not asked
    assert found.readout is None
    assert found.camera.lens.parameters[0] == pytest.approx(-0.15, abs=0.005)
    assert path_error(found, scene) < 0.012
