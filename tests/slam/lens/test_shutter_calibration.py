"""A lens behind a rolling shutter: found from tracks at the time of the middle row, and held by the stages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam.lens.shutter_scenes import SIZE, TIMES, K, shutter_scene

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.calibration import calibrate_lens
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.rolling_shutter import Readout
from uni4d_fg.slam.lens.shutter_calibration import calibrate_with_shutter

GUESS = K * (1.1, 1.1, 1, 1)


def through(labelled: LabelledTracks, lens: Lens) -> LabelledTracks:
    """Move tracks of a pinhole to where a camera with a lens has them."""
    tracks = labelled.tracks
    track, frame = np.nonzero(tracks.visible)
    uv = tracks.uv.copy()
    uv[track, frame] = CameraModel(K, lens).real(tracks.uv[track, frame].astype(np.float64), frame)
    return replace(labelled, tracks=replace(tracks, uv=uv))


@pytest.fixture(scope="module")
def rolled() -> LabelledTracks:
    return through(shutter_scene(Readout(0.03), noise_px=0.2).labelled, Lens("SIMPLE_RADIAL", (-0.12,)))


def test_a_lens_behind_a_rolling_shutter_is_found_without_what_the_shutter_does(rolled: LabelledTracks) -> None:
    config = load_config("default", [])
    alone = calibrate_lens(rolled, SIZE, GUESS, config)
    found = calibrate_with_shutter(rolled, TIMES, SIZE, GUESS, config)
    assert abs(alone.intrinsics[0] / K[0] - 1) > 0.3  # a zoom that is none
    assert found.camera.zoom is None
    assert found.lens.padded[0] == pytest.approx(-0.12, abs=0.01)
    assert found.intrinsics[0] == pytest.approx(K[0], rel=0.02)
    assert "middle row" in found.facts()[1]
    assert found.camera.focal_sigma == 0.03


def test_a_shutter_that_is_known_already_and_one_that_is_global_change_nothing(rolled: LabelledTracks) -> None:
    known = load_config("default", ["camera.rolling_shutter=0.03"])
    found, alone = calibrate_with_shutter(rolled, TIMES, SIZE, GUESS, known), calibrate_lens(rolled, SIZE, GUESS, known)
    np.testing.assert_array_equal(found.intrinsics, alone.intrinsics)
    assert found.focal_sigma is None
    still = through(shutter_scene(None, noise_px=0.2).labelled, Lens("SIMPLE_RADIAL", (-0.12,)))
    config = load_config("default", [])
    found, alone = calibrate_with_shutter(still, TIMES, SIZE, GUESS, config), calibrate_lens(still, SIZE, GUESS, config)
    np.testing.assert_array_equal(found.intrinsics, alone.intrinsics)
    assert found.lens.padded[0] == pytest.approx(-0.12, abs=0.01)
    assert found.focal_sigma is None


def test_without_a_lens_no_readout_is_sought() -> None:
    scene = shutter_scene(Readout(0.02), noise_px=0.2)
    config = load_config("default", ["camera.model=pinhole"])
    found = calibrate_with_shutter(scene.labelled, TIMES, SIZE, K, config)
    alone = calibrate_lens(scene.labelled, SIZE, K, config)
    assert len(found.solves) == len(alone.solves)
