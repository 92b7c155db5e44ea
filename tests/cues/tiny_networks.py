"""Networks of a few nodes, whose answer is known, as real ONNX files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper

FLOAT = TensorProto.FLOAT
Shape = list[int | str]


def save_network(
    path: Path, nodes: list[Any], inputs: dict[str, Shape], outputs: dict[str, Shape], constants: dict[str, Any]
) -> Path:
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def constant_output(name: str, value: Any) -> tuple[Any, dict[str, Shape]]:
    array = np.asarray(value, np.float32)
    node = helper.make_node("Constant", [], [name], value=numpy_helper.from_array(array))
    return node, {name: list(array.shape)}


def weighted_channels(
    path: Path, weights: tuple[float, float, float], bias: float = 0.0, size: tuple[Any, Any] = ("h", "w"),
    extra: dict[str, Any] | None = None,
) -> Path:  # fmt: skip
    """A 1 x 1 convolution: out = weights . (c0, c1, c2) + bias; ``extra`` outputs are constant."""
    nodes = [helper.make_node("Conv", ["image", "weight", "bias"], ["out"])]
    outputs: dict[str, Shape] = {"out": [1, 1, *size]}
    for name, value in (extra or {}).items():
        node, shape = constant_output(name, value)
        nodes.append(node)
        outputs |= shape
    weight = np.array(weights, np.float32).reshape(1, 3, 1, 1)
    constants = {"weight": weight, "bias": np.array([bias], np.float32)}
    return save_network(path, nodes, {"image": [1, 3, *size]}, outputs, constants)


def two_classes(path: Path) -> Path:
    """Scores of two classes: what is not red, and what is."""
    weight = np.array([[0.0, 0, 0], [20.0, 0, 0]], np.float32).reshape(2, 3, 1, 1)
    constants = {"weight": weight, "bias": np.array([10.0, 0.0], np.float32)}
    nodes = [helper.make_node("Conv", ["image", "weight", "bias"], ["scores"])]
    return save_network(path, nodes, {"image": [1, 3, "h", "w"]}, {"scores": [1, 2, "h", "w"]}, constants)


def constant_network(path: Path, outputs: dict[str, Any], size: tuple[int, int]) -> Path:
    """Whatever the image is, the same answer."""
    made = [constant_output(name, value) for name, value in outputs.items()]
    shapes = {name: shape for _, part in made for name, shape in part.items()}
    return save_network(path, [node for node, _ in made], {"image": [1, 3, *size]}, shapes, {})


def moving_points(path: Path, frames: int, points: int, size: tuple[int, int], velocity: tuple[float, float]) -> Path:
    """Tracks that move by ``velocity`` px per gray level, so that the brightness of a frame tells where they are.

    Points are seen but for gray levels from 20 to 22.
    """
    axes = np.array([2, 3, 4])
    nodes = [
        helper.make_node("ReduceMean", ["video"], ["level4"], axes=axes.tolist(), keepdims=0),  # (1, T)
        helper.make_node("Reshape", ["level4", "flat"], ["level"]),  # (T,)
        helper.make_node("Slice", ["queries", "zero", "one", "last"], ["when"]),  # (1, N, 1)
        helper.make_node("Slice", ["queries", "one", "three", "last"], ["where"]),  # (1, N, 2)
        helper.make_node("Cast", ["when"], ["index"], to=TensorProto.INT64),
        helper.make_node("Reshape", ["index", "flat"], ["indices"]),
        helper.make_node("Gather", ["level", "indices"], ["start"]),  # (N,)
        helper.make_node("Reshape", ["level", "column"], ["level_column"]),  # (T, 1)
        helper.make_node("Sub", ["level_column", "start"], ["passed"]),  # (T, N)
        helper.make_node("Unsqueeze", ["passed", "last_axis"], ["passed3"]),
        helper.make_node("Mul", ["passed3", "velocity"], ["moved"]),  # (T, N, 2)
        helper.make_node("Add", ["where", "moved"], ["positions"]),
        helper.make_node("Unsqueeze", ["positions", "zero"], ["tracks"]),
        helper.make_node("Sub", ["level", "hidden"], ["from_hidden"]),
        helper.make_node("Abs", ["from_hidden"], ["distance"]),
        helper.make_node("Sub", ["distance", "half_width"], ["logit_row"]),
        helper.make_node("Mul", ["logit_row", "gain"], ["logits"]),
        helper.make_node("Reshape", ["logits", "column"], ["logit_column"]),
        helper.make_node("Mul", ["start", "nothing"], ["zeros"]),
        helper.make_node("Add", ["logit_column", "zeros"], ["logit_table"]),  # (T, N)
        helper.make_node("Unsqueeze", ["logit_table", "zero"], ["visibility"]),
    ]
    constants = {
        "flat": np.array([-1]), "column": np.array([-1, 1]), "zero": np.array([0]), "one": np.array([1]),
        "three": np.array([3]), "last": np.array([2]), "last_axis": np.array([-1]),
        "velocity": np.array(velocity, np.float32), "hidden": np.array([21.0], np.float32),
        "half_width": np.array([1.5], np.float32), "gain": np.array([20.0], np.float32),
        "nothing": np.array([0.0], np.float32),
    }  # fmt: skip
    for node in nodes:
        if node.op_type == "ReduceMean":
            del node.attribute[:]
            node.attribute.extend([helper.make_attribute("axes", axes.tolist()), helper.make_attribute("keepdims", 0)])
    shapes: dict[str, Shape] = {"tracks": [1, frames, points, 2], "visibility": [1, frames, points]}
    return save_network(path, nodes, {"video": [1, frames, 3, *size], "queries": [1, points, 3]}, shapes, constants)


def write_card(path: Path, **changes: Any) -> Path:
    """Write a card for depth with a few fields changed; nested fields as mappings."""
    card: dict[str, Any] = {
        "kind": "depth", "title": "tiny", "file": "tiny.onnx", "license": "none", "export": "made by a test",
        "input": {"name": "image"},
    }  # fmt: skip
    if changes.get("kind", "depth") == "depth":
        card["depth"] = {"name": "out", "kind": "metric_depth"}
    for name, value in changes.items():
        card[name] = {**card[name], **value} if isinstance(value, dict) and isinstance(card.get(name), dict) else value
    path.write_text(yaml.safe_dump(card), encoding="utf-8")
    return path
