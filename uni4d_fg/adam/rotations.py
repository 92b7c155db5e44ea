r"""Rotation vectors to matrices by Rodrigues' formula, differentiable at zero.

With W the cross-product matrix of w:

    R = I + (sin a / a) W + ((1 - cos a) / a^2) W^2,   a = |w|
"""

from __future__ import annotations

from uni4d_fg.arrays import Array, namespace

_SMALL_SQUARED_ANGLE = 1e-8


def rotation_matrix(rotation_vector: Array) -> Array:
    """Return matrices (N, 3, 3) of rotation vectors (N, 3), rad; NumPy or torch."""
    xp = namespace(rotation_vector)
    x, y, z = rotation_vector[..., 0], rotation_vector[..., 1], rotation_vector[..., 2]
    squared = x * x + y * y + z * z
    small = squared < _SMALL_SQUARED_ANGLE
    angle = xp.sqrt(xp.where(small, 1.0 + 0.0 * squared, squared))
    first = xp.where(small, 1.0 - squared / 6.0, xp.sin(angle) / angle)
    half = xp.sin(0.5 * angle) / angle
    second = xp.where(small, 0.5 - squared / 24.0, 2.0 * half * half)
    rows = (
        (1.0 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y),
        (second * x * y + first * z, 1.0 - second * (x * x + z * z), second * y * z - first * x),
        (second * x * z - first * y, second * y * z + first * x, 1.0 - second * (x * x + y * y)),
    )
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
