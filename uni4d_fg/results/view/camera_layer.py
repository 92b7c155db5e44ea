"""Cameras as frusta, the current one with its image, and the axes of rigid objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.results.colors import CURRENT_ORANGE
from uni4d_fg.results.pictures.figure import thumbnail
from uni4d_fg.results.run import Run
from uni4d_fg.results.view.coloring import Coloring
from uni4d_fg.results.view.content import Limits
from uni4d_fg.results.view.nodes import add_group, quaternion, vertical_fov
from uni4d_fg.results.view.shown import Shown

_CURRENT_WIDTH = 3.0
_OTHER_WIDTH = 1.0
_OTHER_SIZE = 0.35
_CURRENT_IMAGE_FACTOR = 2
_TURN_RAD = np.radians(10.0)


def spaced_cameras(world_T_cam: FloatArray, spacing: float, limit: int) -> list[int]:
    """Choose frames whose cameras do not stand in each other's way.

    Args:
        world_T_cam: (T, 4, 4) camera to world.
        spacing: Distance from the last chosen camera that makes another worth showing; a turn by 10 degrees does too.
        limit: Most cameras chosen.

    Returns:
        Frames, ascending, beginning with 0.
    """
    chosen = [0]
    for frame in range(1, len(world_T_cam)):
        last, here = world_T_cam[chosen[-1]], world_T_cam[frame]
        turned = np.arccos(np.clip(last[:3, 2] @ here[:3, 2], -1.0, 1.0)) > _TURN_RAD
        if turned or np.linalg.norm(here[:3, 3] - last[:3, 3]) > spacing:
            chosen.append(frame)
    return chosen[:: max(1, -(-len(chosen) // limit))]


@dataclass
class CameraLayer:
    """All cameras as small frusta, thinned in long videos, and the current one with its image."""

    server: Any
    run: Run
    limits: Limits
    size: float
    _group: Any = None
    _nodes: dict[int, Any] = field(default_factory=dict)
    _current: dict[int, Any] = field(default_factory=dict)
    _visible: int | None = None

    def build(self, coloring: Coloring, shown: Shown) -> None:
        """Make the frusta of all cameras, with small images on some, and the path between them."""
        self._group = add_group(self.server, "/cameras", visible=shown.cameras)
        chosen = spaced_cameras(self.run.reconstruction.world_T_cam, 0.5 * self.size, self.limits.cameras)
        for frame in chosen:
            self._nodes[frame] = self._frustum(
                f"/cameras/all/{frame:05d}", frame, None, _OTHER_SIZE * self.size, _OTHER_WIDTH
            )
        centers = self.run.reconstruction.world_T_cam[:, :3, 3].astype(np.float32)
        if len(centers) > 1:
            steps = np.stack((centers[:-1], centers[1:]), axis=1)
            self.server.scene.add_line_segments(
                "/cameras/path", steps, np.full_like(steps, 150).astype(np.uint8), thickness=1.5,
                thickness_units="screen",
            )  # fmt: skip
        self.color(coloring)

    def color(self, coloring: Coloring) -> None:
        """Give the frusta their colors."""
        colors = coloring.cameras()
        for frame, node in self._nodes.items():
            node.color = tuple(colors[frame].tolist())

    def load(self, frame: int, shown: Shown) -> None:
        """Send the frustum of the camera of one frame with its image, hidden; once."""
        if frame in self._current:
            return
        every = max(1, -(-self.run.num_frames // self.limits.current_images))
        image = self._image(frame) if shown.images and frame % every == 0 else None
        node = self._frustum(f"/cameras/current/{frame:05d}", frame, image, self.size, _CURRENT_WIDTH, visible=False)
        node.color = CURRENT_ORANGE
        self._current[frame] = node

    def show(self, shown: Shown) -> None:
        """Show the camera of one frame, if it is loaded."""
        self._group.visible = shown.cameras
        if self._visible == shown.frame:
            return
        if self._visible is not None:
            self._current[self._visible].visible = False
        self._visible = None
        if shown.frame in self._current:
            self._current[shown.frame].visible = True
            self._visible = shown.frame

    def drop_images(self) -> None:
        """Take the current cameras out of the scene, so that they are sent anew with or without images."""
        for node in self._current.values():
            node.remove()
        self._current, self._visible = {}, None

    def _frustum(
        self, name: str, frame: int, image: ImageArray | None, size: float, width: float, *, visible: bool = True
    ) -> Any:
        reconstruction = self.run.reconstruction
        height, image_width = reconstruction.image_size
        pose = reconstruction.world_T_cam[frame]
        return self.server.scene.add_camera_frustum(
            name, fov=vertical_fov(reconstruction, frame), aspect=image_width / height, scale=size, thickness=width,
            thickness_units="screen", image=image, format="jpeg", jpeg_quality=75, wxyz=quaternion(pose),
            position=pose[:3, 3], cast_shadow=False, receive_shadow=False, visible=visible,
        )  # fmt: skip

    def _image(self, frame: int) -> ImageArray | None:
        width = _CURRENT_IMAGE_FACTOR * self.limits.image_width
        return None if self.run.sequence is None else thumbnail(self.run.sequence.images[frame], width)


@dataclass
class ObjectLayer:
    """The axes of rigid objects."""

    server: Any
    run: Run
    size: float
    _nodes: dict[int, Any] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of rigid objects."""
        instance = self.run.reconstruction.object_instance
        return 0 if instance is None else len(instance)

    def draw(self, shown: Shown) -> None:
        """Draw the axes of the objects that have a pose in the current frame."""
        reconstruction = self.run.reconstruction
        instance, poses = reconstruction.object_instance, reconstruction.object_world_T_object
        if instance is None or poses is None:
            return
        for name, pose in zip(instance.tolist(), poses[:, shown.frame], strict=True):
            known = bool(np.isfinite(pose).all())
            here = pose if known else np.eye(4)
            if name not in self._nodes:
                self._nodes[name] = self.server.scene.add_frame(
                    f"/moving/object_{name}", axes_length=self.size, axes_radius=0.03 * self.size
                )
            node = self._nodes[name]
            node.wxyz, node.position = quaternion(here), here[:3, 3]
            node.visible = shown.objects and known
