"""Self-consistency of depth: does what frame t sees lie where frame t + n has it? No truth is needed.

After SC of Khan et al., "Temporally consistent online depth estimation using point-based fusion", CVPR 2023, as the
paper of Uni4D reports it: mean relative difference, and shares below 1 % and 5 %, in static regions.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.geometry.lens import PINHOLE, Lens


@dataclass(frozen=True)
class ConsistencyScore:
    """One video."""

    protocol: str
    mean: float
    """SC: mean of |reprojected / own - 1|."""
    below_1: float
    """Share below 0.01."""
    below_5: float
    """Share below 0.05."""
    pixels: int

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


def score_consistency(
    depths: FrameSource[Float32Array],
    masks: FrameSource[Int32Array],
    world_T_cam: FloatArray,
    intrinsics: FloatArray,
    *,
    distance: int = 1,
    occlusion: float = 0.25,
    lens: Lens = PINHOLE,
    log_scale: FloatArray | None = None,
) -> ConsistencyScore | None:
    """Score depth against itself.

    Every static pixel of frame t is lifted and projected into frame t + distance, where its depth is compared with
    that of the nearest pixel, if that is static too. What lies behind by more than ``occlusion`` is hidden there, and
    left out.

    Args:
        depths: T maps (H, W), meters or any unit.
        masks: T label maps (H, W), 0 static.
        world_T_cam: (T, 4, 4) of the same world.
        intrinsics: (4,), or (T, 4) where the camera zooms, px of images of H x W.
        distance: Between the two frames.
        occlusion: Relative difference above which a point is taken to be hidden.
        lens: Distortion of the camera.
        log_scale: (T,) logarithm of a factor on each frame's depth.

    Returns:
        The score; None if no pixel could be compared.

    Raises:
        InputError: If maps have different sizes.
    """
    errors = []
    factor = np.ones(len(depths)) if log_scale is None else np.exp(log_scale)
    cameras = np.broadcast_to(intrinsics, (len(depths), 4))
    for frame in range(len(depths) - distance):
        other = frame + distance
        depth, label = factor[frame] * np.asarray(depths[frame], np.float64), masks[frame]
        seen, seen_label = factor[other] * np.asarray(depths[other], np.float64), masks[other]
        if not depth.shape == seen.shape == label.shape == seen_label.shape:
            raise InputError(
                f"depth of frames {frame} and {other} has sizes {depth.shape} and {seen.shape}, masks "
                f"{label.shape} and {seen_label.shape}; give maps of one size"
            )
        height, width = depth.shape
        with np.errstate(invalid="ignore"):
            v, u = np.nonzero(np.isfinite(depth) & (depth > 0) & (label == 0))
        if not len(u):
            continue
        ideal = lens.ideal_pixels(cameras[frame], np.stack((u, v), axis=1).astype(np.float64))
        points = camera_to_world(world_T_cam[frame], unproject(cameras[frame], ideal, depth[v, u]))
        there = world_to_camera(world_T_cam[other], points)
        front = there[:, 2] > 1e-6
        there = there[front]
        uv = project(cameras[other], there)
        if lens != PINHOLE:
            uv = lens.real_pixels(cameras[other], uv)
        inside = np.isfinite(uv).all(axis=1) & (np.abs(uv) < 1e9).all(axis=1)
        pixel, z = np.rint(uv[inside]).astype(np.int64), there[inside, 2]
        inside = (pixel[:, 0] >= 0) & (pixel[:, 0] < width) & (pixel[:, 1] >= 0) & (pixel[:, 1] < height)
        pixel, z = pixel[inside], z[inside]
        own = seen[pixel[:, 1], pixel[:, 0]]
        with np.errstate(invalid="ignore", divide="ignore"):
            relative = z / own - 1.0
            good = np.isfinite(own) & (own > 0) & (seen_label[pixel[:, 1], pixel[:, 0]] == 0) & (relative <= occlusion)
        errors.append(np.abs(relative[good]))
    every = np.concatenate(errors) if errors else np.zeros(0)
    if not len(every):
        return None
    text = f"frames {distance} apart, nearest pixel, static, points more than {100 * occlusion:g} % behind left out"
    return ConsistencyScore(
        text, float(every.mean()), float((every < 0.01).mean()), float((every < 0.05).mean()), len(every)
    )
