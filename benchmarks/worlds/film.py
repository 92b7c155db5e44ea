"""Frames of a world: several times within each exposure, then the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.cameras import Camera
from benchmarks.worlds.shading import GAMMA, Light, Shader
from benchmarks.worlds.stage import Moment, Stage, Thing
from benchmarks.worlds.surface import Piece
from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray

_NEAR_M = 0.05
_CURVE = np.linspace(0.0, 1.0, 4096) ** (1.0 / GAMMA)


@dataclass(frozen=True, eq=False)
class World:
    """What is filmed, and how."""

    name: str
    static: list[Piece]
    things: list[Thing]
    camera: Camera
    light: Light
    width: int = 854
    height: int = 480
    focal_px: float = 700.0
    fps: float = 30.0
    frames: int = 60
    exposure_s: float = 1 / 60
    samples: int = 4
    """Times within an exposure; each also has another place within the pixel."""
    noise: float = 0.010
    """Deviation of the sensor's noise at middle gray, as a part of white."""
    gain: float = 1.0
    """Exposure: factor of the linear light."""
    kbps: int = 3000
    seed: int = 0
    tags: tuple[str, ...] = ()
    """What makes it hard."""

    @property
    def intrinsics(self) -> FloatArray:
        """(4,) fx, fy, cx, cy, px; centers of pixels are at integers."""
        return np.array([self.focal_px, self.focal_px, 0.5 * (self.width - 1), 0.5 * (self.height - 1)])

    def time(self, frame: int) -> float:
        """Return the middle of a frame's exposure, seconds."""
        return frame / self.fps


def pixel_rays(world: World, world_T_cam: FloatArray, offset: tuple[float, float] = (0.0, 0.0)) -> Float32Array:
    """Return rays (H * W, 6) through pixels moved by ``offset`` px; directions have unit z in the camera."""
    fx, fy, cx, cy = world.intrinsics
    x = (np.arange(world.width) + offset[0] - cx) / fx
    y = (np.arange(world.height) + offset[1] - cy) / fy
    rays = np.empty((world.height, world.width, 6), dtype=np.float32)
    rays[..., :3] = world_T_cam[:3, 3]
    right, down, forward = world_T_cam[:3, :3].T
    rays[..., 3:] = (x[:, None] * right)[None] + (y[:, None] * down + forward)[:, None]
    return rays.reshape(-1, 6)


def may_move(world: World, world_T_cam: FloatArray, moment: Moment) -> BoolArray:
    """Return (H * W,) False where certainly nothing that moves is seen: outside the rectangles around things."""
    fx, fy, cx, cy = world.intrinsics
    result = np.zeros((world.height, world.width), dtype=bool)
    for body in moment.bodies:
        local = (body - world_T_cam[:3, 3]) @ world_T_cam[:3, :3]
        if local[:, 2].max() < _NEAR_M:
            continue
        if local[:, 2].min() < _NEAR_M:
            result[:] = True
            break
        x, y = fx * local[:, 0] / local[:, 2] + cx, fy * local[:, 1] / local[:, 2] + cy
        left, top = max(int(x.min()) - 2, 0), max(int(y.min()) - 2, 0)
        result[top : max(int(y.max()) + 3, 0), left : max(int(x.max()) + 3, 0)] = True
    return result.ravel()


def _places(samples: int) -> list[tuple[float, float]]:
    """Return places within the pixel whose mean is its center, in an order that does not follow time."""
    golden = 0.6180339887
    place = np.array([[(i + 0.5) / samples, (0.5 + golden * i) % 1.0] for i in range(samples)]) - 0.5
    place -= place.mean(axis=0)
    mixed = np.random.default_rng(samples).permutation(samples)
    return [(float(x), float(y)) for x, y in place[mixed]]


class Filming:
    """Renders the frames of a world."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.stage = Stage(world.static, world.things)
        self._shader = Shader(self.stage, world.light, 1.0 / world.focal_px)

    def exposure(self, frame: int) -> FloatArray:
        """Return the mean linear light (H, W, 3) of a frame's exposure."""
        world = self.world
        total = np.zeros((world.height * world.width, 3), dtype=np.float32)
        for i, place in enumerate(_places(world.samples)):
            share = (i + 0.5) / world.samples
            time = world.time(frame) + (share - 0.5) * world.exposure_s
            moment, pose = self.stage.at(time), world.camera(time)
            rays = pixel_rays(world, pose, place)
            meet = self.stage.cast(moment, rays, may_move(world, pose, moment))
            total += self._shader.radiance(moment, rays, meet, share)
        return np.asarray(total.reshape(world.height, world.width, 3) / world.samples, dtype=np.float64)

    def image(self, frame: int) -> ImageArray:
        """Return a frame (H, W, 3) as the sensor gives it: exposure that drifts, noise, gamma."""
        world = self.world
        rng = np.random.default_rng([world.seed, frame])
        drift = 1.0 + 0.03 * np.sin(0.9 * world.time(frame) + world.seed)
        light = world.gain * drift * self.exposure(frame)
        # Bright light saturates softly, as in cameras that fit a wide range into eight bits.
        light = np.where(light > 0.7, 0.7 + 0.3 * np.tanh((light - 0.7) / 0.3), light)
        shown = _CURVE[np.clip(light * 4095, 0, 4095).astype(np.int32)]
        shown += world.noise * np.sqrt(0.4 + shown) * rng.standard_normal(shown.shape)
        return np.asarray(np.round(255.0 * np.clip(shown, 0.0, 1.0)), dtype=np.uint8)
