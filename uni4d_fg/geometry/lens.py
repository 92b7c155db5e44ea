r"""Lens distortion: camera models as what they do to a viewing direction.

A camera model maps a point in camera axes to a direction in a plane, and the plane to pixels,

    (u, v) = (fx a + cx, fy b + cy),   (a, b) = lens(x, y, z).

| model | parameters | (a, b) |
|---|---|---|
| PINHOLE | | (x', y') = (x / z, y / z) |
| SIMPLE_RADIAL | k1 | (x', y') (1 + k1 r^2) |
| RADIAL | k1, k2 | (x', y') (1 + k1 r^2 + k2 r^4) |
| OPENCV | k1, k2, p1, p2 | the same, plus (2 p1 x' y' + p2 (r^2 + 2 x'^2), p1 (r^2 + 2 y'^2) + 2 p2 x' y') |
| OPENCV_FISHEYE | k1, k2, k3, k4 | (x, y) / R . theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) |

with r^2 = x'^2 + y'^2, R^2 = x^2 + y^2 and theta = atan2(R, z). Names, order and formulas are those of COLMAP and
OpenCV. The first four are one family, of which the simpler hold parameters at zero; COLMAP's SIMPLE_RADIAL and RADIAL
also have one focal length.

A **real** pixel is where the image shows a point; its **ideal** pixel is where the pinhole with the same intrinsics
would show it. Stages that do not estimate the lens work on ideal pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from uni4d_fg.arrays import Array, BoolArray, FloatArray, namespace
from uni4d_fg.errors import InputError

LensModel: TypeAlias = Literal["PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]

PARAMETERS: dict[LensModel, tuple[str, ...]] = {
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""Distortion parameters per model, in order."""

_ITERATIONS = 30
"""Newton steps of the inversion at most; five are usual."""
_ON_AXIS = 1e-8
"""R^2 / z^2 below which the fisheye's quotients are replaced by their limits."""


def distort(parameters: Array, point: Array) -> Array:
    """Apply the polynomial model.

    Args:
        parameters: (..., 4) k1, k2, p1, p2, broadcast against the points.
        point: (..., 2) x', y'.

    Returns:
        (..., 2) a, b.
    """
    xp = namespace(point)
    x, y = point[..., 0], point[..., 1]
    k1, k2, p1, p2 = (parameters[..., i] for i in range(4))
    q = x * x + y * y
    radial = 1.0 + q * (k1 + q * k2)
    a = x * radial + 2.0 * p1 * x * y + p2 * (q + 2.0 * x * x)
    b = y * radial + p1 * (q + 2.0 * y * y) + 2.0 * p2 * x * y
    return xp.stack((a, b), axis=-1)


def distort_derivatives(parameters: FloatArray, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Differentiate :func:`distort`: with respect to the point (..., 2, 2) and to the parameters (..., 2, 4)."""
    x, y = point[..., 0], point[..., 1]
    k1, k2, p1, p2 = (parameters[..., i] for i in range(4))
    q = x * x + y * y
    radial, slope = 1.0 + q * (k1 + q * k2), 2.0 * (k1 + 2.0 * q * k2)
    by_point = np.empty((*x.shape, 2, 2))
    by_point[..., 0, 0] = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    by_point[..., 0, 1] = by_point[..., 1, 0] = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    by_point[..., 1, 1] = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    xy, rows = 2.0 * x * y, (x, y)
    by_parameters = np.empty((*x.shape, 2, 4))
    for i in range(2):
        by_parameters[..., i, 0], by_parameters[..., i, 1] = rows[i] * q, rows[i] * q * q
        by_parameters[..., i, 2] = xy if i == 0 else q + 2.0 * y * y
        by_parameters[..., i, 3] = q + 2.0 * x * x if i == 0 else xy
    return by_point, by_parameters


def fisheye(parameters: Array, point: Array) -> Array:
    """Apply the fisheye model to points in camera axes.

    Args:
        parameters: (..., 4) k1 to k4, broadcast against the points.
        point: (..., 3) x, y, z; z may be zero or negative, except on the axis.

    Returns:
        (..., 2) a, b.
    """
    xp = namespace(point)
    x, y, z = point[..., 0], point[..., 1], point[..., 2]
    square = x * x + y * y
    near_axis = square < _ON_AXIS * z * z
    radius = xp.sqrt(xp.where(near_axis, xp.ones_like(square), square))
    theta = xp.atan2(radius, z)
    curved = theta * _angle_polynomial(parameters, theta * theta) / radius
    scale = xp.where(near_axis, 1.0 / xp.where(near_axis, z, xp.ones_like(z)), curved)
    return xp.stack((x * scale, y * scale), axis=-1)


def fisheye_derivatives(parameters: FloatArray, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Differentiate :func:`fisheye`: with respect to the point (..., 2, 3) and to the parameters (..., 2, 4)."""
    x, y, z = point[..., 0], point[..., 1], point[..., 2]
    square = x * x + y * y
    near_axis = square < _ON_AXIS * z * z
    radius = np.sqrt(np.where(near_axis, 1.0, square))
    safe_z = np.where(near_axis, z, 1.0)
    theta = np.arctan2(radius, z)
    t2 = np.where(near_axis, 0.0, theta * theta)
    polynomial = _angle_polynomial(parameters, t2)
    slope = 1.0 + sum((2 * i + 3) * parameters[..., i] * t2 ** (i + 1) for i in range(4))  # d theta_d / d theta
    distance = square + z * z
    scale = np.where(near_axis, 1.0 / safe_z, theta * polynomial / radius)
    # d scale / d x = x . bend, and at the axis the limit of bend
    bend = np.where(
        near_axis,
        (2.0 * parameters[..., 0] - 2.0 / 3.0) / safe_z**3,
        (slope * z / distance - scale) / np.where(near_axis, 1.0, square),
    )
    by_point = np.empty((*x.shape, 2, 3))
    by_point[..., 0, 0], by_point[..., 1, 1] = scale + x * x * bend, scale + y * y * bend
    by_point[..., 0, 1] = by_point[..., 1, 0] = x * y * bend
    by_point[..., 0, 2], by_point[..., 1, 2] = -x * slope / distance, -y * slope / distance
    # On the axis all parameters' effects vanish as theta^3.
    powers = np.stack([np.where(near_axis, 0.0, theta ** (2 * i + 3) / radius) for i in range(4)], axis=-1)
    by_parameters = np.stack((x[..., None] * powers, y[..., None] * powers), axis=-2)
    return by_point, by_parameters


def _angle_polynomial(parameters: Array, t2: Array) -> Array:
    k1, k2, k3, k4 = (parameters[..., i] for i in range(4))
    return 1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))


@dataclass(frozen=True)
class Lens:
    """A camera model with its distortion parameters; the pinhole by default.

    Raises:
        InputError: If the number of parameters is not the model's, or one is not finite.
    """

    model: LensModel = "PINHOLE"
    parameters: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        names = PARAMETERS.get(self.model)
        if names is None:
            raise InputError(f"camera model {self.model!r} is not one of {', '.join(PARAMETERS)}")
        if len(self.parameters) != len(names):
            raise InputError(
                f"camera model {self.model} has the distortion parameters {', '.join(names) or '(none)'}, "
                f"got {len(self.parameters)} numbers"
            )
        if not np.isfinite(self.parameters).all():
            raise InputError(f"camera model {self.model}: a distortion parameter is not finite")

    @classmethod
    def of(cls, model: LensModel, padded: FloatArray) -> Lens:
        """Return the model with the first of four parameters, of which the rest must be those it holds at zero."""
        return cls(model, tuple(float(v) for v in padded[: len(PARAMETERS[model])]))

    @property
    def is_pinhole(self) -> bool:
        """Whether real and ideal pixels are the same."""
        return self.model == "PINHOLE" or (self.model != "OPENCV_FISHEYE" and not any(self.parameters))

    @property
    def is_fisheye(self) -> bool:
        """Whether it belongs to the fisheye family."""
        return self.model == "OPENCV_FISHEYE"

    @property
    def padded(self) -> FloatArray:
        """The four parameters (4,) of its family."""
        out = np.zeros(4)
        out[: len(self.parameters)] = self.parameters
        return out

    def real_pixels(self, intrinsics: FloatArray, ideal: FloatArray) -> FloatArray:
        """Return where the image shows what a pinhole with intrinsics (4,) or (..., 4) shows at pixels (..., 2)."""
        if self.is_pinhole:
            return ideal
        focal, center = intrinsics[..., :2], intrinsics[..., 2:]
        return self._bent((ideal - center) / focal) * focal + center

    def ideal_pixels(self, intrinsics: FloatArray, real: FloatArray) -> FloatArray:
        """Return where a pinhole with (4,) intrinsics shows what the image shows at pixels (..., 2).

        NaN stays NaN, and is the answer for pixels that no direction in front of the camera reaches.
        """
        if self.is_pinhole:
            return real
        target = (np.asarray(real, dtype=np.float64) - intrinsics[2:]) / intrinsics[:2]
        flat = target.reshape(-1, 2)
        out = self._straight_fisheye(flat) if self.is_fisheye else self._straight(flat)
        return out.reshape(target.shape) * intrinsics[:2] + intrinsics[2:]

    def magnification(self, intrinsics: FloatArray, ideal: FloatArray) -> FloatArray:
        """Return the area of a real pixel over that of its ideal pixel, (...); below 1 where the lens squeezes."""
        if self.is_pinhole:
            return np.ones(ideal.shape[:-1])
        xy = (ideal - intrinsics[2:]) / intrinsics[:2]
        if self.is_fisheye:
            by_point, _ = fisheye_derivatives(self.padded, np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1))
            by_point = by_point[..., :2]
        else:
            by_point, _ = distort_derivatives(self.padded, xy)
        return np.asarray(np.abs(np.linalg.det(by_point)))

    def displacement(self, intrinsics: FloatArray, size: tuple[int, int]) -> float:
        """Return how far, in px, the lens moves a pixel of an image of ``size`` (height, width) at most.

        Infinite where a pixel of the image is reached by no direction in front of the camera.
        """
        height, width = size
        u, v = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25))
        real = np.stack([u, v], axis=-1)
        moved = np.linalg.norm(self.ideal_pixels(intrinsics, real) - real, axis=-1)
        return float(moved.max()) if np.isfinite(moved).all() else float("inf")

    def _bent(self, xy: FloatArray) -> FloatArray:
        if self.is_fisheye:
            point = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
            return np.asarray(fisheye(self.padded, point))
        return np.asarray(distort(self.padded, xy))

    def _straight(self, target: FloatArray) -> FloatArray:
        """Invert the polynomial model by Newton's method from the undistorted point."""
        xy = target.copy()
        moving: BoolArray = np.asarray(np.isfinite(target).all(axis=1))
        for _ in range(_ITERATIONS):
            rows = np.flatnonzero(moving)
            if not len(rows):
                break
            error = np.asarray(distort(self.padded, xy[rows])) - target[rows]
            by_point, _ = distort_derivatives(self.padded, xy[rows])
            # Past the fold, where the image of a growing radius turns back, there is no inverse.
            folded = np.linalg.det(by_point) <= 1e-3
            xy[rows[folded]], by_point[folded] = np.nan, np.eye(2)
            step = np.linalg.solve(by_point, error[..., None])[..., 0]
            xy[rows] -= step
            moving[rows] = ~folded & (np.abs(step).max(axis=1) > 1e-12)
        xy[moving | ~np.isfinite(target).all(axis=1)] = np.nan
        return xy

    def _straight_fisheye(self, target: FloatArray) -> FloatArray:
        """Invert the fisheye: Newton's method on the angle."""
        bent = np.linalg.norm(target, axis=1)
        theta = np.minimum(bent, 1.5)
        with np.errstate(invalid="ignore"):
            for _ in range(_ITERATIONS):
                t2 = theta * theta
                slope = 1.0 + sum((2 * i + 3) * self.padded[i] * t2 ** (i + 1) for i in range(4))
                step = (theta * _angle_polynomial(self.padded, t2) - bent) / np.where(slope > 1e-3, slope, np.nan)
                theta = theta - step
            known = (np.abs(step) < 1e-9) & (theta >= 0.0) & (theta < 0.5 * np.pi - 1e-3)
            small = bent < 1e-9
            scale = np.where(small, 1.0, np.tan(theta) / np.where(small, 1.0, bent))
        return np.where((known | small)[:, None], target * scale[:, None], np.nan)


PINHOLE = Lens()
"""No distortion."""
