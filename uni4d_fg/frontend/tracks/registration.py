r"""Where patches are found in an image, under affine warps.

A template T of a point's first view is found at the warp ``W(x) = b + A x`` that minimizes

    sum_x w(x) (g (I(W(x)) - mean I) - (T(x) - mean T))^2 + s |A - A_0|^2,

g bringing both to one deviation, so that neither brightness nor contrast matters; w falls off from the center, where
the point is. The affine part is held to where it starts by the stiffness s, which decides where no texture tells.
Minimized by the inverse compositional algorithm: gradients are those of the template, computed once.
Source: Baker and Matthews 2004, "Lucas-Kanade 20 years on"; Shi and Tomasi 1994, "Good features to track".
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.optim.extension import find_extension, import_extension

_FALL_OFF = 0.6
"""Standard deviation of the weight, in half sides of the patch."""
_STIFFNESS = 2.0
"""Gray levels squared per pixel, for a corner of the patch that moves by a pixel."""
_MAX_ITERATIONS, _CONVERGENCE_PX = 6, 0.03
_LEAST_VARIANCE, _LEAST_INSIDE, _LARGEST_STEP_PX, _LEAST_DETERMINANT = 1.0, 0.5, 5.0, 0.1
_CHUNK = 512
"""Patches at once in NumPy, so that they stay in the cache."""


def cut_templates(image: ImageArray, points: Float32Array, patch_px: int) -> Float32Array:
    """Return gray levels (N, P + 2, P + 2) around points, bilinear, NaN outside of the image and of points outside.

    Args:
        image: (H, W) uint8.
        points: (N, 2) px.
        patch_px: Side P of the patches, made odd; a template has one more pixel on each side, for gradients.
    """
    levels, whole = cut_levels(image, points, patch_px // 2 + 1)
    return templates_of(levels, points, whole, image.shape[:2])


def cut_levels(image: ImageArray, points: Float32Array, reach: int) -> tuple[ImageArray, Float32Array]:
    """Return whole pixels (N, 2 reach + 2, 2 reach + 2) around points (N, 2) px, edges repeated beyond the image.

    Returns:
        The gray levels, and the pixels (N, 2) that are left of and above the middles: those of the points, or the
        nearest to points outside.
    """
    last = np.array((image.shape[1] - 1, image.shape[0] - 1), np.float32)
    whole = np.clip(np.floor(points), 0, last)
    # One place between four pixels for all of a patch, whose gray levels come in one piece from an image with a frame.
    framed = cv2.copyMakeBorder(image, reach, reach + 1, reach, reach + 1, cv2.BORDER_REPLICATE)
    column, row = whole.astype(np.int64).T
    return np.lib.stride_tricks.sliding_window_view(framed, (2 * reach + 2,) * 2)[row, column], whole


def between_pixels(levels: Float32Array, fraction: Float32Array) -> Float32Array:
    """Return levels (N, S - 1, S - 1), bilinear, at fractions (N, 2) of a pixel right of and below those (N, S, S)."""
    fu, fv = fraction[:, 0, None, None], fraction[:, 1, None, None]
    across = levels[:, :, :-1] + fu * (levels[:, :, 1:] - levels[:, :, :-1])
    between: Float32Array = across[:, :-1] + fv * (across[:, 1:] - across[:, :-1])
    return between


def templates_of(
    levels: ImageArray, points: Float32Array, whole: Float32Array, image_size: tuple[int, int]
) -> Float32Array:
    """Return what :func:`cut_templates` does, from what :func:`cut_levels` returned of an image (height, width)."""
    height, width = image_size
    reach = levels.shape[1] // 2 - 1
    templates = between_pixels(levels.astype(np.float32), points - whole)
    # Few patches leave the image: pixels are looked at in these only.
    last = np.array((width - 1, height - 1), np.float32)
    rows = np.flatnonzero(((points < reach) | (points > last - reach)).any(axis=1))
    offset = np.arange(-reach, reach + 1, dtype=np.float32)
    u, v = points[rows, :1] + offset, points[rows, 1:] + offset
    outside = ((v < 0) | (v > height - 1))[:, :, None] | ((u < 0) | (u > width - 1))[:, None, :]
    outside[((points[rows] < 0) | (points[rows] > last)).any(axis=1)] = True
    leaving = templates[rows]
    leaving[outside] = np.nan
    templates[rows] = leaving
    return templates


def is_fast() -> bool:
    """Return whether the C++ extension is there to do it."""
    return find_extension()[0] is not None


def register(
    templates: Float32Array,
    rows: IntArray,
    image: ImageArray,
    warp: FloatArray,
    use_extension: bool = True,
) -> tuple[FloatArray, FloatArray]:
    """Find templates in an image.

    Args:
        templates: (M, P + 2, P + 2) of :func:`cut_templates`.
        rows: (N,) which of them.
        image: (H, W) uint8.
        warp: (N, 6) where to start: u, v in px and the affine part by rows.
        use_extension: Use the C++ extension if it is installed; the result is the same up to rounding to floats.

    Returns:
        The warps (N, 6), and the correlations (N,) there; -1 where a template has too little contrast, is half outside
        of the image, or is not near.
    """
    weight = _weights(templates.shape[1] - 2)
    if use_extension and is_fast():
        core = import_extension()
        found: FloatArray
        correlation: FloatArray
        found, correlation = core.register_patches(
            templates, rows, image, warp, weight=weight, stiffness=_STIFFNESS,
            max_iterations=_MAX_ITERATIONS, convergence_px=_CONVERGENCE_PX,
        )  # fmt: skip
        return found, correlation
    gray = image.astype(np.float64)
    parts = [
        _Registration(templates[rows[n : n + _CHUNK]].astype(np.float64), gray, warp[n : n + _CHUNK], weight).solve()
        for n in range(0, len(rows), _CHUNK)
    ]
    if not parts:
        return warp.copy(), np.zeros(0)
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _weights(side: int) -> FloatArray:
    offset = np.arange(side) - side // 2
    fall_off = np.exp(-0.5 * (offset / (_FALL_OFF * (side // 2))) ** 2)
    return np.ascontiguousarray(fall_off[:, None] * fall_off)


class _Registration:
    """Some templates and what stays the same from iteration to iteration."""

    def __init__(self, templates: FloatArray, gray: FloatArray, warp: FloatArray, weight: FloatArray) -> None:
        count, half = len(templates), weight.shape[0] // 2
        v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
        self.x, self.y, self.gray, self.warp = u.ravel(), v.ravel(), gray, warp.copy()
        gradient_x = (0.5 * (templates[:, 1:-1, 2:] - templates[:, 1:-1, :-2])).reshape(count, -1)
        gradient_y = (0.5 * (templates[:, 2:, 1:-1] - templates[:, :-2, 1:-1])).reshape(count, -1)
        value = templates[:, 1:-1, 1:-1].reshape(count, -1)
        whole = np.isfinite(gradient_x + gradient_y + value)
        self.value = np.where(whole, value, 0.0)
        self.weight = np.where(whole, weight.ravel(), 0.0)
        gx, gy = np.where(whole, gradient_x, 0.0), np.where(whole, gradient_y, 0.0)
        self.rows = np.stack((gx, gy, gx * self.x, gx * self.y, gy * self.x, gy * self.y), axis=2)
        system = np.einsum("np,npi,npj->nij", self.weight, self.rows, self.rows, optimize=True)
        self.total = self.weight.sum(axis=1)
        self.stiffness = _STIFFNESS * self.total * half * half
        system[:, range(2, 6), range(2, 6)] += self.stiffness[:, None]
        self.solvable: BoolArray = (np.linalg.eigvalsh(system)[:, 0] > 1e-9) if count else np.zeros(0, np.bool_)
        self.inverse = np.zeros_like(system)
        self.inverse[self.solvable] = np.linalg.inv(system[self.solvable])

    def solve(self) -> tuple[FloatArray, FloatArray]:
        start = self.warp[:, 2:].copy()
        correlation = np.full(len(self.warp), -1.0)
        moved = np.full(len(self.warp), np.inf)
        live = np.flatnonzero(self.solvable)
        for iteration in range(_MAX_ITERATIONS + 1):
            sampled, used = self._sample(live)
            weight = used.sum(axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                mean, first = ((used * a).sum(axis=1) / weight for a in (sampled, self.value[live]))
                here, there = sampled - mean[:, None], self.value[live] - first[:, None]
                spread, other = ((used * a * a).sum(axis=1) / weight for a in (here, there))
                covariance = (used * here * there).sum(axis=1) / weight
                usable = (weight >= _LEAST_INSIDE * self.total[live]) & (spread > _LEAST_VARIANCE)
                usable &= other > _LEAST_VARIANCE
                done = usable & ((iteration == _MAX_ITERATIONS) | (moved[live] < _CONVERGENCE_PX))
                correlation[live[done]] = (covariance / np.sqrt(spread * other))[done]
                difference = used * (np.sqrt(other / spread)[:, None] * here - there)
            going = usable & ~done
            live = live[going]
            if len(live) == 0:
                break
            slope = np.einsum("np,npi->ni", difference[going], self.rows[live])
            slope[:, 2:] += self.stiffness[live, None] * (self.warp[live, 2:] - start[live])
            step = np.einsum("nij,nj->ni", self.inverse[live], slope)
            moved[live] = self._compose(live, step)
            live = live[moved[live] < _LARGEST_STEP_PX]
        return self.warp, correlation

    def _sample(self, live: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the image under the warps (n, P^2), and the weights there: zero outside of the image."""
        height, width = self.gray.shape
        b, a = self.warp[live, :2, None], self.warp[live, 2:, None]
        u, v = b[:, 0] + a[:, 0] * self.x + a[:, 1] * self.y, b[:, 1] + a[:, 2] * self.x + a[:, 3] * self.y
        inside: BoolArray = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        column, row = u.astype(np.int64), v.astype(np.int64)
        fu, fv = u - column, v - row
        flat, at = self.gray.reshape(-1), row * width + column
        right, below = min(1, width - 1), width * min(1, height - 1)
        above = flat[at] + fu * (flat[at + right] - flat[at])
        under = flat[at + below] + fu * (flat[at + below + right] - flat[at + below])
        sampled = np.where(inside, above + fv * (under - above), 0.0)
        return sampled, np.where(inside, self.weight[live], 0.0)

    def _compose(self, live: IntArray, step: FloatArray) -> FloatArray:
        """Replace the warps W by W o D^{-1} and return how far the centers moved, infinite where D folds."""
        matrix = step[:, 2:].reshape(-1, 2, 2) + np.eye(2)
        determinant = np.linalg.det(matrix)
        usable = determinant > _LEAST_DETERMINANT
        back = np.linalg.inv(np.where(usable[:, None, None], matrix, np.eye(2)))
        affine = self.warp[live, 2:].reshape(-1, 2, 2)
        center = -np.einsum("nij,njk,nk->ni", affine, back, step[:, :2])
        self.warp[live, :2] += np.where(usable[:, None], center, 0.0)
        self.warp[live, 2:] = (affine @ back).reshape(-1, 4)
        return np.where(usable, np.linalg.norm(center, axis=1), np.inf)
