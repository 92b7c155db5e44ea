"""A solid texture: color as a function of rest-pose coordinates, so that it sticks to what moves and bends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy import ndimage

from uni4d_fg.arrays import Float32Array, FloatArray

_PERIOD_M = 2.56
_VOLUME_SIZE = 128
# Cells per period and amplitude: wavelengths from 32 cm down to 2 cm, a few pixels at room distances.
_OCTAVES = ((8, 0.5), (16, 0.8), (32, 1.0), (64, 1.0), (128, 0.5))


@dataclass(frozen=True)
class SurfaceStyle:
    """How one object is painted."""

    first: tuple[float, float, float]
    """RGB reflectance in [0, 1]."""
    second: tuple[float, float, float]
    """RGB reflectance in [0, 1], mixed in by a coarse noise and by the pattern."""
    pattern: Literal["none", "stripes", "checks", "dots"] = "none"
    """Regular pattern on top of the noise."""
    wavelength_m: float = 0.2
    """Period of the pattern, meters."""
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift in the noise, meters, so that equal shapes differ."""
    contrast: float = 0.45
    """Relative amplitude of the fine noise."""


def _lattice(cells: int, octave: int) -> Float32Array:
    """Return (cells, cells, cells) hashed values in [-1, 1]."""
    x, y, z = np.meshgrid(*(np.arange(cells, dtype=np.uint32),) * 3, indexing="ij")
    h = x * np.uint32(374761393) + y * np.uint32(668265263) + z * np.uint32(2246822519)
    h = h + np.full_like(h, octave + 1) * np.uint32(3266489917)
    for shift, factor in ((15, 2246822519), (13, 3266489917)):
        h = (h ^ (h >> np.uint32(shift))) * np.uint32(factor)
    h = h ^ (h >> np.uint32(16))
    return np.asarray(h / 2147483647.5 - 1.0, dtype=np.float32)


def _upsample(lattice: Float32Array, size: int) -> Float32Array:
    """Interpolate a periodic lattice to ``size`` cells per axis with a smoothstep blend."""
    position = np.arange(size) * (len(lattice) / size)
    cell = position.astype(np.int64)
    fraction = position - cell
    blend = (fraction * fraction * (3.0 - 2.0 * fraction)).astype(np.float32)
    for axis in range(3):
        shape = [1, 1, 1]
        shape[axis] = size
        weight = blend.reshape(shape)
        following = np.take(lattice, (cell + 1) % lattice.shape[axis], axis=axis)
        lattice = np.take(lattice, cell, axis=axis) * (1 - weight) + following * weight
    return lattice


@lru_cache(maxsize=1)
def noise_volume() -> Float32Array:
    """Return one period of multi-octave value noise, (128, 128, 128), zero mean and unit deviation."""
    volume = np.zeros((_VOLUME_SIZE,) * 3, dtype=np.float32)
    for octave, (cells, amplitude) in enumerate(_OCTAVES):
        volume += np.float32(amplitude) * _upsample(_lattice(cells, octave), _VOLUME_SIZE)
    volume -= volume.mean()
    volume /= volume.std()
    return volume


def solid_noise(points: FloatArray) -> Float32Array:
    """Sample the noise.

    Args:
        points: (N, 3) meters; the noise repeats every 2.56 m.

    Returns:
        (N,) values of zero mean and unit deviation.
    """
    coordinates = (points * (_VOLUME_SIZE / _PERIOD_M)).T
    sampled = ndimage.map_coordinates(noise_volume(), coordinates, order=1, mode="grid-wrap")
    return np.asarray(sampled, dtype=np.float32)


def _pattern(style: SurfaceStyle, points: FloatArray) -> FloatArray:
    """Return (N,) pattern values in [-1, 1] with edges soft enough not to alias."""
    if style.pattern == "none":
        return np.zeros(len(points))
    phase = points * (2.0 * np.pi / style.wavelength_m)
    if style.pattern == "stripes":
        wave = np.sin(phase @ np.array([0.8, 0.6, 0.7]))
    else:
        # The quarter-period shift keeps faces that lie on a zero of one axis from losing the pattern.
        sines = np.sin(phase + 0.25 * np.pi)
        wave = 2.5 * sines.prod(axis=-1) if style.pattern == "checks" else sines.sum(axis=-1) - 1.0
    return np.asarray(np.tanh(4.0 * wave), dtype=np.float64)


def reflectance(style: SurfaceStyle, points: FloatArray) -> FloatArray:
    """Evaluate the texture.

    Args:
        style: Paint of the object that the points belong to.
        points: (N, 3) rest-pose coordinates, meters.

    Returns:
        (N, 3) RGB reflectance in [0, 1].
    """
    shifted = points + np.asarray(style.offset_m)
    fine = solid_noise(shifted)
    coarse = solid_noise(0.35 * shifted[:, [1, 2, 0]] + 0.7)
    blend = 0.5 + 0.35 * np.tanh(1.2 * coarse) + 0.3 * _pattern(style, points)
    blend = np.clip(blend, 0.0, 1.0)[:, None]
    color = (1.0 - blend) * np.asarray(style.first) + blend * np.asarray(style.second)
    result: FloatArray = np.clip(color * (1.0 + style.contrast * np.tanh(0.9 * fine))[:, None], 0.0, 1.0)
    return result
