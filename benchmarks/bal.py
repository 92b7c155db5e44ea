r"""Bundle adjustment problems in the format of "Bundle Adjustment in the Large", in this package's conventions.

A file of that format (plain text, .bz2 or .gz) has one camera model per image,

    P = R X + t,   p = -(P_x, P_y) / P_z,   uv = f (1 + k1 |p|^2 + k2 |p|^4) p,

with a Rodrigues vector for R, the camera looking along -z, y up, and pixels from the center of the image. Ours is one
pinhole camera without distortion for all images, so that a file becomes

- poses ``world_T_cam`` with OpenCV's axes (x right, y down, z forward);
- observations without distortion: each is divided by its camera's own focal length, the radial polynomial of that
  camera is inverted by a bracketed Newton iteration on its branch through 0, and the result is multiplied by the
  median focal length, which all cameras share from then on. Pixels of a camera are thereby scaled by the ratio of
  the median to its own focal length, and so is their weight;
- a world scaled to a median depth of 10, because files have units of their own and the near plane has not.

Left out are observations that no radius on that branch explains, observations of points behind the camera at the
file's own poses, and then, repeatedly, points seen less than twice and cameras that see less than four points.
:attr:`BalProblem.dropped` counts them. Distortion is not estimated: the file's own k1 and k2 are taken for true.

Source: Agarwal et al. 2010, "Bundle adjustment in the large".
"""

from __future__ import annotations

import bz2
import gzip
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import NEAR_PLANE

MEDIAN_DEPTH = 10.0
MIN_VIEWS = 2
MIN_POINTS = 4
_NEWTON_STEPS = 100
_CONVERGED = 1e-12


@dataclass(frozen=True)
class BalProblem:
    """One file, converted."""

    name: str
    world_T_cam: FloatArray
    """(T, 4, 4), OpenCV axes."""
    intrinsics: FloatArray
    """(4,): the median focal length twice, and the principal point at 0."""
    points: FloatArray
    """(N, 3)."""
    camera: IntArray
    """(M,) camera of every observation."""
    point: IntArray
    """(M,) point of every observation."""
    uv: FloatArray
    """(M, 2) pixels of the shared camera, y down."""
    dropped: dict[str, int]
    """Number of observations left out, by reason."""

    def describe(self) -> str:
        """Return sizes and what was left out, one line."""
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.dropped.items())
        return (
            f"{self.name}: {len(self.world_T_cam)} cameras, {len(self.points)} points, {len(self.uv)} observations, "
            f"shared focal length {self.intrinsics[0]:.1f} px; observations left out: {reasons}"
        )


def read_bal(path: Path) -> BalProblem:
    """Read and convert a file.

    Raises:
        InputError: If the file cannot be read or is malformed, or if nothing of it is left to solve.
    """
    camera, point, uv, cameras, points = _parse(path)
    focal, k1, k2 = cameras[:, 6], cameras[:, 7], cameras[:, 8]
    cam_T_world = np.tile(np.eye(4), (len(cameras), 1, 1))
    flip = np.array([1.0, -1.0, -1.0])
    cam_T_world[:, :3, :3] = flip[:, None] * se3.so3_exp(cameras[:, :3])
    cam_T_world[:, :3, 3] = flip * cameras[:, 3:6]

    depth = np.einsum("mj,mj->m", cam_T_world[camera, 2, :3], points[point]) + cam_T_world[camera, 2, 3]
    if not (depth > 0).any():
        raise InputError(f"{path}: every point is behind its cameras; check that cameras look along -z")
    scale = MEDIAN_DEPTH / float(np.median(depth[depth > 0]))
    cam_T_world[:, :3, 3] *= scale
    in_front = scale * depth > NEAR_PLANE
    rays, inverted = undistort(uv / focal[camera, None], k1[camera], k2[camera])

    kept = _tied(in_front & inverted, camera, point)
    if not kept.any():
        raise InputError(f"{path}: no points seen by {MIN_VIEWS} cameras are left after the others were dropped")
    cameras_kept, camera_row = np.unique(camera[kept], return_inverse=True)
    points_kept, point_row = np.unique(point[kept], return_inverse=True)
    shared = float(np.median(focal))
    return BalProblem(
        path.name,
        se3.inverse(cam_T_world[cameras_kept]),
        np.array([shared, shared, 0.0, 0.0]),
        scale * points[points_kept],
        camera_row.astype(np.int64),
        point_row.astype(np.int64),
        shared * rays[kept] * (1.0, -1.0),
        {
            "behind the camera": int((~in_front).sum()),
            "without an undistorted position": int((in_front & ~inverted).sum()),
            "of points or cameras with too few others": int((in_front & inverted & ~kept).sum()),
        },
    )


def undistort(distorted: FloatArray, k1: FloatArray, k2: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Invert ``r (1 + k1 r^2 + k2 r^4)`` on its rising branch through 0.

    Args:
        distorted: (n, 2) distorted positions, focal length 1.
        k1: (n,).
        k2: (n,).

    Returns:
        Undistorted positions (n, 2), and whether each is one (n,): not beyond the polynomial's first maximum, and
        converged.
    """
    goal = np.linalg.norm(distorted, axis=1)

    def polynomial(radius: FloatArray) -> FloatArray:
        squared = radius**2
        result: FloatArray = radius * (1.0 + squared * (k1 + squared * k2))
        return result

    turn = _first_maximum(k1, k2)
    bounded = np.isfinite(turn)
    high = np.where(bounded, turn, np.maximum(goal, 1.0))
    # Without a maximum the polynomial rises for ever: some power of two lies above.
    for _ in range(60):
        short = ~bounded & (polynomial(high) < goal)
        if not short.any():
            break
        high[short] *= 2.0
    reachable = goal <= polynomial(high)
    low, radius = np.zeros_like(goal), np.minimum(goal, high)
    for _ in range(_NEWTON_STEPS):
        error = polynomial(radius) - goal
        if (np.abs(error) <= 0.01 * _CONVERGED * (1.0 + goal))[reachable].all():
            break
        low, high = np.where(error < 0, radius, low), np.where(error > 0, radius, high)
        squared = radius**2
        slope = 1.0 + squared * (3.0 * k1 + squared * 5.0 * k2)
        newton = radius - error / np.where(slope > 0, slope, np.inf)
        radius = np.where((newton > low) & (newton < high), newton, 0.5 * (low + high))
    good = reachable & (np.abs(polynomial(radius) - goal) <= _CONVERGED * (1.0 + goal))
    factor = np.where(good & (goal > 0), radius / np.where(goal > 0, goal, 1.0), 1.0)
    return distorted * factor[:, None], good


def _first_maximum(k1: FloatArray, k2: FloatArray) -> FloatArray:
    """Return the radius (n,) at which the polynomial first stops rising; infinity if it never does."""
    discriminant = 9.0 * k1**2 - 20.0 * k2
    root = np.sqrt(np.maximum(discriminant, 0.0))
    first = np.full(len(k1), np.inf)
    for denominator in (-3.0 * k1 + root, -3.0 * k1 - root):
        positive = (denominator > 0) & (discriminant >= 0)
        first = np.minimum(first, np.where(positive, 2.0 / np.where(positive, denominator, 1.0), np.inf))
    return np.sqrt(first)


def _tied(kept: BoolArray, camera: IntArray, point: IntArray) -> BoolArray:
    """Return the observations (M,) whose points and cameras have enough of them."""
    kept = kept.copy()
    while True:
        views, seen = np.bincount(point[kept], minlength=1), np.bincount(camera[kept], minlength=1)
        rows = np.flatnonzero(kept)
        loose = (views[point[rows]] < MIN_VIEWS) | (seen[camera[rows]] < MIN_POINTS)
        if not loose.any():
            return kept
        kept[rows[loose]] = False


def _parse(path: Path) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Return cameras and points (M,) and pixels (M, 2) of the observations, cameras (T, 9), points (N, 3)."""
    header, _, body = _text(path).partition("\n")
    try:
        num_cameras, num_points, num_observations = (int(word) for word in header.split())
        if min(num_cameras, num_points, num_observations) < 1:
            raise ValueError
    except ValueError:
        raise InputError(
            f"{path}: the first line must hold the numbers of cameras, points and observations, not {header[:60]!r}"
        ) from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's warning of a word that is no number
            numbers = np.fromstring(body, dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        raise InputError(f"{path}: holds something that is not a number after its first line") from None
    parts = (4 * num_observations, 9 * num_cameras, 3 * num_points)
    if len(numbers) != sum(parts):
        raise InputError(
            f"{path}: {num_cameras} cameras, {num_points} points and {num_observations} observations are "
            f"{sum(parts)} numbers, but {len(numbers)} follow the first line; is the file complete?"
        )
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: holds a number that is not finite")
    observations = numbers[: parts[0]].reshape(-1, 4)
    cameras = numbers[parts[0] : parts[0] + parts[1]].reshape(-1, 9)
    points = numbers[parts[0] + parts[1] :].reshape(-1, 3)
    for column, (what, count) in enumerate((("camera", num_cameras), ("point", num_points))):
        index = observations[:, column]
        wrong = np.flatnonzero((index < 0) | (index >= count) | (index != np.floor(index)))
        if len(wrong):
            raise InputError(f"{path}: observation {wrong[0]} is of {what} {index[wrong[0]]:g}; there are {count}")
    flat = np.flatnonzero(cameras[:, 6] <= 0)
    if len(flat):
        raise InputError(f"{path}: camera {flat[0]} has the focal length {cameras[flat[0], 6]:g}; it must be positive")
    camera, point = observations[:, 0].astype(np.int64), observations[:, 1].astype(np.int64)
    return camera, point, observations[:, 2:], cameras, points


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
        if path.suffix == ".bz2":
            data = bz2.decompress(data)
        elif path.suffix == ".gz":
            data = gzip.decompress(data)
        return data.decode("ascii")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not text; compressed files must end in .bz2 or .gz") from None
    except (OSError, EOFError, ValueError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or str(error) or "damaged"
        raise InputError(f"{path}: cannot be read: {reason}") from error
