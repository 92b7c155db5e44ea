"""The static scene as one colored surface, from the depth of all frames.

Every frame's depth is averaged into a truncated signed distance field, in which what stands before a surface in one
frame and was seen through in others goes away; the surface is its zero (Curless and Levoy, "A volumetric method for
building complex models from range images", 1996; Open3D's scalable volume).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, evenly_spread
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.optional import import_open3d
from uni4d_fg.results.fusion.clouds import depth_edges, dilate
from uni4d_fg.slam.reconstruction import Reconstruction

_BAND_PX = 5
"""Of what moves, this far around is left out as well."""
_VOXEL_PX = 2.0
"""Side of a voxel in footprints of a pixel at the median depth."""
_FINEST = 500.0
"""Voxels along the farthest depth that is used, at most: the volume's memory follows from it."""
_TRUNCATED_AT = 5.0
"""Distances are kept up to this many voxels."""
_FARTHEST_PERCENTILE = 98.0
"""Of depth; what is farther is left out, as its noise is larger than the volume is deep."""
_LOOKED_AT = 12
"""Frames whose depth says how large the scene is."""


@dataclass(frozen=True)
class Volume:
    """Size of a distance field."""

    voxel_m: float
    truncation_m: float
    """How far from a surface a distance is kept."""
    farthest_m: float
    """Depth up to which frames are used."""

    @classmethod
    def of(cls, depths: FrameSource[Float32Array], focal_px: float, voxel_m: float | None = None) -> Volume:
        """Choose a volume by the depth of a few frames.

        Args:
            depths: T maps (H, W), meters, NaN where missing.
            focal_px: Focal length.
            voxel_m: Side of a voxel, if it is given.
        """
        some = [depths[frame][::4, ::4] for frame in evenly_spread(len(depths), _LOOKED_AT).tolist()]
        with np.errstate(invalid="ignore"):
            values = np.concatenate([depth[np.isfinite(depth) & (depth > 0.0)] for depth in some])
        if len(values) == 0:
            raise OutputError("no frame has depth: there is no surface")
        usual, farthest = (float(v) for v in np.percentile(values, (50.0, _FARTHEST_PERCENTILE)))
        if voxel_m is None:
            voxel_m = max(_VOXEL_PX * usual / focal_px, farthest / _FINEST)
        return cls(voxel_m, _TRUNCATED_AT * voxel_m, farthest)


def static_mesh(
    sequence: Sequence,
    depths: FrameSource[Float32Array],
    result: Reconstruction,
    config: FusionConfig,
    volume: Volume,
    *,
    done: Callable[[int], None] = lambda frames: None,
) -> Any:
    """Return the surface of what does not move, with colors and normals towards the cameras.

    Args:
        sequence: Images without distortion, and masks.
        depths: T maps (H, W), meters, NaN where missing.
        result: Cameras, a pinhole's.
        config: Threshold of depth edges, where depth mixes two surfaces.
        volume: Size of the voxels.
        done: Told the number of frames that are in; may raise to end the work.

    Returns:
        An ``open3d.geometry.TriangleMesh`` in world coordinates, meters.

    Raises:
        InputError: If a frame cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    open3d = import_open3d()
    integration = open3d.pipelines.integration
    field = integration.ScalableTSDFVolume(volume.voxel_m, volume.truncation_m, integration.TSDFVolumeColorType.RGB8)
    height, width = result.image_size
    for frame, pose in enumerate(result.world_T_cam):
        depth, mask = depths[frame], sequence.masks[frame]
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(depth) & (depth > 0.0) & (depth < volume.farthest_m)
        usable &= ~dilate(mask > 0, _BAND_PX) & ~depth_edges(depth, config.edge_relative_gradient)
        seen = open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(np.ascontiguousarray(sequence.images[frame])),
            open3d.geometry.Image(np.where(usable, depth, np.float32(0.0))),
            depth_scale=1.0, depth_trunc=volume.farthest_m, convert_rgb_to_intensity=False,
        )  # fmt: skip
        camera = open3d.camera.PinholeCameraIntrinsic(width, height, *result.frame_intrinsics[frame].tolist())
        field.integrate(seen, camera, _inverse(pose))
        done(frame + 1)
    mesh = field.extract_triangle_mesh()
    mesh.compute_vertex_normals()
    return mesh


def _inverse(pose: FloatArray) -> FloatArray:
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out
