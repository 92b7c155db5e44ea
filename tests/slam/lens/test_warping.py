"""The warper: real content up to the corners, and pixels where a camera with the lens shows them."""

from __future__ import annotations

import numpy as np
import pytest
from warping import make_warp

from uni4d_fg.geometry.camera import project
from uni4d_fg.geometry.lens import Lens, distort

K = np.array([530.0, 529.0, 320.0, 240.0])
SIZE = (480, 640)


@pytest.mark.parametrize("k1", [-0.25, -0.12, 0.1])
def test_warped_frames_are_filled_and_right(k1: float, rng: np.random.Generator) -> None:
    warp = make_warp(K, Lens("SIMPLE_RADIAL", (k1,)), SIZE)
    u, v = warp.maps
    assert min(u.min(), v.min()) > -1.5
    assert (u.max(), v.max()) < (640.5, 480.5)
    x = rng.uniform([-0.8, -0.6, 2.0], [0.8, 0.6, 2.5], size=(50, 3))
    bent = distort(np.array([k1, 0.0, 0.0, 0.0]), x[:, :2] / x[:, 2:])
    seen = bent * warp.intrinsics[:2] + warp.intrinsics[2:]
    np.testing.assert_allclose(warp.pixels(np.asarray(project(K, x))), seen, atol=1e-9)
    # A frame whose values are its own pixels: where a point is seen, the warped frame shows the point's old pixel.
    ramp = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).astype(np.float32)
    shown = warp.frame(ramp, 1)
    row = np.rint(seen).astype(int)
    np.testing.assert_allclose(shown[row[:, 1], row[:, 0]], project(K, x), atol=1.5)
