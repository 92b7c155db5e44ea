"""Light that rays bring back: textures under sun or lamps, shadows, sky, and panes that mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.stage import Meet, Moment, Stage
from benchmarks.worlds.surface import Vector
from benchmarks.worlds.textures import cloud_cover, spots
from uni4d_fg.arrays import BoolArray, Float32Array, Int32Array

GAMMA = 2.2
"""A screen shows linear light to the power of 1 / GAMMA."""
_TO_LINEAR = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
_SHARP = 0.55
"""Footprint of a sample as a part of a pixel: several samples share a pixel."""
_LIFT_M = 2e-3
"""How far rays start from the surface they leave, and the same again per 10 m from the camera: single precision."""


@dataclass(frozen=True)
class Light:
    """What lights a world; colors are linear and may exceed 1."""

    sun: Vector | None = None
    """Direction to the sun."""
    sun_color: Vector = (1.5, 1.4, 1.2)
    lamps: tuple[Vector, ...] = ()
    """Positions of lamps, meters."""
    lamp_color: Vector = (3.0, 2.7, 2.3)
    """Light of a lamp at 1 m; it falls with the square of the distance, softened near by."""
    lamp_radius_m: float = 0.15
    """Lamps are moved about within this radius from sample to sample: soft shadows."""
    ambient_up: Vector = (0.42, 0.5, 0.62)
    """Light on what faces up."""
    ambient_down: Vector = (0.24, 0.22, 0.2)
    """Light on what faces down."""
    sky_top: Vector = (0.22, 0.42, 0.85)
    sky_horizon: Vector = (0.75, 0.83, 0.9)
    clouds: float = 0.7
    """How much clouds show, 0 to 1."""
    haze_m: float = 1500.0
    """Distance at which air hides 63 % of what is behind."""


def sky(light: Light, direction: Float32Array) -> Float32Array:
    """Return linear RGB (N, 3) of the sky in directions (N, 3) of any length."""
    unit = direction / np.sqrt(np.einsum("nd,nd->n", direction, direction))[:, None]
    up = np.clip(-unit[:, 1], 0, 1)
    share = np.sqrt(up)[:, None]
    horizon, top = (np.asarray(c, dtype=np.float32) for c in (light.sky_horizon, light.sky_top))
    color = (1 - share) * horizon + share * top
    if light.clouds > 0:
        place = unit[:, [0, 2]] * (220 / (up[:, None] + np.float32(0.12)))
        cover = cloud_cover().sample(place, 0)[:, 0] * np.float32(1 / 255)
        part = (light.clouds * np.clip(cover * 1.6 - 0.35, 0, 1) * np.clip(up * 8, 0, 1))[:, None]
        color += part * (np.float32(0.95) - color)
    return np.asarray(color, dtype=np.float32)


class Shader:
    """Turns rays into light.

    Args:
        stage: The world.
        light: What lights it.
        pixel: Angle between neighboring pixels, rad.
    """

    def __init__(self, stage: Stage, light: Light, pixel: float) -> None:
        self._stage, self._light, self._pixel = stage, light, pixel
        materials = stage.materials
        self._texel = np.array([m.period_m / m.texture.size for m in materials], dtype=np.float32)
        self._tint = np.array([m.tint for m in materials], dtype=np.float32)
        self._mirror = np.array([m.mirror for m in materials], dtype=np.float32)
        self._macro = np.array([m.macro for m in materials], dtype=np.float32)
        self._leafy = np.array([m.leafy for m in materials])
        self._variation = spots((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 99, 4, 0.6, 0.2)

    def radiance(
        self, moment: Moment, rays: Float32Array, meet: Meet, sample: float, mirrors: bool = True
    ) -> Float32Array:
        """Return the light (N, 3), linear RGB, that rays bring.

        Args:
            moment: The world at the time of the rays.
            rays: (N, 6) origins and directions.
            meet: What they meet.
            sample: In [0, 1), differs between the samples of a pixel.
            mirrors: Whether to follow rays that panes throw back.
        """
        hit = meet.triangle >= 0
        if not hit.all():
            result = np.empty((len(rays), 3), dtype=np.float32)
            away, rows = np.flatnonzero(~hit), np.flatnonzero(hit)
            result[away] = sky(self._light, rays[away, 3:])
            if len(rows):
                met = Meet(meet.distance[rows], meet.triangle[rows], meet.weight[rows])
                result[rows] = self.radiance(moment, np.take(rays, rows, axis=0), met, sample, mirrors)
            return result
        stage, triangle = self._stage, meet.triangle
        weight = np.empty((len(rays), 3), dtype=np.float32)
        weight[:, 1:] = meet.weight
        weight[:, 0] = 1.0 - weight[:, 1] - weight[:, 2]
        direction = rays[:, 3:]
        length = np.sqrt(np.einsum("nd,nd->n", direction, direction))
        distance = meet.distance * length
        point = rays[:, :3] + meet.distance[:, None] * direction
        direction = direction / length[:, None]
        normal = np.einsum("nk,nkd->nd", weight, np.take(moment.normals, triangle, axis=0))
        facing = -np.einsum("nd,nd->n", normal, direction)
        size = np.sqrt(np.maximum(np.einsum("nd,nd->n", normal, normal), np.float32(1e-18)))
        normal *= (np.where(facing < 0, np.float32(-1), np.float32(1)) / size)[:, None]
        facing = np.abs(facing) / size

        uv = np.einsum("nk,nkd->nd", weight, np.take(stage.uv, triangle, axis=0))
        material = np.take(stage.material, triangle)
        color = self._albedo(material, uv, distance, facing, sample)
        leafy = np.take(self._leafy, material)
        color *= self._lit(moment, point, normal, distance, leafy, sample)
        if mirrors and self._mirror.any():
            glossy = np.flatnonzero(np.take(self._mirror, material) > 0)
            part = self._mirror[material[glossy], None]
            part = part + (1 - part) * 0.4 * ((1 - facing[glossy, None]) ** 5)
            thrown = np.empty((len(glossy), 6), dtype=np.float32)
            thrown[:, :3] = point[glossy] + normal[glossy] * self._lift(distance[glossy])
            thrown[:, 3:] = direction[glossy] + 2 * facing[glossy, None] * normal[glossy]
            seen = self.radiance(moment, thrown, stage.cast(moment, thrown), sample, mirrors=False)
            color[glossy] = (1 - part) * color[glossy] + part * seen
        haze = np.exp(distance * np.float32(-1 / self._light.haze_m))[:, None]
        color *= haze
        color += (1 - haze) * np.asarray(self._light.sky_horizon, dtype=np.float32)
        return np.asarray(color, dtype=np.float32)

    @staticmethod
    def _lift(distance: Float32Array) -> Float32Array:
        """Return how far (N, 1) rays start from surfaces, meters."""
        return np.asarray(_LIFT_M * (1.0 + 0.1 * distance)[:, None], dtype=np.float32)

    def _albedo(
        self, material: Int32Array, uv: Float32Array, distance: Float32Array, facing: Float32Array, sample: float
    ) -> Float32Array:
        """Return linear reflectance (N, 3) of materials (N,) at texture coordinates (N, 2), meters."""
        footprint = _SHARP * self._pixel * distance / np.sqrt(np.maximum(facing, 0.05))
        texel = np.take(self._texel, material)
        # Samples of a pixel round differently, so that levels blend.
        level = np.floor(np.log2(np.maximum(footprint / texel, 1.0)) + sample).astype(np.int32)
        order = np.argsort(material.astype(np.int16), kind="stable")
        position, level = np.take(uv / texel[:, None], order, axis=0), np.take(level, order)
        bounds = np.cumsum(np.bincount(material, minlength=len(self._texel)))
        sorted_color = np.empty((len(uv), 3), dtype=np.uint8)
        start = 0
        for paint, stop in zip(self._stage.materials, bounds.tolist(), strict=True):
            if stop > start:
                sorted_color[start:stop] = paint.texture.sample(position[start:stop], level[start:stop])
            start = stop
        color = np.empty((len(uv), 3), dtype=np.float32)
        color[order] = np.take(_TO_LINEAR, sorted_color)
        color *= np.take(self._tint, material, axis=0)
        macro = np.take(self._macro, material)
        rows = np.flatnonzero(macro > 0) if self._macro.any() else np.zeros(0, dtype=np.int64)
        if len(rows):
            wide = self._texel[material[rows], None] * np.float32(7.3)
            value = self._variation.sample(uv[rows] / wide, 1)[:, 0].astype(np.float32) / 127.5 - 1.0
            color[rows] *= (1.0 + 2.5 * macro[rows] * value).clip(0.2, 2.0)[:, None]
        return color

    def _lit(
        self, moment: Moment, point: Float32Array, normal: Float32Array, distance: Float32Array, leafy: BoolArray,
        sample: float,
    ) -> Float32Array:  # fmt: skip
        """Return the light (N, 3) that falls on points (N, 3) with normals (N, 3)."""
        light = self._light
        up = (0.5 - 0.5 * normal[:, 1])[:, None]
        total = up * np.asarray(light.ambient_up, np.float32) + (1 - up) * np.asarray(light.ambient_down, np.float32)
        start = point + normal * self._lift(distance)
        if light.sun is not None:
            to_sun = np.asarray(light.sun, dtype=np.float32)
            to_sun = to_sun / np.linalg.norm(to_sun)
            cosine = normal @ to_sun
            cosine = np.where(leafy, 0.25 + 0.75 * np.abs(cosine), np.maximum(cosine, 0))
            rows = np.flatnonzero(cosine > 0)
            rays = np.empty((len(rows), 6), dtype=np.float32)
            rays[:, :3], rays[:, 3:] = np.take(start, rows, axis=0), to_sun
            cosine[rows[self._stage.hidden(moment, rays, np.inf)]] = 0
            total += cosine[:, None] * np.asarray(light.sun_color, dtype=np.float32)
        for i, lamp in enumerate(light.lamps):
            turn = 2 * np.pi * (sample + 0.37 * i)
            moved = np.asarray(lamp) + light.lamp_radius_m * np.array([np.cos(turn), 0.0, np.sin(turn)])
            to_lamp = moved.astype(np.float32) - start
            square = np.einsum("nd,nd->n", to_lamp, to_lamp)
            fall = np.maximum(np.einsum("nd,nd->n", normal, to_lamp), 0) / (np.sqrt(square) * (square + 0.5))
            rows = np.flatnonzero(fall > 0)
            rays = np.empty((len(rows), 6), dtype=np.float32)
            rays[:, :3], rays[:, 3:] = np.take(start, rows, axis=0), np.take(to_lamp, rows, axis=0)
            fall[rows[self._stage.hidden(moment, rays, 0.98)]] = 0
            total += fall[:, None] * np.asarray(light.lamp_color, dtype=np.float32)
        return np.asarray(total, dtype=np.float32)
