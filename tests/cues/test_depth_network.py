"""Depth by a network: what goes in, what comes out, in which pixels and units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_networks import constant_network, weighted_channels, write_card

from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.card import InputSpec, SizeSpec, find_model
from uni4d_fg.cues.depth_network import DepthNetwork
from uni4d_fg.cues.intrinsics import robust_mean, shared_intrinsics
from uni4d_fg.cues.preprocess import place, prepare, resize_known
from uni4d_fg.errors import InputError

CPU = NetworkConfig(threads=1)


def ramp(height: int = 48, width: int = 64) -> np.ndarray:
    """An image whose red grows to the right, green downwards, blue is 40."""
    image = np.full((height, width, 3), 40, np.uint8)
    image[..., 0] = (2 * np.arange(width) + 20)[None, :]
    image[..., 1] = (2 * np.arange(height) + 30)[:, None]
    return image


def network(
    tmp_path: Path, weights: Any = (10.0, 0, 0), bias: float = 0.0, extra: Any = None, **card: Any
) -> DepthNetwork:
    weighted_channels(tmp_path / "tiny.onnx", weights, bias, extra=extra)
    return DepthNetwork(find_model(str(write_card(tmp_path / "tiny.yaml", **card)), "depth"), CPU)


def test_metric_depth_is_what_the_network_says_of_normalized_channels(tmp_path: Path) -> None:
    image = ramp()
    spec = {"mean": [0.1, 0.2, 0.3], "std": [0.5, 0.25, 1.0]}
    found = network(tmp_path, (1.0, 2.0, 3.0), 5.0, input=spec).estimate(image, 50.0)
    channels = (image / 255.0 - spec["mean"]) / spec["std"]
    np.testing.assert_allclose(found.values, channels @ [1.0, 2.0, 3.0] + 5.0, rtol=1e-5)
    assert found.intrinsics is None


def test_colors_can_be_the_other_way_round_and_unscaled(tmp_path: Path) -> None:
    image = ramp()
    found = network(tmp_path, (1.0, 0, 0), input={"color": "bgr", "scale": 1.0}).estimate(image, 50.0)
    np.testing.assert_allclose(found.values, image[..., 2], rtol=1e-6)


@pytest.mark.parametrize(
    "size",
    [
        {"rule": "longest", "length": 128, "multiple_of": 8},
        {"rule": "shortest", "length": 96},
        {"rule": "image", "multiple_of": 14},
        {"rule": "fixed", "height": 96, "width": 96},
        {"rule": "fixed", "height": 96, "width": 200, "pad": "end"},
        {"rule": "fixed", "height": 96, "width": 96, "keep_aspect": False},
    ],
)
def test_depth_comes_back_to_the_pixels_of_the_image(tmp_path: Path, size: dict[str, Any]) -> None:
    image = ramp()
    found = network(tmp_path, size=size).estimate(image, 50.0)
    assert found.values.shape == (48, 64)
    inside = np.s_[4:-4, 4:-4]
    expected = image[..., 0] / 25.5
    # Half a pixel of misplacement would be 0.039; rounding to gray levels is 0.02.
    np.testing.assert_allclose(found.values[inside], expected[inside], atol=0.03)


def test_inverse_depth_is_inverted_and_nothing_is_infinite(tmp_path: Path) -> None:
    image = ramp()
    image[:8] = 0
    found = network(tmp_path, (1.0, 0, 0), depth={"kind": "inverse_depth"}).estimate(image, 50.0)
    np.testing.assert_allclose(found.values[8:], 255.0 / image[8:, :, 0], rtol=1e-5)
    assert np.isnan(found.values[:8]).all()


def test_a_canonical_camera_is_scaled_by_the_focal_length_at_the_size_of_the_network(tmp_path: Path) -> None:
    image = ramp()
    card: dict[str, Any] = {
        "depth": {"kind": "canonical_depth", "canonical_focal_px": 1000.0},
        "size": {"rule": "longest", "length": 128},
    }
    model = network(tmp_path, (0, 0, 0), 3.0, **card)
    assert model.needs_focal
    found = model.estimate(image, 250.0)  # 500 px at twice the size: half of what the network says
    np.testing.assert_allclose(found.values, 1.5, rtol=1e-6)


def test_relative_depth_is_handed_on_as_it_is(tmp_path: Path) -> None:
    image = ramp()
    model = network(tmp_path, (1.0, 0, 0), -0.3, depth={"kind": "affine_disparity"})
    assert model.is_affine
    np.testing.assert_allclose(model.estimate(image, 50.0).values, image[..., 0] / 255 - 0.3, atol=1e-5)


def test_what_is_unsure_far_or_near_is_missing(tmp_path: Path) -> None:
    image = ramp()
    sure = np.ones((1, 1, 48, 64), np.float32)
    sure[..., :10] = 0.2
    found = network(
        tmp_path,
        extra={"sure": sure},
        confidence={"name": "sure", "minimum": 0.5},
        depth={"min_depth": 2.02, "max_depth": 4.02},
    ).estimate(image, 50.0)
    expected = image[..., 0] / 25.5
    known = (expected > 2.02) & (expected <= 4.02)
    known[:, :10] = False
    assert (np.isfinite(found.values) == known).all()
    assert known.any()


def test_a_point_map_gives_its_last_channel_and_a_camera(tmp_path: Path) -> None:
    # As UniDepth: points and a camera at the network's size, pixel centers at 0.5.
    points = np.random.default_rng(0).uniform(1, 2, (1, 3, 32, 48)).astype(np.float32)
    camera = np.array([[[60.0, 0, 24.0], [0, 66.0, 16.0], [0, 0, 1]]], np.float32)
    constant_network(tmp_path / "tiny.onnx", {"pts_3d": points, "intrinsics": camera}, (32, 48))
    card = write_card(
        tmp_path / "tiny.yaml",
        size={"rule": "fixed", "height": 32, "width": 48},
        depth={"name": "pts_3d", "channel": 2},
        intrinsics={"name": "intrinsics", "kind": "matrix", "pixel_center": 0.5},
    )
    model = DepthNetwork(find_model(str(card), "depth"), CPU)
    found = model.estimate(np.zeros((64, 96, 3), np.uint8), 1.0)
    assert found.intrinsics is not None
    np.testing.assert_allclose(found.intrinsics, [120.0, 132.0, 47.5, 31.5], rtol=1e-6)
    np.testing.assert_allclose(found.values[1::2, 1::2][:-1, :-1].mean(), points[0, 2].mean(), rtol=0.01)
    padded = model.estimate(np.zeros((64, 64, 3), np.uint8), 1.0)  # 32 x 32 in the middle of 48
    assert padded.intrinsics is not None
    np.testing.assert_allclose(padded.intrinsics, [120.0, 132.0, 31.5, 31.5], rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "value", "focal"),
    [("focal_px", 50.0, 100.0), ("fov_deg", 53.130102, 96.0), ("fov_rad", 0.9272952, 96.0)],
)
def test_focal_lengths_and_angles_become_pixels_of_the_image(
    tmp_path: Path, kind: str, value: float, focal: float
) -> None:
    size = {"rule": "fixed", "height": 48, "width": 48, "keep_aspect": False}
    model = network(tmp_path, extra={"camera": [value]}, size=size, intrinsics={"name": "camera", "kind": kind})
    found = model.estimate(ramp(80, 96), 1.0)
    assert found.intrinsics is not None
    np.testing.assert_allclose(found.intrinsics, [focal, focal, 47.5, 39.5], rtol=1e-6)


def test_an_absurd_camera_is_not_used(tmp_path: Path) -> None:
    model = network(tmp_path, extra={"camera": [1e6]}, intrinsics={"name": "camera", "kind": "focal_px"})
    assert model.estimate(ramp(), 1.0).intrinsics is None


@pytest.mark.parametrize(("output", "card"), [((1, 2, 8, 8), {}), ((1, 8), {}), ((1, 3, 8, 8), {"channel": 5})])
def test_an_output_of_another_shape_is_one_error(tmp_path: Path, output: tuple[int, ...], card: Any) -> None:
    constant_network(tmp_path / "tiny.onnx", {"out": np.ones(output)}, (8, 8))
    size = {"rule": "fixed", "height": 8, "width": 8}
    written = write_card(tmp_path / "tiny.yaml", size=size, depth=card)
    with pytest.raises(InputError, match="its output 'out' has the shape"):
        DepthNetwork(find_model(str(written), "depth"), CPU).estimate(ramp(), 1.0)


@given(
    height=st.integers(3, 70), width=st.integers(3, 70),
    size=st.sampled_from([
        SizeSpec(rule="fixed", height=28, width=42), SizeSpec(rule="fixed", height=30, width=30, keep_aspect=False),
        SizeSpec(rule="longest", length=56, multiple_of=14), SizeSpec(rule="image", multiple_of=4),
    ]),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_pixels_go_there_and_back(height: int, width: int, size: SizeSpec) -> None:
    placement = place((height, width), size)
    corners = np.array([[-0.5, -0.5], [width - 0.5, height - 0.5], [0.0, 0.0]])
    np.testing.assert_allclose(placement.to_image(placement.to_input(corners)), corners, atol=1e-9)
    top, left, inner_height, inner_width = placement.content
    low, high = placement.to_input(corners)[:2]
    np.testing.assert_allclose(low + 0.5, [left, top], atol=1e-9)
    np.testing.assert_allclose(high + 0.5, [left + inner_width, top + inner_height], atol=1e-9)
    assert all(side % size.multiple_of == 0 for side in placement.input_size)
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    tensor = prepare(image, placement, InputSpec(name="x"), size)
    assert tensor.shape == (3, *placement.input_size)
    assert placement.restore(tensor[0]).shape == (height, width)


def test_missing_values_do_not_spread() -> None:
    values = np.full((8, 8), 2.0, np.float32)
    values[:4] = np.nan
    out = resize_known(values, (32, 32))
    assert np.isnan(out[:15]).all()
    np.testing.assert_allclose(out[17:], 2.0)
    assert np.isfinite(cv2.resize(np.nan_to_num(values), (32, 32))).all()


def test_the_shared_camera_ignores_frames_in_which_the_network_fails() -> None:
    rng = np.random.default_rng(1)
    frames = np.array([500.0, 505.0, 320.0, 240.0]) * rng.normal(1.0, 0.01, (60, 4))
    frames[:6] = [2000.0, 2000.0, 10.0, 10.0]
    frames[6:9] = np.nan
    found = shared_intrinsics(frames)
    assert found is not None
    np.testing.assert_allclose(found.intrinsics, [500.0, 505.0, 320.0, 240.0], rtol=0.005)
    assert found.used == 57
    assert 0.005 < found.spread < 0.02
    assert found.warnings() == []
    wild = shared_intrinsics(np.array([500.0, 500.0, 320.0, 240.0]) * rng.normal(1.0, 0.2, (60, 4)))
    assert wild is not None
    assert "give a calibration" in wild.warnings()[0]
    assert shared_intrinsics(np.full((3, 4), np.nan)) is None


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30))
@settings(max_examples=60, deadline=None)
def test_the_robust_mean_lies_among_the_values(values: list[float]) -> None:
    mean, sigma = robust_mean(np.array(values))
    assert min(values) - 1e-9 <= mean <= max(values) + 1e-9
    assert sigma >= 0
