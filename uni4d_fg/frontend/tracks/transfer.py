"""Where points of an earlier image are in the present one, by those that are still followed.

Under small rotations a pixel moves by a polynomial of degree two of its position, plus its inverse depth times a vector
field that is linear in the position (Longuet-Higgins and Prazdny 1980). Inverse depth is not known, but displacements
from an image before are linear in it. So the motion m of a pixel x with an earlier displacement d is

    m = sum_i a_i q_i(x) + sum_jk b_jk d_j l_k(x),  q = (1, u, v, u^2, uv, v^2), l = (1, u, v),

fitted robustly to all points that are still followed: what moves by itself covers less than the rest. Coefficients have
normal priors, which decide outside of the region that is seen.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray

_DISPLACEMENT_UNIT_PX = 10.0
_PRIOR_PX = np.array([1e3, 50.0, 50.0, 10.0, 10.0, 10.0, 20.0, 5.0, 5.0, 20.0, 5.0, 5.0])
"""Standard deviations of the coefficients; pixels in units of half the longer side of the image."""
_ROUNDS, _CUT_OFF, _LEAST_SPREAD_PX = 8, 3.0, 0.2
_MEDIAN_OF_NORM = 1.1774
"""Median of the length of a 2D normal vector with unit variance in each component."""
_CORRELATED = 25.0
"""Errors of the model are alike in neighboring points: as if each point counted as this part of one."""


def transfer(
    source: FloatArray,
    displacement: FloatArray | None,
    target: FloatArray,
    at: FloatArray,
    at_displacement: FloatArray | None,
    image_size: tuple[int, int],
) -> tuple[FloatArray, FloatArray]:
    """Return the local affine motion of points.

    Args:
        source: (N, 2) px of points in the earlier image.
        displacement: (N, 2) px, how they had come there from an image before; None fits no parallax.
        target: (N, 2) px where they are.
        at: (M, 2) px of points in the earlier image that are not followed.
        at_displacement: (M, 2) px; None as for ``displacement``.
        image_size: Height and width, px.

    Returns:
        The warps (M, 6): u, v in px and the affine part by rows, and the standard deviations (M,) of u and v, px.
    """
    motion = target - source
    basis = _basis(source, displacement, image_size)
    prior = _PRIOR_PX[: basis.shape[1]] ** -2
    residual = np.linalg.norm(motion - np.median(motion, axis=0), axis=1)
    for _ in range(_ROUNDS):
        spread = max(float(np.median(residual)) / _MEDIAN_OF_NORM, _LEAST_SPREAD_PX)
        weighted = basis * ((1.0 + (residual / (_CUT_OFF * spread)) ** 2) ** -2)[:, None]
        information = weighted.T @ basis + np.diag(prior * spread**2)
        coefficients = np.linalg.solve(information, weighted.T @ motion)
        residual = np.linalg.norm(motion - basis @ coefficients, axis=1)
    here = _basis(at, at_displacement, image_size)
    leverage = np.einsum("ni,in->n", here, np.linalg.solve(information, here.T))
    moved = here @ coefficients
    columns = [_basis(at + step, at_displacement, image_size) @ coefficients + step - moved for step in np.eye(2)]
    warp = np.concatenate((at + moved, np.stack(columns, axis=2).reshape(-1, 4)), axis=1)
    return warp, spread * np.sqrt(1.0 + _CORRELATED * leverage)


def _basis(points: FloatArray, displacement: FloatArray | None, image_size: tuple[int, int]) -> FloatArray:
    """Return the values (N, 6 or 12) that motions are linear in."""
    height, width = image_size
    u, v = ((points - 0.5 * np.array([width, height])) / (0.5 * max(height, width))).T
    fields = [np.ones(len(u)), u, v, u * u, u * v, v * v]
    if displacement is not None:
        for d in (displacement / _DISPLACEMENT_UNIT_PX).T:
            fields += [d, d * u, d * v]
    return np.stack(fields, axis=1)
