"""The static scene as one colored surface, from the depth of all frames.

Every frame's depth is averaged into a truncated signed distance field, in which what stands before a surface in one
frame and was seen through in others goes away; the surface is its zero (Curless and Levoy, "A volumetric method for
building complex models from range images", 1996; Open3D's grid of voxel blocks).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import Float32Array, evenly_spread
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.geometry.camera import intrinsics_matrix
from uni4d_fg.geometry.se3 import inverse
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
_BLOCK_VOXELS, _BLOCKS = 16, 10_000
"""Of the volume's blocks: side, voxels, and the number that there is room for at first."""
_LEAST_FRAMES = 3
"""A surface was seen by this many frames."""
_LOOKED_AT = 12
"""Frames whose depth says how large the scene is."""


@dataclass(frozen=True)
class Volume:
    """Size of a distance field."""

    voxel_m: float
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
        return cls(voxel_m, farthest)


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
    core, image = open3d.core, open3d.t.geometry.Image
    field = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (core.float32,) * 3, ((1), (1), (3)),
        volume.voxel_m, _BLOCK_VOXELS, _BLOCKS, core.Device("CPU:0"),
    )  # fmt: skip
    for frame, pose in enumerate(result.world_T_cam):
        depth, mask = depths[frame], sequence.masks[frame]
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(depth) & (depth > 0.0) & (depth < volume.farthest_m)
        usable &= ~dilate(mask > 0, _BAND_PX) & ~depth_edges(depth, config.edge_relative_gradient)
        if usable.any():
            seen = image(core.Tensor(np.where(usable, depth, np.float32(0.0))))
            colors = image(core.Tensor(sequence.images[frame].astype(np.float32) / np.float32(255.0)))
            camera = core.Tensor(intrinsics_matrix(result.frame_intrinsics[frame]))
            pose_of_world = core.Tensor(inverse(pose))
            limits = (1.0, volume.farthest_m, _TRUNCATED_AT)  # units per meter, m, voxels
            blocks = field.compute_unique_block_coordinates(seen, camera, pose_of_world, *limits)
            field.integrate(blocks, seen, colors, camera, pose_of_world, *limits)
        done(frame + 1)
    mesh = field.extract_triangle_mesh(float(min(_LEAST_FRAMES, len(result.world_T_cam)))).to_legacy()
    mesh.compute_vertex_normals()
    return mesh
