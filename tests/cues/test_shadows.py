"""A shadow is the background, darker; something that is not the background is no shadow."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.appearance import compared_frame, frame_appearance, moved_evidence
from uni4d_fg.cues.pixel_grid import PixelGrid
from uni4d_fg.slam.lens.camera_model import CameraModel

CONFIG = MotionMaskConfig()
INTRINSICS = np.array([150.0, 150.0, 79.5, 59.5])
SIZE = (120, 160)
INSIDE = (slice(50, 75), slice(60, 105))
"""Pixels well within the circle that differs."""


def textured(rng: np.random.Generator, mean: tuple[float, float, float], contrast: float) -> np.ndarray:
    """A surface of one hue (H, W, 3), whose brightness varies."""
    noise = cv2.GaussianBlur(rng.normal(size=SIZE), (0, 0), 2.0)
    return np.array(mean) * (1.0 + contrast * noise / noise.std())[..., None]


def gain(inside: float, blur_px: float = 4.0) -> np.ndarray:
    """Brightness (H, W, 1) that is 1 but within a circle with a soft edge."""
    circle = np.zeros(SIZE)
    cv2.circle(circle, (80, 60), 40, 1.0, -1)
    return 1.0 + (inside - 1.0) * cv2.GaussianBlur(circle, (0, 0), blur_px)[..., None]


def evidence(frame: np.ndarray, background: np.ndarray, with_shadows: bool) -> float:
    """The mean evidence that the circle moves, as the second look has it."""
    image, other = (np.clip(np.round(i), 0, 255).astype(np.uint8) for i in (frame, background))
    depth = np.full(SIZE, 3.0, np.float32)
    source = frame_appearance(image, depth, 0.0, 5, CONFIG)
    static = PixelGrid.of(CameraModel(INTRINSICS), SIZE, SIZE).predict(source.z, np.eye(4), 0, 1)
    texture = source.contrast
    least = np.float32(3 * CONFIG.background_contrast**2)
    source = replace(source, contrast=np.maximum(texture, least))
    compared = compared_frame(other, depth, 0.0, 5, CONFIG)
    found = moved_evidence(source, compared, static, CONFIG, texture if with_shadows else None)
    return float(found[INSIDE].mean())


@pytest.mark.parametrize("darkness", [0.45, 0.6, 0.8])
def test_a_shadow_on_texture_is_background(darkness: float, rng: np.random.Generator) -> None:
    """Without looking for shadows it is as sure to move as anything can be."""
    floor = textured(rng, (150.0, 110.0, 70.0), 0.2)
    shadowed = floor * gain(darkness)
    assert evidence(shadowed, floor, with_shadows=False) > 1.0
    assert evidence(shadowed, floor, with_shadows=True) < -0.5


def test_other_things_are_no_shadow(rng: np.random.Generator) -> None:
    """Other texture as dark, another hue of the same texture, light, and what is darker than shadows are."""
    floor = textured(rng, (150.0, 110.0, 70.0), 0.2)
    part = (gain(0.0) < 0.5).astype(np.float64)
    others = {
        "texture": part * 0.6 * textured(rng, (150.0, 110.0, 70.0), 0.2) + (1 - part) * floor,
        "hue": floor * (1 - part * (1 - np.array([0.3, 0.6, 0.9]))),
        "light": floor * gain(1.6),
        "black": floor * gain(0.12),
    }
    for name, frame in others.items():
        assert evidence(frame, floor, with_shadows=True) > 0.5, name


def test_plain_clothes_before_a_plain_wall_move(rng: np.random.Generator) -> None:
    """Both differ by one gain as a shadow would; without texture nothing tells them apart."""
    wall = np.broadcast_to(np.array([200.0, 190.0, 170.0]), (*SIZE, 3)) + rng.normal(0, 1, (*SIZE, 3))
    clothes = wall * np.where(gain(0.5) < 0.75, 0.5, 1.0)
    assert evidence(clothes, wall, with_shadows=True) == evidence(clothes, wall, with_shadows=False) > 1.0


def test_a_frame_without_a_shadow_is_as_before(rng: np.random.Generator) -> None:
    floor = textured(rng, (150.0, 110.0, 70.0), 0.2)
    frame = floor + rng.normal(0, 2, floor.shape)
    both = [evidence(frame, floor, with_shadows) for with_shadows in (False, True)]
    assert both[0] < -0.75
    assert both[1] == pytest.approx(both[0], abs=0.05)
