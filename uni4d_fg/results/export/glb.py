"""glTF (``scene.glb``): the camera and what moves as one animation, for Blender, web viewers and game engines.

glTF has y up and cameras that look along -z: a node above all turns the world by half a turn about x. The animation
runs in seconds of the video. Every frame's cloud is a node that is scaled to nothing but in its own frame (stepped
keys), which all importers know; the tracked points are one set of points with a morph target for every frame, so that a
point keeps its number. Colors are linear, as glTF asks for, and unlit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray
from uni4d_fg.frontend.trajectory_files import continuous_quaternions
from uni4d_fg.optional import import_pygltflib
from uni4d_fg.results.export.clouds import moving_cloud, static_cloud
from uni4d_fg.results.export.gltf_buffer import GltfBuffer, as_float32, linear_colors
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.results.export.nerfstudio import OPENGL_FROM_OPENCV
from uni4d_fg.results.run import Run
from uni4d_fg.slam.reconstruction import Reconstruction

HALF_TURN_ABOUT_X = [1.0, 0.0, 0.0, 0.0]
"""Quaternion x, y, z, w."""
FRAMES_PER_SECOND = 30.0
"""Where the video has no times."""
MAX_MORPH_TARGETS = 300
"""Frames above which tracked points are left out: their keys grow with the square of this."""

_POINTS, _LINE_STRIP = 0, 3


def write_glb(job: ExportJob) -> None:
    """Write ``scene.glb``; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    scene = _Scene(import_pygltflib(), _seconds(job.run))
    run, result = job.run, job.run.reconstruction
    cloud = static_cloud(run)
    scene.add_cloud("static", as_float32(cloud.points), cloud.colors)
    moving = 0
    for frame in range(run.num_frames):
        part = moving_cloud(run, frame)
        moving += len(part.points)
        if len(part.points):
            node = scene.add_cloud(f"moving_{frame:05d}", as_float32(part.points), part.colors)
            scene.show_only_in(node, frame)
        job.advance(frame + 1)
    tracked = scene.add_tracks(result) if run.num_frames <= MAX_MORPH_TARGETS else 0
    scene.add_camera(result)
    data = scene.encoded()
    path = job.folder / "scene.glb"
    path.write_bytes(data)
    job.figures |= {"static_points": len(cloud.points), "dynamic_points": moving, "tracked_points": tracked}
    job.facts.append(
        f"scene.glb, {len(data) / 1e6:.1f} MB: camera, {len(cloud.points)} static points, {moving} moving points, "
        f"{tracked} tracked points, {scene.times[-1]:.2f} s"
    )
    if not run.has_times:
        job.facts.append(f"the video has no times: the animation has {FRAMES_PER_SECOND:.0f} frames a second")
    if run.num_frames > MAX_MORPH_TARGETS and len(result.dynamic_track):
        job.warnings.append(f"tracked points are left out: more than {MAX_MORPH_TARGETS} frames")
    if result.zoom is not None:
        job.warnings.append("glTF has no zoom: the camera has the focal length of the first frame")


def _seconds(run: Run) -> Float32Array:
    """Return the second of each frame, (T,)."""
    times = run.reconstruction.timestamps
    return as_float32(times - times[0] if run.has_times else times / FRAMES_PER_SECOND)


@dataclass
class _Scene:
    """A glTF file in the making."""

    library: Any
    times: Float32Array
    file: Any = field(init=False)
    buffer: GltfBuffer = field(init=False)
    channels: list[Any] = field(default_factory=list)
    samplers: list[Any] = field(default_factory=list)
    children: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.file = self.library.GLTF2(asset=self.library.Asset(generator="uni4d_fg"))
        self.buffer = GltfBuffer(self.library, self.file)
        self.file.extensionsUsed = ["KHR_materials_unlit"]
        self.file.materials.append(self.library.Material(name="points", extensions={"KHR_materials_unlit": {}}))
        self._time = self.buffer.add(self.times, bounds=True)

    def add_cloud(self, name: str, points: Float32Array, colors: ImageArray) -> int:
        """Add colored points (N, 3); returns their node, or -1 where there are none."""
        return self._add_mesh(name, points, linear_colors(colors), [], _POINTS) if len(points) else -1

    def show_only_in(self, node: int, frame: int) -> None:
        """Scale a node to nothing but in one frame."""
        keys = {0.0: 0.0, float(self.times[frame]): 1.0}
        if frame + 1 < len(self.times):
            keys[float(self.times[frame + 1])] = 0.0
        time = self.buffer.add(as_float32(np.array(list(keys))), bounds=True)
        sizes = np.repeat(as_float32(np.array(list(keys.values())))[:, None], 3, axis=1)
        self._animate(node, "scale", time, np.ascontiguousarray(sizes), "STEP")

    def add_tracks(self, result: Reconstruction) -> int:
        """Add the tracked points, each with its place in every frame, and their paths; returns their number."""
        places, colors = _held(result)
        if not len(places):
            return 0
        first = as_float32(places[:, 0])
        targets = [as_float32(places[:, frame] - places[:, 0]) for frame in range(1, places.shape[1])]
        node = self._add_mesh("tracks", first, linear_colors(colors), targets, _POINTS)
        # In frame k, the morph target k - 1 has the weight one and all others none.
        weights = as_float32(np.eye(places.shape[1])[:, 1:]).reshape(-1)
        if len(weights):
            self._animate(node, "weights", self._time, weights, "LINEAR")
        return len(places)

    def add_camera(self, result: Reconstruction) -> None:
        """Add the camera and its path."""
        poses = result.world_T_cam @ OPENGL_FROM_OPENCV
        height, width = result.image_size
        _, fy, _, _ = result.frame_intrinsics[0].tolist()
        view = self.library.Perspective(
            aspectRatio=width / height, yfov=float(2.0 * np.arctan(0.5 * height / fy)), znear=0.01
        )
        self.file.cameras.append(self.library.Camera(type="perspective", perspective=view, name="camera"))
        quaternions, places = as_float32(continuous_quaternions(poses[:, :3, :3])), as_float32(poses[:, :3, 3])
        node = self._add_node(
            self.library.Node(name="camera", camera=0, translation=places[0].tolist(), rotation=quaternions[0].tolist())
        )
        self._animate(node, "translation", self._time, places, "LINEAR")
        self._animate(node, "rotation", self._time, quaternions, "LINEAR")
        orange = np.tile(np.array([230, 60, 40], dtype=np.uint8), (len(places), 1))
        if len(places) > 1:
            self._add_mesh("camera_path", places, linear_colors(orange), [], _LINE_STRIP)

    def encoded(self) -> bytes:
        """Return the file."""
        root = self.library.Node(name="world", rotation=HALF_TURN_ABOUT_X, children=self.children)
        self.file.nodes.append(root)
        self.file.scenes.append(self.library.Scene(name="scene", nodes=[len(self.file.nodes) - 1]))
        self.file.scene = 0
        self.file.animations.append(
            self.library.Animation(name="video", channels=self.channels, samplers=self.samplers)
        )
        content = self.buffer.content()
        self.file.buffers.append(self.library.Buffer(byteLength=len(content)))
        self.file.set_binary_blob(content)
        return b"".join(self.file.save_to_bytes())

    def _add_mesh(self, name: str, points: Float32Array, colors: Any, targets: list[Float32Array], mode: int) -> int:
        attributes = self.library.Attributes(
            POSITION=self.buffer.add(points, bounds=True), COLOR_0=self.buffer.add(colors, normalized=True)
        )
        morphs = [{"POSITION": self.buffer.add(target, bounds=True)} for target in targets]
        primitive = self.library.Primitive(attributes=attributes, mode=mode, material=0, targets=morphs)
        weights = [0.0] * len(targets)
        self.file.meshes.append(self.library.Mesh(name=name, primitives=[primitive], weights=weights))
        return self._add_node(self.library.Node(name=name, mesh=len(self.file.meshes) - 1))

    def _add_node(self, node: Any) -> int:
        self.file.nodes.append(node)
        self.children.append(len(self.file.nodes) - 1)
        return self.children[-1]

    def _animate(self, node: int, path: str, time: int, values: Float32Array, interpolation: str) -> None:
        output = self.buffer.add(values)
        self.samplers.append(self.library.AnimationSampler(input=time, output=output, interpolation=interpolation))
        target = self.library.AnimationChannelTarget(node=node, path=path)
        self.channels.append(self.library.AnimationChannel(sampler=len(self.samplers) - 1, target=target))


def _held(result: Reconstruction) -> tuple[FloatArray, ImageArray]:
    """Return the tracked points (K, T, 3), each held at its nearest known place where it has none, and their colors."""
    known = np.isfinite(result.dynamic_points[..., 0])
    rows = np.flatnonzero(known.any(axis=1))
    frames = np.arange(known.shape[1])
    places = np.empty((len(rows), known.shape[1], 3))
    for place, row in zip(places, rows.tolist(), strict=True):
        there = np.flatnonzero(known[row])
        nearest = there[np.abs(frames[:, None] - there[None]).argmin(axis=1)]
        place[:] = result.dynamic_points[row, nearest]
    return places, result.dynamic_color[rows]
