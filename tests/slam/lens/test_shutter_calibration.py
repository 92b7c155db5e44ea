"""A lens behind a rolling shutter: found without what it does, and the readout with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam.lens.shutter_scenes import RATE, SIZE, TIMES, K, shutter_scene

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.calibration import LensCalibration, calibrate_lens
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.readout_fit import FoundReadout, ReadoutFit
from uni4d_fg.slam.lens.rolling_shutter import Readout, at_one_time
from uni4d_fg.slam.lens.shutter_calibration import calibrate_with_shutter

GUESS = K * (1.1, 1.1, 1, 1)


def through(labelled: LabelledTracks, lens: Lens) -> LabelledTracks:
    """Move tracks of a pinhole to where a camera with a lens has them."""
    tracks = labelled.tracks
    track, frame = np.nonzero(tracks.visible)
    uv = tracks.uv.copy()
    uv[track, frame] = CameraModel(K, lens).real(tracks.uv[track, frame].astype(np.float64), frame)
    return replace(labelled, tracks=replace(tracks, uv=uv))


INTERVAL = 1.0 / RATE


def behind(k1: float, readout: Readout | None) -> LabelledTracks:
    """What a camera with a lens sees that reads its rows one after the other."""
    return through(shutter_scene(readout, noise_px=0.2).labelled, Lens("SIMPLE_RADIAL", (k1,)))


@pytest.fixture(scope="module")
def rolled() -> LabelledTracks:
    return behind(-0.12, Readout(0.028))


def calibrated(labelled: LabelledTracks, readout: Readout | None, *changes: str) -> LensCalibration:
    return calibrate_with_shutter(labelled, TIMES, SIZE, GUESS, load_config("default", list(changes)), readout)


def with_a_pinhole(labelled: LabelledTracks) -> FoundReadout:
    camera = CameraModel(GUESS)
    return ReadoutFit(labelled, TIMES, SIZE, camera, load_config("default", [])).find()


@pytest.mark.slow
def test_a_lens_behind_a_rolling_shutter_is_found_without_what_the_shutter_does(rolled: LabelledTracks) -> None:
    alone = calibrate_lens(rolled, SIZE, GUESS, load_config("default", []))
    assert abs(alone.intrinsics[0] / K[0] - 1) > 0.3  # a zoom that is none
    for first in (None, with_a_pinhole(rolled).readout):
        found = calibrated(rolled, first)
        assert found.camera.zoom is None
        assert found.lens.padded[0] == pytest.approx(-0.12, abs=0.01)
        assert found.intrinsics[0] == pytest.approx(K[0], rel=0.02)
        assert found.readout is not None
        assert found.readout.seconds == pytest.approx(0.028, abs=0.05 * INTERVAL)
        assert found.focal_sigma is None


def test_a_strong_lens_hides_a_readout_that_is_found_with_it() -> None:
    rolled = behind(-0.25, Readout(0.02))
    first = with_a_pinhole(rolled).readout
    assert first is not None
    assert first.seconds < 0.75 * 0.02
    found = calibrated(rolled, first)
    assert found.readout is not None
    assert found.readout.seconds == pytest.approx(0.02, abs=0.04 * INTERVAL)
    assert found.lens.padded[0] == pytest.approx(-0.25, abs=0.005)
    assert found.intrinsics[0] == pytest.approx(K[0], rel=0.006)


def test_a_readout_that_takes_all_of_a_frame_is_undone_for_the_lens_alone() -> None:
    rolled = behind(-0.2, Readout(INTERVAL))
    first = with_a_pinhole(rolled).readout
    assert first is not None  # the lens hides a part of it
    found = calibrated(rolled, first)
    assert found.readout is None
    assert found.lens.padded[0] == pytest.approx(-0.2, abs=0.01)
    assert "all the time between two frames" in found.note
    assert found.camera.focal_sigma == 0.03


def test_a_shutter_that_is_given_and_one_that_is_global_change_nothing(rolled: LabelledTracks) -> None:
    told = Readout(0.028)
    known = load_config("default", ["camera.rolling_shutter=0.028"])
    alone = calibrate_lens(at_one_time(rolled, told, TIMES, SIZE), SIZE, GUESS, known)
    found = calibrated(rolled, told, "camera.rolling_shutter=0.028")
    np.testing.assert_array_equal(found.intrinsics, alone.intrinsics)
    assert found.readout == told
    still = behind(-0.12, None)
    found, alone = calibrated(still, None), calibrate_lens(still, SIZE, GUESS, load_config("default", []))
    np.testing.assert_array_equal(found.intrinsics, alone.intrinsics)
    assert found.lens.padded[0] == pytest.approx(-0.12, abs=0.01)
    assert found.readout is None


def test_without_a_lens_no_readout_is_sought_again() -> None:
    scene = shutter_scene(Readout(0.02), noise_px=0.2)
    config = load_config("default", ["camera.model=pinhole"])
    found = calibrate_with_shutter(scene.labelled, TIMES, SIZE, K, config)
    alone = calibrate_lens(scene.labelled, SIZE, K, config)
    assert len(found.solves) == len(alone.solves)
