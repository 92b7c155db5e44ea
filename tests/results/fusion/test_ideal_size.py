"""The working size of bent images: everything they show fits in, and maps go there and back."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.results.fusion.multiview.ideal_size import IdealSize, ideal_size
from uni4d_fg.results.fusion.multiview.working_frame import WorkingSize, working_frame

PLAIN = WorkingSize.of((240, 320), 160)
K = np.array([210.0, 212.0, 158.0, 121.0])
LENSES = {
    "barrel": Lens("SIMPLE_RADIAL", (-0.12,)),
    "pincushion": Lens("SIMPLE_RADIAL", (0.05,)),
    "tangential": Lens("OPENCV", (-0.1, 0.03, 0.003, -0.002)),
    "fisheye": Lens("OPENCV_FISHEYE", (0.02, -0.005, 0.0, 0.0)),
}


@pytest.fixture(params=list(LENSES))
def size(request: pytest.FixtureRequest) -> IdealSize:
    made = ideal_size(PLAIN, LENSES[request.param], K)
    assert isinstance(made, IdealSize)
    return made


def plane(size: WorkingSize, uv: np.ndarray) -> np.ndarray:
    """Inverse depth of a slanted plane at ideal pixels of the images."""
    xy = (uv - K[2:]) / K[:2]
    return 0.4 + 0.1 * xy[..., 0] - 0.05 * xy[..., 1]


def grid(height: int, width: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)


def image_plane(size: IdealSize) -> np.ndarray:
    """Depth of that plane as the image shows it, (H, W)."""
    return (1 / plane(size, size.lens.ideal_pixels(K, grid(*size.image_size)))).astype(np.float32)


def working_plane(size: IdealSize) -> np.ndarray:
    """Inverse depth of that plane at working size, (h, w), by the camera it says it has."""
    fx, fy, cx, cy = size.intrinsics(K)
    xy = (grid(size.height, size.width) - [cx, cy]) / [fx, fy]
    return plane(size, xy * K[:2] + K[2:])


def test_all_that_the_image_shows_fits_in(size: IdealSize) -> None:
    corners = np.array([[0.5, 0.5], [318.5, 0.5], [0.5, 238.5], [318.5, 238.5]])
    at = size.pixels(corners)
    assert (at > -1e-6).all()
    assert (at < [size.width - 1 + 1e-6, size.height - 1 + 1e-6]).all()
    assert size.inside.mean() > 0.75
    np.testing.assert_array_equal(size.intrinsics(K)[:2], PLAIN.intrinsics(K)[:2])
    row, column = np.nonzero(size.inside)
    assert (np.ptp(row), np.ptp(column)) >= (size.height - 4, size.width - 4)  # no room is wasted


def test_pixels_are_those_of_the_maps(size: IdealSize, rng: np.random.Generator) -> None:
    uv = rng.uniform([0.5, 0.5], [318.5, 238.5], (100, 2))
    at = size.pixels(uv)
    xy = (size.lens.ideal_pixels(K, uv) - K[2:]) / K[:2]
    camera = size.intrinsics(K)
    np.testing.assert_allclose(at, xy * camera[:2] + camera[2:], atol=1e-6)
    row, column = np.rint(at).astype(int).T[::-1]
    back = size.to_real[row, column]
    assert np.abs(back[size.inside[row, column]] - PLAIN.pixels(uv)[size.inside[row, column]]).max() < 1.0


def test_depth_there_and_back(size: IdealSize) -> None:
    depth = image_plane(size)
    small = size.depth(depth)
    assert np.isfinite(small[size.inside]).all()
    assert np.isnan(small[~size.inside]).all()
    error = np.abs(small * working_plane(size) - 1)[size.inside]
    assert np.quantile(error, 0.99) < 2e-3
    assert error.max() < 0.01  # half a pixel at the border, beyond the last pixel's middle
    large = np.exp(size.enlarge(size.continued(np.log(small))))
    assert np.quantile(np.abs(large / depth - 1), 0.99) < 3e-3
    assert np.abs(large / depth - 1).max() < 0.02
    shown = size.shown(size.continued(small))
    assert np.quantile(np.abs(shown / PLAIN.depth(depth) - 1), 0.99) < 3e-3


def test_depth_is_of_one_surface_at_edges_and_missing_where_it_is(size: IdealSize) -> None:
    depth = np.where(np.arange(320) < 171, 2.0, 3.0).astype(np.float32) * np.ones((240, 1), np.float32)
    depth[100:140, 40:90] = np.nan
    for small in (size.depth(depth), size.shown(size.depth(depth))):
        known = small[np.isfinite(small)]
        off = np.minimum(np.abs(np.log(known / 2)), np.abs(np.log(known / 3)))
        assert off.max() < 0.081  # twice what is one surface; midway would be 0.2
        assert np.mean(off > 1e-3) < 0.01
    row, column = np.rint(size.pixels(np.array([[65.0, 120.0]]))).astype(int)[0, ::-1]
    assert np.isnan(size.depth(depth)[row, column])


def test_masks_there_and_back(size: IdealSize) -> None:
    mask = np.zeros((240, 320), np.int32)
    mask[180:220, 20:80] = 3
    marked = size.marked(mask)
    back = size.shown(marked)
    plain = PLAIN.marked(mask)
    assert (back | ~plain).all()
    assert np.count_nonzero(back) < 1.2 * np.count_nonzero(plain)
    assert np.count_nonzero(size.shown(size.straight(plain)) != plain) < 0.12 * np.count_nonzero(plain)


def test_frames_are_not_matched_where_the_image_does_not_reach(size: IdealSize, rng: np.random.Generator) -> None:
    image = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
    frame = working_frame(image, np.zeros((240, 320), np.int32), size, 3)
    assert np.isfinite(frame.gray).all()
    np.testing.assert_array_equal(np.isfinite(frame.matched), size.inside)
    np.testing.assert_array_equal(np.isfinite(size.within(frame.gray, np.nan)), size.inside)


def test_a_pinhole_keeps_its_size_and_its_maps(rng: np.random.Generator) -> None:
    assert ideal_size(PLAIN, PINHOLE, K) is PLAIN
    assert PLAIN.plain is PLAIN
    values, mask = rng.random((120, 160)).astype(np.float32), rng.random((120, 160)) > 0.5
    assert PLAIN.shown(values) is PLAIN.continued(values) is PLAIN.within(values, np.nan) is values
    assert PLAIN.straight(mask) is mask


@pytest.mark.parametrize(
    "lens",
    [Lens("SIMPLE_RADIAL", (-0.35,)), Lens("OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0))],
)
def test_a_lens_too_wide_for_a_pinhole_has_none(lens: Lens) -> None:
    assert ideal_size(PLAIN, lens, K * [0.55, 0.55, 1.0, 1.0]) is None
