"""A run without its lens: filled frames, and pixels where a pinhole shows them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.results.undistort import Undistortion

K = np.array([500.0, 505.0, 319.5, 239.5])
SIZE = (480, 640)
LENSES = [
    Lens("SIMPLE_RADIAL", (-0.2,)),
    Lens("SIMPLE_RADIAL", (0.1,)),
    Lens("OPENCV", (-0.1, 0.02, 1e-3, -1e-3)),
    Lens("OPENCV_FISHEYE", (0.02, -0.01, 0.0, 0.0)),
]


@pytest.mark.parametrize("lens", LENSES, ids=[f"{lens.model}{lens.parameters[0]}" for lens in LENSES])
def test_every_undistorted_pixel_shows_what_the_camera_saw(lens: Lens) -> None:
    how = Undistortion.of(K, lens, SIZE)
    u, v = how.maps
    assert min(u.min(), v.min()) > -1e-3
    assert u.max() < 639.001
    assert v.max() < 479.001
    # Just one pixel of the border, or more, is at the border of the real image: no wider pinhole is filled.
    edge = np.concatenate([a[[0, -1]].ravel() for a in (u, u.T, v, v.T)])
    assert min(edge.min(), 639.0 - u.max(), 479.0 - v.max()) < 0.5
    real = np.stack([u, v], axis=-1)[::40, ::40].reshape(-1, 2).astype(np.float64)
    grid = np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1)[::40, ::40].reshape(-1, 2)
    np.testing.assert_allclose(how.pixels(real), grid, atol=2e-3)


def test_the_maps_are_opencvs() -> None:
    lens = LENSES[2]
    how = Undistortion.of(K, lens, SIZE)
    matrices = [np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1.0]]) for k in (K, how.pinhole)]
    theirs = cv2.initUndistortRectifyMap(matrices[0], lens.padded, None, matrices[1], (640, 480), cv2.CV_32FC1)
    for ours, expected in zip(how.maps, theirs, strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-3)


def test_depth_keeps_its_values() -> None:
    how = Undistortion.of(K, LENSES[0], SIZE)
    depth = np.full(SIZE, 2.5, np.float32)
    depth[:, 320:] = 4.0
    assert set(np.unique(how.frame(depth, cv2.INTER_NEAREST))) == {2.5, 4.0}


def test_a_lens_that_fills_no_pinhole_is_refused() -> None:
    with pytest.raises(InputError, match="no pinhole image of this size"):
        Undistortion.of(np.array([20.0, 20.0, 319.5, 239.5]), Lens("SIMPLE_RADIAL", (-0.3,)), SIZE)
