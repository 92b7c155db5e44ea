"""Scale, or scale and shift, of a whole video's predictions, in the ways of the literature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray

_CHUNK = 1 << 20
_BLOCK = 25
"""Steps of Adam between two looks at every pixel."""
_LARGEST_STEP = 0.1 / np.sqrt(1e-3)
"""Adam's steps are no longer than this many learning rates, (1 - beta1) / sqrt(1 - beta2)."""


@dataclass(frozen=True)
class Line:
    """The map ``x -> scale x + shift``."""

    scale: float = 1.0
    shift: float = 0.0


def lower_median(values: Float32Array | FloatArray) -> float:
    """Return the median of (N,) values, N > 0; the lower of the two middle ones for an even N, as ``torch.median``."""
    middle = (len(values) - 1) // 2
    return float(np.partition(values, middle)[middle])


def median_scale(x: Float32Array | FloatArray, y: Float32Array | FloatArray) -> Line:
    """Return the ratio of the medians of ``y`` and ``x``, (N,) each."""
    divisor = lower_median(x)
    return Line(lower_median(y) / divisor) if divisor else Line()


def weiszfeld_scale(x: Float32Array | FloatArray, y: Float32Array | FloatArray, iterations: int = 10) -> Line:
    """Return the scale of least absolute deviations, by reweighted least squares from the ratio of the means.

    Args:
        x: (N,) predictions.
        y: (N,) truth.
        iterations: How often weights are renewed; there is no test of convergence.
    """
    scale = float(np.mean(y, dtype=np.float64) / np.mean(x, dtype=np.float64))
    for _ in range(iterations):
        over, under = 0.0, 0.0
        for a, b in _chunks(x, y):
            weight = 1.0 / (np.abs(scale * a - b) + 1e-8)
            over += float(weight @ (a * b))
            under += float(weight @ (a * a))
        scale = over / under
    return Line(max(scale, 1e-3))


def least_squares(x: Float32Array | FloatArray, y: Float32Array | FloatArray) -> Line:
    """Return the line of least squares; with no shift where all ``x`` (N,) are equal."""
    mean_x, mean_y = float(np.mean(x, dtype=np.float64)), float(np.mean(y, dtype=np.float64))
    variation, covariation = 0.0, 0.0
    for a, b in _chunks(x, y):
        variation += float((a - mean_x) @ (a - mean_x))
        covariation += float((a - mean_x) @ (b - mean_y))
    if variation <= 1e-20 * len(x) * mean_x**2:
        # The solution of least norm, which is what the programs' solver gives.
        return Line(mean_y * mean_x / (1.0 + mean_x**2), mean_y / (1.0 + mean_x**2))
    scale = covariation / variation
    return Line(scale, mean_y - scale * mean_x)


def adam_absolute(
    x: Float32Array | FloatArray,
    y: Float32Array | FloatArray,
    *,
    learning_rate: float = 1e-4,
    iterations: int = 1000,
    tolerance: float = 1e-6,
) -> Line:
    """Return where so many steps of Adam on the sum of absolute deviations lead, from the ratio of medians.

    That is not the minimum: neither scale nor shift can move by much more than ``learning_rate * iterations``. Pixels
    whose sign cannot change within a block of steps are summed once per block, which changes nothing but the order of
    sums. Float64 throughout; the programs use float32.

    Args:
        x: (N,) predictions.
        y: (N,) truth.
        learning_rate: Of Adam, with its other defaults (0.9, 0.999, 1e-8).
        iterations: Largest number of steps.
        tolerance: A step that changes the sum by less is the last.
    """
    at = np.array([median_scale(x, y).scale, 0.0])
    first, second, before = np.zeros(2), np.zeros(2), None
    step = 0
    while step < iterations:
        near_x, near_y, sums = _split(x, y, at, _BLOCK * _LARGEST_STEP * learning_rate)
        for _ in range(min(_BLOCK, iterations - step)):
            step += 1
            residual = at[0] * near_x + at[1] - near_y
            sign = np.sign(residual)
            loss = float(np.abs(residual).sum() + sums @ np.array([at[0], at[1], -1.0]))
            gradient = np.array([sign @ near_x + sums[0], sign.sum() + sums[1]])
            first = 0.9 * first + 0.1 * gradient
            second = 0.999 * second + 0.001 * gradient**2
            unbiased = first / (1.0 - 0.9**step), second / (1.0 - 0.999**step)
            at = at - learning_rate * unbiased[0] / (np.sqrt(unbiased[1]) + 1e-8)
            if before is not None and abs(before - loss) < tolerance:
                return Line(float(at[0]), float(at[1]))
            before = loss
    return Line(float(at[0]), float(at[1]))


def _split(
    x: Float32Array | FloatArray, y: Float32Array | FloatArray, at: FloatArray, reach: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the pairs whose deviation may change its sign while scale and shift move by ``reach``; sums of the rest.

    The sums are of sign x, sign and sign y.
    """
    near_x, near_y, sums = [], [], np.zeros(3)
    for a, b in _chunks(x, y):
        residual = at[0] * a + at[1] - b
        sign = np.sign(residual)
        np.abs(residual, out=residual)
        residual -= (1.001 * reach) * (np.abs(a) + 1.0)
        near = np.flatnonzero(residual <= 0.0)
        near_x.append(a[near])
        near_y.append(b[near])
        sign[near] = 0.0
        sums += (sign @ a, sign.sum(), sign @ b)
    return np.concatenate(near_x), np.concatenate(near_y), sums


def _chunks(
    x: Float32Array | FloatArray, y: Float32Array | FloatArray
) -> list[tuple[FloatArray, FloatArray]] | map[tuple[FloatArray, FloatArray]]:
    """Yield both arrays in float64, part by part."""
    starts = range(0, len(x), _CHUNK)
    return map(lambda i: (x[i : i + _CHUNK].astype(np.float64), y[i : i + _CHUNK].astype(np.float64)), starts)
