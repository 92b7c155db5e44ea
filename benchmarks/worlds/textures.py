"""Images that surfaces are covered with: periodic, with smaller copies of themselves for what is far away."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, IntArray

Color = tuple[float, float, float]
"""RGB in [0, 1], as a screen shows it."""

SIZE = 1024
"""Width and height of images, px: a power of two."""
_WRAP = 4
"""Cells that a lattice is continued by on each side, so that its interpolation is periodic."""


def random_color(rng: np.random.Generator, low: float | Color = 0.1, high: float | Color = 0.9) -> Color:
    """Return a color with components between two values or colors."""
    red, green, blue = rng.uniform(low, high, 3).tolist()
    return red, green, blue


def scaled(color: Color, factor: float | Color) -> Color:
    """Return a color times a number or another color, at most 1."""
    red, green, blue = np.minimum(np.asarray(color) * factor, 1.0).tolist()
    return red, green, blue


@dataclass(frozen=True, eq=False)
class Texture:
    """A periodic image and its smaller copies, side by side in one image."""

    atlas: ImageArray
    """(H, W, 3) RGB: the full size on the left, ever smaller ones below each other on the right; wrapped borders."""
    corner: Float32Array
    """(L, 2) x and y in the atlas of the first pixel of each level."""
    size: int
    """Width and height of level 0, px."""

    @classmethod
    def of(cls, color: FloatArray | Float32Array) -> Texture:
        """Return the texture of a square image (H, H, 3) in [0, 1]."""
        level: ImageArray = np.asarray(np.round(np.multiply(255.0, np.clip(color, 0.0, 1.0))), dtype=np.uint8)
        size = len(level)
        atlas = np.zeros((size + 2, size + size // 2 + 4, 3), dtype=np.uint8)
        corner, x, y = [], 0, 0
        while len(level) >= 4:
            tall = len(level) + 2
            atlas[y : y + tall, x : x + tall] = np.pad(level, ((1, 1), (1, 1), (0, 0)), mode="wrap")
            corner.append((x + 1, y + 1))
            x, y = size + 2, 0 if len(corner) == 1 else y + tall
            half = len(level) // 2
            level = np.asarray(cv2.resize(level, (half, half), interpolation=cv2.INTER_AREA), dtype=np.uint8)
            if y + half + 2 > len(atlas):
                break
        return cls(atlas, np.asarray(corner, dtype=np.float32), size)

    def sample(self, texel: Float32Array, level: Int32Array | int) -> ImageArray:
        """Interpolate at positions.

        Args:
            texel: (N, 2) positions x, y in pixels of the largest level, of any size.
            level: (N,) or one for all: which level, 0 for the largest.

        Returns:
            (N, 3) RGB.
        """
        chosen = np.minimum(level, len(self.corner) - 1)
        period = np.float32(self.size)
        position = texel + np.float32(0.5)
        position -= period * np.floor(position / period)
        position *= np.ldexp(np.float32(1.0), -chosen)[..., None].astype(np.float32)
        position += self.corner[chosen] - np.float32(0.5)
        # The interpolation of images takes maps below 32768 pixels a side: a long list is laid out in rows.
        columns = 4096
        rows = max(-(-len(position) // columns), 1)
        padded = np.zeros((rows * columns, 2), dtype=np.float32)
        padded[: len(position)] = position
        found = cv2.remap(self.atlas, padded.reshape(rows, columns, 2), None, cv2.INTER_LINEAR)
        return np.asarray(found.reshape(-1, 3)[: len(position)], dtype=np.uint8)


def value_noise(cells: int, rng: np.random.Generator, cells_y: int | None = None) -> Float32Array:
    """Return (SIZE, SIZE) periodic noise in about [-1, 1] that has ``cells`` random values per row of the lattice."""
    lattice = rng.uniform(-1.0, 1.0, (cells_y or cells, cells)).astype(np.float32)
    wrapped = np.pad(lattice, _WRAP, mode="wrap")
    step_y, step_x = SIZE // lattice.shape[0], SIZE // cells
    large = cv2.resize(wrapped, (wrapped.shape[1] * step_x, wrapped.shape[0] * step_y), interpolation=cv2.INTER_CUBIC)
    cut_y, cut_x = _WRAP * step_y, _WRAP * step_x
    return np.asarray(large[cut_y : cut_y + SIZE, cut_x : cut_x + SIZE], dtype=np.float32)


@lru_cache(maxsize=64)
def fbm(seed: int, first: int = 4, octaves: int = 8, gain: float = 0.65, stretch: int = 1) -> Float32Array:
    """Return (SIZE, SIZE) fractal noise of zero mean and unit deviation.

    Args:
        seed: Seed.
        first: Cells per period of the coarsest octave.
        octaves: How many; each has twice as many cells as the one before.
        gain: Amplitude of an octave as a part of that of the one before.
        stretch: How much longer its spots are along y than along x.
    """
    rng = np.random.default_rng(seed)
    total, amplitude, cells = np.zeros((SIZE, SIZE), dtype=np.float32), 1.0, first
    for _ in range(octaves):
        if cells > SIZE // 2:
            break
        total += np.float32(amplitude) * value_noise(cells, rng, max(cells // stretch, 1))
        amplitude, cells = amplitude * gain, cells * 2
    total = np.asarray((total - total.mean()) / total.std(), dtype=np.float32)
    total.flags.writeable = False
    return total


def _blend(first: Color, second: Color, share: FloatArray | Float32Array) -> Float32Array:
    """Return (H, W, 3) colors between two, by a share (H, W) of the second."""
    part = np.clip(share, 0.0, 1.0)[..., None].astype(np.float32)
    mixed = (1.0 - part) * np.asarray(first, dtype=np.float32) + part * np.asarray(second, dtype=np.float32)
    return np.asarray(mixed, dtype=np.float32)


def _cells(columns: int, rows: int, stagger: float, gap: float) -> tuple[IntArray, BoolArray]:
    """Return which cell (SIZE, SIZE) of a wall of bricks each pixel is in, and whether it is in a joint.

    Args:
        columns: Bricks per row and period.
        rows: Rows per period; even where rows are staggered.
        stagger: Shift of every other row in bricks.
        gap: Width of the joints as a part of a row's height.
    """
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    row = np.floor(y * rows)
    along = np.mod(x * columns + stagger * np.mod(row, 2), columns)
    column = np.floor(along)
    inside_x, inside_y = (along - column) * rows / columns, y * rows - row
    width = rows / columns
    joint = (inside_y < gap) | (inside_x < gap) | (inside_x > width)
    return np.asarray(row * columns + column, dtype=np.int64), np.asarray(joint)


@cache
def bricks(
    first: Color, second: Color, joint: Color, columns: int = 8, rows: int = 24, seed: int = 0, stagger: float = 0.5,
    gap: float = 0.14, spread: float = 0.12, rough: float = 0.1,
) -> Texture:  # fmt: skip
    """Return bricks, tiles, slabs or planks: cells of varied color with joints between them.

    Args:
        first: Color of some cells.
        second: Color of others.
        joint: Color between them.
        columns: Cells per row and period.
        rows: Rows per period.
        seed: Seed.
        stagger: Shift of every other row in cells.
        gap: Width of the joints as a part of a row's height.
        spread: Deviation of the brightness of cells.
        rough: Relative amplitude of the noise within them.
    """
    rng = np.random.default_rng(seed)
    cell, joints = _cells(columns, rows, stagger, gap)
    share, bright = rng.uniform(size=columns * rows), 1.0 + spread * rng.standard_normal(columns * rows)
    color = _blend(first, second, share[cell]) * bright[cell][..., None]
    color = np.where(joints[..., None], np.asarray(joint), color)
    return Texture.of(color * (1.0 + rough * fbm(seed + 1, 8, 7, 0.8))[..., None])


@cache
def spots(first: Color, second: Color, seed: int = 0, first_cells: int = 4, gain: float = 0.75, contrast: float = 0.35,
          stretch: int = 1) -> Texture:  # fmt: skip
    """Return a rough surface (asphalt, concrete, bark, rendering): fractal noise between two colors."""
    noise = fbm(seed, first_cells, 9, gain, stretch)
    fine = np.random.default_rng(seed + 7).standard_normal((SIZE, SIZE)).astype(np.float32)
    return Texture.of(_blend(first, second, 0.5 + contrast * noise + 0.35 * contrast * fine))


@cache
def plain(color: Color, seed: int = 0, contrast: float = 0.012) -> Texture:
    """Return paint with next to no texture; ``contrast`` is the relative deviation of its brightness."""
    # Worlds have many paints: a smaller image does for what has nearly no texture.
    noise = 1.0 + contrast * fbm(seed % 4, 2, 8, 0.7)[::2, ::2]
    return Texture.of(np.asarray(color, dtype=np.float32) * noise[..., None])


@cache
def pebbles(first: Color, second: Color, joint: Color, count: int = 3000, seed: int = 0) -> Texture:
    """Return gravel or cobbles: ``count`` cells of the points nearest to random ones, darker towards their borders."""
    rng = np.random.default_rng(seed)
    center = rng.uniform(0, SIZE, (count, 2))
    y, x = np.mgrid[:SIZE, :SIZE]
    distance, owner = cKDTree(center, boxsize=SIZE).query(np.stack((x.ravel(), y.ravel()), axis=-1), k=2)
    border = ((distance[:, 1] - distance[:, 0]) / (0.35 * SIZE / np.sqrt(count))).reshape(SIZE, SIZE)
    share, bright = rng.uniform(size=count), rng.uniform(0.7, 1.2, count)
    nearest = owner[:, 0].reshape(SIZE, SIZE)
    color = _blend(first, second, share[nearest]) * bright[nearest][..., None]
    edge = np.clip(border, 0.0, 1.0)[..., None] ** 0.7
    color = edge * color + (1.0 - edge) * np.asarray(joint)
    return Texture.of(color * (1.0 + 0.08 * fbm(seed + 1, 16, 6, 0.9))[..., None])


@cache
def grass(first: Color = (0.16, 0.28, 0.08), second: Color = (0.55, 0.66, 0.28), seed: int = 0,
          count: int = 26000) -> Texture:  # fmt: skip
    """Return a lawn: ``count`` short blades of varied green over dark earth."""
    rng = np.random.default_rng(seed)
    canvas = np.full((SIZE, SIZE, 3), (0.12, 0.14, 0.06), dtype=np.float32)
    start, angle = rng.uniform(0, SIZE, (count, 2)), rng.uniform(0, 2 * np.pi, count)
    length, share = rng.uniform(12, 46, count), rng.uniform(size=count) ** 1.4
    end = start + length[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    color = np.asarray(first) + share[:, None] * (np.asarray(second) - np.asarray(first))
    color *= rng.uniform(0.75, 1.2, (count, 1))
    thick = rng.integers(1, 4, count)
    for i in range(count):
        shifts = [np.zeros(2)]
        # What leaves the image on one side comes back on the other.
        shifts += [SIZE * (np.floor(start[i] / SIZE) - np.floor(end[i] / SIZE))]
        for shift in shifts if np.any(shifts[-1]) else shifts[:1]:
            a, b = np.rint(start[i] + shift).astype(int), np.rint(end[i] + shift).astype(int)
            cv2.line(canvas, a.tolist(), b.tolist(), color[i].tolist(), int(thick[i]), cv2.LINE_AA)
    return Texture.of(canvas * (1.0 + 0.13 * fbm(seed + 1, 2, 4, 0.8))[..., None])


@cache
def wood(first: Color = (0.42, 0.26, 0.13), second: Color = (0.68, 0.47, 0.27), seed: int = 0,
         planks: int = 6) -> Texture:  # fmt: skip
    """Return ``planks`` boards per period with grain along y."""
    _y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    rng = np.random.default_rng(seed)
    board = np.floor(x * planks).astype(int)
    shift = rng.uniform(0, 7, planks)[board]
    warp = fbm(seed, 2, 5, 0.6, 2)
    rings = np.sin(2 * np.pi * (9.0 * x * 3 + 1.1 * warp + shift))
    grain = fbm(seed + 1, 64, 4, 0.8, 16)
    share = 0.5 + 0.22 * rings + 0.2 * grain + 0.25 * rng.standard_normal(planks)[board]
    seam = np.mod(x * planks, 1.0) < 0.012 * planks / 2
    return Texture.of(np.where(seam[..., None], 0.35 * np.asarray(first), _blend(first, second, share)))


@cache
def cloth(first: Color, second: Color, kind: str = "weave", bands: int = 8, seed: int = 0) -> Texture:
    """Return cloth: ``kind`` is ``weave`` (one color, fine threads), ``stripes``, ``plaid`` or ``dots``."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    wave_x, wave_y = np.sin(2 * np.pi * bands * x), np.sin(2 * np.pi * bands * y)
    share = {
        "weave": 0.5 + 0.1 * fbm(seed + 3, 4, 5, 0.8),
        "stripes": 0.5 + 0.5 * np.tanh(6 * wave_y),
        "plaid": 0.5 + 0.25 * np.tanh(6 * wave_x) + 0.25 * np.tanh(6 * wave_y),
        "dots": 0.5 + 0.5 * np.tanh(5 * (wave_x * wave_y - 0.45)),
    }[kind]
    thread = np.sin(2 * np.pi * 128 * x) * np.sin(2 * np.pi * 128 * y)
    shade = 1.0 + 0.08 * thread + 0.07 * fbm(seed, 8, 7, 0.8)
    return Texture.of(_blend(first, second, share) * shade[..., None])


@cache
def leaf(first: Color = (0.16, 0.3, 0.09), second: Color = (0.45, 0.58, 0.2), seed: int = 0) -> Texture:
    """Return what leaves are cut from: greens that differ from place to place, with veins."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    veins = np.exp(-(np.mod(32 * (x + np.abs(np.mod(8 * y, 1.0) - 0.5) / 8), 1.0) ** 2) / 0.01)
    share = 0.45 + 0.3 * fbm(seed, 16, 5, 0.7) + 0.2 * veins
    return Texture.of(_blend(first, second, share))


@cache
def painted(seed: int, ground: Color = (0.7, 0.68, 0.62), strokes: int = 60, letters: int = 14) -> Texture:
    """Return a wall with graffiti, a poster or a picture: thick curves, disks and letters of strong colors."""
    rng = np.random.default_rng(seed)
    canvas = np.asarray(ground) * (1.0 + 0.06 * fbm(seed, 8, 8, 0.8))[..., None]
    canvas = np.ascontiguousarray(np.round(255 * np.clip(canvas, 0, 1)), dtype=np.uint8)
    for _ in range(strokes):
        color, thick = rng.uniform(8, 245, 3).tolist(), int(rng.integers(4, 36))
        turn = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.45, 14))
        points = rng.uniform(0, SIZE, 2) + np.cumsum(30 * np.stack((np.cos(turn), np.sin(turn)), axis=-1), axis=0)
        cv2.polylines(canvas, [np.rint(points).astype(np.int32)], False, color, thick, cv2.LINE_AA)
        if rng.random() < 0.5:
            middle, radius = rng.integers(0, SIZE, 2).tolist(), int(rng.integers(8, 60))
            cv2.circle(canvas, middle, radius, color[::-1], -1, cv2.LINE_AA)
    for _ in range(letters):
        place, scale = rng.integers([0, 100], [SIZE - 150, SIZE]).tolist(), float(rng.uniform(2, 7))
        word, bright = "".join(rng.choice(list("ABCEKMNRSTXYZ4728"), 3)), rng.uniform(50, 255, 3).tolist()
        for color, thick in (((10, 10, 12), int(3 * scale) + 8), (bright, int(3 * scale))):
            cv2.putText(canvas, word, place, cv2.FONT_HERSHEY_DUPLEX, scale, color, thick, cv2.LINE_AA)
    return Texture.of(canvas / 255.0 * (1.0 + 0.05 * fbm(seed + 1, 64, 4, 0.9))[..., None])


@cache
def cloud_cover(seed: int = 5) -> Texture:
    """Return how much of the sky clouds cover, as gray values."""
    cover = np.clip(0.35 + 0.4 * fbm(seed, 4, 8, 0.55), 0, 1)
    return Texture.of(np.repeat(cover[..., None], 3, axis=-1))
