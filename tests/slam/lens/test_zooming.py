"""The tool that makes a clip zoom: images, depth and tracks stay together."""

from __future__ import annotations

import numpy as np
from zooming import ramp, zoom_sequence

from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.track_model import Tracks


def test_pixels_move_away_from_the_principal_point() -> None:
    count, size, center = 4, (60, 80), np.array([38.0, 31.0])
    spots = np.array([[30.0, 25.0], [50.0, 40.0], [3.0, 31.0]])
    images = np.zeros((count, *size, 3), np.uint8)
    depth = np.full((count, *size), 2.0, np.float32)
    for number, (x, y) in enumerate(spots.astype(int)):
        images[:, y - 1 : y + 2, x - 1 : x + 2] = 80 * (number + 1)
        depth[:, y - 1 : y + 2, x - 1 : x + 2] = 3.0 + number
    uv = np.tile(spots[:, None].astype(np.float32), (1, count, 1))
    sequence = Sequence(
        "spots", ArrayFrames(images), ArrayFrames(depth), ArrayFrames(np.zeros((count, *size), np.int32)),
        np.array([70.0, 70.0, *center]), size, np.arange(float(count)),
        tracks=Tracks(uv, np.ones((3, count), bool), np.zeros(3, np.int32)),
    )  # fmt: skip
    ratio = ramp(count, 1.5)
    assert ratio[0] == 1.0
    np.testing.assert_allclose(ratio[-1], 1.5)
    assert (np.diff(ratio) >= 0).all()
    zoomed = zoom_sequence(sequence, ratio)
    assert zoomed.tracks is not None
    assert zoomed.tracks.visible.tolist() == [[True] * 4, [True] * 4, [True, True, False, False]]
    for t in range(count):
        for k in range(2):
            x, y = center + (spots[k] - center) * ratio[t]
            np.testing.assert_allclose(zoomed.tracks.uv[k, t], (x, y), atol=1e-4)
            assert (
                abs(int(zoomed.images[t][round(y), round(x), 0]) - 80 * (k + 1)) < 30
            )  # cubic interpolation overshoots
            assert zoomed.depths[t][round(y), round(x)] == 3.0 + k
    np.testing.assert_array_equal(zoomed.images[0], images[0])
