"""The glTF scene: its structure by the specification's rules, its content by a second reader and by projection."""

from __future__ import annotations

import dataclasses
import importlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_checks import seen_landmarks
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import MissingDependencyError
from uni4d_fg.results.export import export_run
from uni4d_fg.results.export.clouds import moving_cloud, static_cloud
from uni4d_fg.results.export.gltf_buffer import linear_colors
from uni4d_fg.results.run import Run

pygltflib = pytest.importorskip("pygltflib")

Export = Callable[..., tuple[Path, object]]
_KINDS = {5126: "<f4", 5123: "<u2", 5125: "<u4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Scene:
    """A ``.glb``, with its accessors as arrays."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = pygltflib.GLTF2().load(str(path))
        self.blob = self.file.binary_blob()

    def array(self, number: int) -> np.ndarray:
        accessor = self.file.accessors[number]
        view = self.file.bufferViews[accessor.bufferView]
        width, dtype = _WIDTH[accessor.type], np.dtype(_KINDS[accessor.componentType])
        assert view.byteOffset % 4 == 0
        assert view.byteOffset + view.byteLength <= len(self.blob)
        assert view.byteLength == accessor.count * width * dtype.itemsize
        data = np.frombuffer(self.blob, dtype, accessor.count * width, view.byteOffset).reshape(-1, width)
        if accessor.min:
            np.testing.assert_array_equal(data.min(axis=0), np.array(accessor.min, dtype))
            np.testing.assert_array_equal(data.max(axis=0), np.array(accessor.max, dtype))
        return data

    def node(self, name: str) -> tuple[int, Any]:
        ((number, node),) = [(k, n) for k, n in enumerate(self.file.nodes) if n.name == name]
        return number, node

    def points(self, name: str) -> np.ndarray:
        primitive = self.file.meshes[self.node(name)[1].mesh].primitives[0]
        return self.array(primitive.attributes.POSITION)

    def animated(self, name: str, path: str) -> tuple[np.ndarray, np.ndarray, str]:
        """Times, values and interpolation of what moves a node."""
        number, _ = self.node(name)
        (animation,) = self.file.animations
        (channel,) = [c for c in animation.channels if (c.target.node, c.target.path) == (number, path)]
        sampler = animation.samplers[channel.sampler]
        times = self.array(sampler.input)[:, 0]
        assert (np.diff(times) > 0).all()
        assert self.file.accessors[sampler.input].min
        return times, self.array(sampler.output), sampler.interpolation


@pytest.fixture(scope="module")
def scene(source: Run, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    (report,) = export_run(source, ["glb"], tmp_path_factory.mktemp("glb"))
    return Scene(report.folder / "scene.glb")


def test_the_camera_sees_landmarks_where_the_video_did(source: Run, scene: Scene) -> None:
    result, seen = source.reconstruction, seen_landmarks(source)
    times, places, _ = scene.animated("camera", "translation")
    _, turns, interpolation = scene.animated("camera", "rotation")
    assert interpolation == "LINEAR"
    np.testing.assert_allclose(times, result.timestamps - result.timestamps[0], atol=1e-6)
    height, width = result.image_size
    view = scene.file.cameras[0].perspective
    for frame in range(source.num_frames):
        mine = seen.frame == frame
        # glTF: the camera looks along -z, y is up; the vertical field of view and the aspect make the picture.
        local = (result.landmarks[seen.landmark[mine]] - places[frame]) @ Rotation.from_quat(turns[frame]).as_matrix()
        assert (local[:, 2] < 0).all()
        plane = local[:, :2] / -local[:, 2:] / np.tan(view.yfov / 2)
        pixel = np.stack((plane[:, 0] / view.aspectRatio * width, -plane[:, 1] * height), axis=1) / 2
        pixel += [width / 2 - 0.5, height / 2 - 0.5]
        assert np.linalg.norm(pixel - seen.uv[mine], axis=1).max() < seen.error[mine].max() + 1.0


def test_the_file_holds_no_empty_lists(scene: Scene) -> None:
    def check(value: Any) -> None:
        assert value not in ([], None)
        for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            check(part)

    # What follows the header of 12 bytes and that of the first chunk, 8, is JSON.
    data = scene.path.read_bytes()
    check(json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")]))


def test_the_container_keeps_the_rules_of_the_format(scene: Scene) -> None:
    # Read without the library that wrote it (glTF 2.0, section 4.4): a header, a chunk of JSON, a chunk of bytes.
    data = scene.path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    text = data[20 : 20 + size]
    assert text.rstrip(b" ").endswith(b"}")
    bytes_size, bytes_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (bytes_kind, bytes_size % 4, 28 + size + bytes_size) == (b"BIN\0", 0, len(data))
    file = json.loads(text)
    assert 0 <= bytes_size - file["buffers"][0]["byteLength"] <= 3
    ends = 0
    for view in file["bufferViews"]:
        # Views lie one behind the other, and on multiples of four.
        assert ends <= view["byteOffset"] <= ends + 3
        ends = view["byteOffset"] + view["byteLength"]
    assert ends <= file["buffers"][0]["byteLength"]


def test_every_animation_has_growing_times_and_a_value_for_each(scene: Scene) -> None:
    (animation,) = scene.file.animations
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        times, values = scene.array(sampler.input)[:, 0], scene.array(sampler.output)
        node = scene.file.nodes[channel.target.node]
        assert times[0] >= 0.0
        assert (np.diff(times) > 0.0).all()
        assert len(scene.file.accessors[sampler.input].min) == 1
        targets = len(scene.file.meshes[node.mesh].primitives[0].targets) if channel.target.path == "weights" else 1
        assert len(values) == len(times) * targets
        if channel.target.path == "rotation":
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1.0, atol=1e-6)


def test_everything_hangs_below_a_node_that_puts_y_up(scene: Scene) -> None:
    (root,) = scene.file.scenes[scene.file.scene].nodes
    assert scene.file.nodes[root].rotation == [1.0, 0.0, 0.0, 0.0]
    assert sorted(scene.file.nodes[root].children) == [k for k in range(len(scene.file.nodes)) if k != root]
    down = Rotation.from_quat(scene.file.nodes[root].rotation).as_matrix() @ [0.0, 1.0, 0.0]
    np.testing.assert_allclose(down, [0.0, -1.0, 0.0], atol=1e-12)


def test_a_frames_cloud_is_there_in_its_frame_alone(source: Run, scene: Scene) -> None:
    seconds = source.reconstruction.timestamps - source.reconstruction.timestamps[0]
    for frame in range(source.num_frames):
        name = f"moving_{frame:05d}"
        np.testing.assert_allclose(scene.points(name), moving_cloud(source, frame).points, atol=1e-6)
        times, sizes, interpolation = scene.animated(name, "scale")
        assert interpolation == "STEP"
        for other, second in enumerate(seconds):
            key = np.searchsorted(times, np.float32(second) + 1e-6, side="right") - 1
            assert sizes[key].tolist() == [float(other == frame)] * 3
    np.testing.assert_allclose(scene.points("static"), static_cloud(source).points, atol=1e-6)


def test_tracked_points_follow_their_trajectories(source: Run, scene: Scene) -> None:
    result = source.reconstruction
    primitive = scene.file.meshes[scene.node("tracks")[1].mesh].primitives[0]
    base = scene.array(primitive.attributes.POSITION)
    targets = np.stack([scene.array(target["POSITION"]) for target in primitive.targets])
    _, weights, _ = scene.animated("tracks", "weights")
    weights = weights.reshape(source.num_frames, len(targets))
    known = np.isfinite(result.dynamic_points[..., 0])
    rows = np.flatnonzero(known.any(axis=1))
    assert len(base) == len(rows) > 20
    for frame in range(source.num_frames):
        places = base + np.tensordot(weights[frame], targets, axes=1)
        there = known[rows, frame]
        np.testing.assert_allclose(places[there], result.dynamic_points[rows[there], frame], atol=1e-5)
        assert np.isfinite(places).all()


def test_another_reader_finds_the_same_points(source: Run, exported: Export) -> None:
    trimesh = pytest.importorskip("trimesh")
    folder, _ = exported("glb")
    found = trimesh.load(folder / "scene.glb").geometry
    np.testing.assert_allclose(found["static"].vertices, static_cloud(source).points, atol=1e-6)


def test_without_times_there_are_thirty_frames_a_second(source: Run, tmp_path: Path) -> None:
    counted = dataclasses.replace(source.reconstruction, timestamps=np.arange(source.num_frames, dtype=np.float64))
    (report,) = export_run(source.with_parts(reconstruction=counted), ["glb"], tmp_path)
    times, _, _ = Scene(report.folder / "scene.glb").animated("camera", "translation")
    np.testing.assert_allclose(times, np.arange(source.num_frames) / 30.0, atol=1e-6)
    assert any("no times" in fact for fact in report.facts)


def test_colors_are_linear() -> None:
    colors = linear_colors(np.array([[0, 188, 255]], np.uint8))
    assert colors[0, [0, 2, 3]].tolist() == [0, 65535, 65535]
    assert abs(colors[0, 1] / 65535 - 0.5028) < 1e-3


def test_without_the_library_there_is_one_sentence(
    source: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(name: str) -> Any:
        raise ModuleNotFoundError(f"No module named '{name}'", name=name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(MissingDependencyError, match=r"pip install 'uni4d-fg\[export\]'"):
        export_run(source, ["glb"], tmp_path / "out")
