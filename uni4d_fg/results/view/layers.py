"""The nodes of the 3D scene in the browser: what does not change with time, and what does."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.results.colors import CURRENT_ORANGE
from uni4d_fg.results.pictures.figure import thumbnail
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.results.view.coloring import Coloring
from uni4d_fg.results.view.content import Limits, RunClouds
from uni4d_fg.results.view.trails import trail_segments
from uni4d_fg.slam.reconstruction import Reconstruction

_CURRENT_WIDTH = 4.0
_OTHER_WIDTH = 1.5
_OTHER_SIZE = 0.4
_CURRENT_IMAGE_FACTOR = 3
_TURN_RAD = np.radians(10.0)


@dataclass(frozen=True)
class Shown:
    """What the panel asks for."""

    frame: int = 0
    static: bool = True
    landmarks: bool = False
    moving: bool = True
    trajectories: bool = True
    objects: bool = True
    """Axes of rigid objects."""
    cameras: bool = True
    images: bool = True
    history: int = 0
    """Dynamic clouds of this many earlier frames are shown as well."""
    trail: int = 10
    """Length of the trails, frames."""
    point_size: float = 1.0
    """Factor on the size that suits the scene."""


def vertical_fov(reconstruction: Reconstruction) -> float:
    """Return the vertical field of view of the camera, radians."""
    return 2.0 * float(np.arctan(0.5 * reconstruction.image_size[0] / reconstruction.intrinsics[1]))


def quaternion(world_T_cam: FloatArray) -> FloatArray:
    """Return the orientation of a pose (4, 4) as a quaternion w, x, y, z."""
    x, y, z, w = Rotation.from_matrix(world_T_cam[:3, :3]).as_quat().tolist()
    return np.array([w, x, y, z])


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
class PointLayers:
    """Static cloud, landmarks, and the clouds of what moves."""

    server: Any
    run: Run
    clouds: RunClouds
    static: ColoredPoints
    landmark_rows: IntArray
    base_size: float
    _history_nodes: dict[int, Any] = field(default_factory=dict)

    def draw_still(self, coloring: Coloring, shown: Shown) -> None:
        """Draw what does not change from frame to frame."""
        size = self.base_size * shown.point_size
        landmarks = self.run.reconstruction.landmarks[self.landmark_rows]
        colors = coloring.landmarks()[self.landmark_rows]
        self._points("/static/cloud", self.static.points, coloring.cloud(self.static), size, shown.static)
        self._points("/static/landmarks", landmarks.astype(np.float32), colors, 2.0 * size, shown.landmarks)

    def draw_frame(self, coloring: Coloring, shown: Shown) -> None:
        """Draw the clouds of the current frame and of those before it."""
        size = self.base_size * shown.point_size
        for back in range(max(shown.history + 1, len(self._history_nodes))):
            frame = shown.frame - back
            wanted = shown.moving and back <= shown.history and frame >= 0
            name = f"/moving/cloud_{back}"
            if not wanted:
                if back in self._history_nodes:
                    self._history_nodes[back].visible = False
                continue
            cloud = self.clouds.dynamic(frame)
            fade = 1.0 - 0.7 * back / (shown.history + 1)
            colors = np.rint(fade * coloring.cloud(cloud)).astype(np.uint8)
            self._history_nodes[back] = self._points(name, cloud.points, colors, size, True)

    def _points(self, name: str, points: Float32Array, colors: ImageArray, size: float, visible: bool) -> Any:
        if not len(points):
            points, colors, visible = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), False
        return self.server.scene.add_point_cloud(
            name, points, colors, point_size=size, point_shape="circle", precision="float32", visible=visible,
            point_shading="flat",
        )  # fmt: skip


@dataclass
class TrajectoryLayer:
    """Dynamic points and their trails."""

    server: Any
    run: Run
    rows: IntArray
    base_size: float

    def draw(self, coloring: Coloring, shown: Shown) -> None:
        """Draw the points of the current frame and where they come from."""
        points = self.run.reconstruction.dynamic_points[self.rows]
        colors = coloring.trajectories(shown.frame)[self.rows]
        here = points[:, shown.frame]
        known = np.isfinite(here).all(axis=1)
        ends, end_colors = trail_segments(points, colors, shown.frame, shown.trail)
        visible = shown.trajectories
        heads, head_colors = here[known].astype(np.float32), colors[known]
        if not len(heads):
            heads, head_colors = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)
        self.server.scene.add_point_cloud(
            "/moving/points", heads, head_colors, point_size=2.5 * self.base_size * shown.point_size,
            point_shape="circle", precision="float32", visible=visible and bool(known.any()), point_shading="flat",
        )  # fmt: skip
        if not len(ends):
            ends, end_colors, visible = np.zeros((1, 2, 3), np.float32), np.zeros((1, 2, 3), np.uint8), False
        self.server.scene.add_line_segments(
            "/moving/trails", ends, end_colors, thickness=2.0, thickness_units="screen", visible=visible
        )


@dataclass
class CameraLayer:
    """All cameras as frusta, thinned in long videos, and the current one, larger, with its image."""

    server: Any
    run: Run
    limits: Limits
    size: float
    _nodes: dict[int, Any] = field(default_factory=dict)
    _path: Any = None

    def build(self, coloring: Coloring) -> None:
        """Make the frusta of all cameras, with small images on some, and the path between them."""
        chosen = spaced_cameras(self.run.reconstruction.world_T_cam, 0.25 * self.size, self.limits.cameras)
        with_image = set(chosen[:: max(1, -(-len(chosen) // self.limits.camera_images))])
        for frame in chosen:
            image = self._image(frame, self.limits.image_width) if frame in with_image else None
            size = _OTHER_SIZE * self.size
            self._nodes[frame] = self._frustum(f"/cameras/{frame:05d}", frame, image, size, _OTHER_WIDTH)
        centers = self.run.reconstruction.world_T_cam[:, :3, 3].astype(np.float32)
        if len(centers) > 1:
            steps = np.stack((centers[:-1], centers[1:]), axis=1)
            self._path = self.server.scene.add_line_segments(
                "/camera_path", steps, np.full_like(steps, 150).astype(np.uint8), thickness=1.5,
                thickness_units="screen",
            )  # fmt: skip
        self.color(coloring)

    def color(self, coloring: Coloring) -> None:
        """Give the frusta their colors."""
        colors = coloring.cameras()
        for frame, node in self._nodes.items():
            node.color = tuple(colors[frame].tolist())

    def draw_frame(self, shown: Shown) -> None:
        """Highlight the current camera."""
        width = _CURRENT_IMAGE_FACTOR * self.limits.image_width
        image = self._image(shown.frame, width) if shown.images else None
        node = self._frustum("/current_camera", shown.frame, image, self.size, _CURRENT_WIDTH)
        node.color = CURRENT_ORANGE
        node.visible = shown.cameras
        if self._path is not None:
            self._path.visible = shown.cameras
        for frame, other in self._nodes.items():
            other.visible = shown.cameras and frame != shown.frame

    def _frustum(self, name: str, frame: int, image: ImageArray | None, size: float, width: float) -> Any:
        reconstruction = self.run.reconstruction
        height, image_width = reconstruction.image_size
        pose = reconstruction.world_T_cam[frame]
        return self.server.scene.add_camera_frustum(
            name, fov=vertical_fov(reconstruction), aspect=image_width / height, scale=size, thickness=width,
            thickness_units="screen", image=image, format="jpeg", jpeg_quality=80, wxyz=quaternion(pose),
            position=pose[:3, 3], cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _image(self, frame: int, width: int) -> ImageArray | None:
        return None if self.run.sequence is None else thumbnail(self.run.sequence.images[frame], width)


@dataclass
class ObjectLayer:
    """The axes of rigid objects."""

    server: Any
    run: Run
    size: float

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
            self.server.scene.add_frame(
                f"/moving/object_{name}", axes_length=self.size, axes_radius=0.03 * self.size,
                wxyz=quaternion(here), position=here[:3, 3], visible=shown.objects and known,
            )  # fmt: skip
