"""Nodes of viser's scene: clouds in chunks, groups, poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray
from uni4d_fg.optional import import_viser
from uni4d_fg.results.chunks import Chunk, chunks_of
from uni4d_fg.slam.reconstruction import Reconstruction


def vertical_fov(reconstruction: Reconstruction, frame: int) -> float:
    """Return the vertical field of view of a frame's camera, radians."""
    return 2.0 * float(np.arctan(0.5 * reconstruction.image_size[0] / reconstruction.frame_intrinsics[frame, 1]))


def quaternion(world_T_cam: FloatArray) -> FloatArray:
    """Return the orientation of a pose (4, 4) as a quaternion w, x, y, z."""
    wxyz: FloatArray = import_viser().transforms.SO3.from_matrix(world_T_cam[:3, :3]).wxyz
    return wxyz


def add_group(server: Any, name: str, *, visible: bool) -> Any:
    """Add a node without a picture of its own, which shows or hides everything below it."""
    return server.scene.add_frame(name, show_axes=False, visible=visible)


@dataclass
class CloudNode:
    """A cloud, as the chunks of it that are in the scene."""

    chunks: list[tuple[Chunk, Any]]

    def set_colors(self, colors: ImageArray) -> None:
        """Give every point of the cloud (N, 3) another color; positions are not sent again."""
        for chunk, handle in self.chunks:
            handle.colors = colors[chunk.rows]

    def set_size(self, factor: float) -> None:
        """Draw points larger or smaller than those that just touch."""
        for chunk, handle in self.chunks:
            handle.point_size = _radius_of_points(chunk, factor)

    def remove(self) -> None:
        """Take the cloud out of the scene."""
        for _, handle in self.chunks:
            handle.remove()


def add_cloud(
    server: Any, name: str, points: FloatArray | Float32Array, colors: ImageArray, factor: float = 1.0
) -> CloudNode:
    """Add a cloud below the node ``name``, in chunks with points of the size of their spacing."""
    return CloudNode(
        [
            (chunk, add_chunk(server, f"{name}/{number:04d}", chunk, colors[chunk.rows], factor))
            for number, chunk in enumerate(chunks_of(points))
        ]
    )


def add_chunk(server: Any, name: str, chunk: Chunk, colors: ImageArray, factor: float = 1.0) -> Any:
    """Add one chunk with its colors (N, 3); in half precision, which holds the chunk's own positions exactly."""
    return server.scene.add_point_cloud(
        name, chunk.points, colors, point_size=_radius_of_points(chunk, factor), point_shape="circle",
        precision="float16", scale=chunk.radius, position=chunk.center, point_shading="flat",
    )  # fmt: skip


def add_marks(server: Any, name: str, points: Float32Array, colors: ImageArray, diameter: float) -> Any:
    """Add a few points of one size, meters."""
    return server.scene.add_point_cloud(
        name, points, colors, point_size=0.5 * diameter, point_shape="circle", precision="float32",
        point_shading="flat",
    )  # fmt: skip


def _radius_of_points(chunk: Chunk, factor: float) -> float:
    # viser draws points with twice this size, and scales it with the node.
    return 0.5 * factor * chunk.diameter / chunk.radius
