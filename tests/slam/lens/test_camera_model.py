"""Ideal pixels of a camera that distorts or zooms, and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.camera_model import CameraModel

K = np.array([260.0, 260.0, 159.5, 119.5])


def zooming(ratio: float) -> CameraModel:
    """Return a camera whose focal length changes by a ratio in five frames."""
    zoom = ratio ** np.linspace(0.0, 1.0, 5)
    return CameraModel(K, zoom=zoom / zoom.max())


CAMERAS = st.one_of(
    st.builds(lambda k: CameraModel(K, Lens("SIMPLE_RADIAL", (k,))), st.floats(-0.2, 0.3)),
    st.builds(lambda k, m: CameraModel(K, Lens("RADIAL", (k, m))), st.floats(-0.1, 0.2), st.floats(-0.05, 0.1)),
    st.builds(zooming, st.floats(0.5, 2.0)),
    st.just(CameraModel(K)),
)
PIXELS = np.array([[0.0, 0.0], [319.0, 239.0], [40.0, 200.0], [159.5, 119.5], [300.0, 10.0]])


@given(CAMERAS, st.floats(0.6, 1.7))
@settings(max_examples=40, deadline=None)
def test_ideal_pixels_and_back(camera: CameraModel, ratio: float) -> None:
    frame = np.arange(5)
    ideal = camera.ideal(PIXELS, frame)
    np.testing.assert_allclose(camera.real(ideal, frame), PIXELS, atol=1e-6)
    other = camera.with_intrinsics(K * np.array([ratio, ratio, 1.0, 1.0]))
    np.testing.assert_allclose(other.ideal(PIXELS, frame), ideal, atol=1e-6)
    again = CameraModel.of_array(camera.to_array(), camera.intrinsics)
    np.testing.assert_array_equal(again.ideal(PIXELS, frame), ideal)
    # A weight is the area that a small square around the ideal pixel has in the image.
    step = 1e-4
    across, down = (camera.real(ideal + np.array(d) * step, frame) - PIXELS for d in ([1, 0], [0, 1]))
    area = np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]) / step**2
    np.testing.assert_allclose(camera.ideal_weight(ideal, frame), np.minimum(area, 1.0), rtol=2e-3)


def test_tracks_keep_what_is_not_seen() -> None:
    uv = np.tile(PIXELS[:, None].astype(np.float32), (1, 2, 1))
    visible = np.ones((5, 2), dtype=bool)
    visible[3, 1] = False
    uv[3, 1] = np.nan
    tracks = Tracks(uv, visible, np.zeros(5, dtype=np.int32))
    camera = CameraModel(K, Lens("SIMPLE_RADIAL", (-0.2,)))
    moved = camera.ideal_tracks(tracks)
    np.testing.assert_array_equal(moved.visible, visible)
    np.testing.assert_allclose(moved.uv[:, 0], camera.ideal(PIXELS, np.zeros(5, dtype=np.int64)), rtol=1e-6)
    assert np.isnan(moved.uv[3, 1]).all()
    np.testing.assert_array_equal(tracks.uv[:, 0], PIXELS.astype(np.float32))
    assert CameraModel(K).ideal_tracks(tracks) is tracks


@pytest.mark.parametrize("lens", [Lens("SIMPLE_RADIAL", (-0.2,)), Lens("RADIAL", (-0.25, 0.1))])
def test_a_lens_goes_along_with_the_focal_length(lens: Lens) -> None:
    """The same real pixels stay those of the same ideal pixels."""
    camera, frame = CameraModel(K, lens), np.zeros(len(PIXELS), dtype=np.int64)
    longer = K * np.array([1.1, 1.1, 1.0, 1.0])
    moved = camera.with_intrinsics(longer)
    np.testing.assert_allclose(moved.ideal(PIXELS, frame), camera.ideal(PIXELS, frame), atol=1e-9)
    assert moved.lens.parameters[0] == pytest.approx(1.21 * lens.parameters[0])
    np.testing.assert_array_equal(moved.intrinsics, longer)
