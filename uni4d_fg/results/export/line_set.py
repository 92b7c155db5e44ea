"""Line sets as binary PLY: vertices with color and whole-number attributes, and edges between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.files import atomic_path


@dataclass(frozen=True)
class LineSet:
    """N vertices and E edges."""

    points: FloatArray
    """(N, 3) meters."""
    colors: ImageArray
    """(N, 3) RGB."""
    edges: npt.NDArray[np.signedinteger]
    """(E, 2) rows of ``points``."""
    attributes: Mapping[str, npt.NDArray[np.signedinteger]] = field(default_factory=dict)
    """Further numbers of each vertex, (N,) each."""


def write_line_set(path: Path, lines: LineSet) -> None:
    """Write a line set, whole or not at all.

    Raises:
        OutputError: If the file cannot be written.
    """
    vertex = np.dtype(
        [(axis, "<f4") for axis in "xyz"]
        + [(channel, "u1") for channel in ("red", "green", "blue")]
        + [(name, "<i4") for name in lines.attributes]
    )
    vertices = np.empty(len(lines.points), dtype=vertex)
    for column, axis in enumerate("xyz"):
        vertices[axis] = lines.points[:, column]
    for column, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = lines.colors[:, column]
    for name, values in lines.attributes.items():
        vertices[name] = values
    edge = np.dtype([("vertex1", "<i4"), ("vertex2", "<i4")])
    edges = np.empty(len(lines.edges), dtype=edge)
    edges["vertex1"], edges["vertex2"] = lines.edges[:, 0], lines.edges[:, 1]
    kinds = {"f": "float", "u": "uchar", "i": "int"}
    header = ["ply", "format binary_little_endian 1.0"]
    for element, count, layout in (("vertex", len(vertices), vertex), ("edge", len(edges), edge)):
        header.append(f"element {element} {count}")
        header += [f"property {kinds[layout[name].kind]} {name}" for name in layout.names or ()]
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        stream.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        stream.write(vertices.tobytes())
        stream.write(edges.tobytes())
