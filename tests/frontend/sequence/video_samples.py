"""Small video files for tests, and MP4 boxes changed as cameras and phones write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

SIZE = (48, 64)  # height, width
RATE = 12.5
ROTATIONS = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}
"""Degrees clockwise from stored to upright, to a, b, c, d of a track header's matrix."""


def gray_frames(length: int) -> list[np.ndarray]:
    """Frames whose gray level is 20 times their number."""
    return [np.full((*SIZE, 3), 20 * i, np.uint8) for i in range(length)]


def write_video(path: Path, frames: Sequence[np.ndarray], codec: str = "mp4v", backend: int = cv2.CAP_FFMPEG) -> Path:
    """Write RGB frames (H, W, 3) at 12.5 frames a second."""
    height, width = frames[0].shape[:2] if len(frames) else SIZE
    writer = cv2.VideoWriter(str(path), backend, cv2.VideoWriter_fourcc(*codec), RATE, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[:, :, ::-1]))
    writer.release()
    return path


def boxes(data: bytes, start: int = 0, end: int | None = None) -> list[tuple[bytes, int, int]]:
    """Return (type, start, end) of the MP4 boxes between two offsets."""
    found = []
    position = start
    while position < (len(data) if end is None else end):
        length = int.from_bytes(data[position : position + 4], "big")
        found.append((data[position + 4 : position + 8], position, position + length))
        position += length
    return found


def find_box(data: bytes, *names: bytes) -> list[tuple[int, int]]:
    """Return (start, end) of each box on the way down a path such as moov, trak, tkhd."""
    start, end, way = 0, len(data), []
    for name in names:
        start, end = next((s, e) for kind, s, e in boxes(data, start, end) if kind == name)
        way.append((start, end))
        start += 8
    return way


def rotate(path: Path, degrees: int) -> Path:
    """Write a rotation flag into the track header of an MP4 file."""
    return set_matrix(path, ROTATIONS[degrees])


def set_matrix(path: Path, abcd: tuple[int, int, int, int]) -> Path:
    """Write a display matrix into the track header of an MP4 file."""
    data = bytearray(path.read_bytes())
    start = find_box(bytes(data), b"moov", b"trak", b"tkhd")[-1][0]
    assert data[start + 8] == 0  # version
    a, b, c, d = abcd
    matrix = np.array([a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30], ">i4")
    data[start + 48 : start + 84] = matrix.tobytes()
    path.write_bytes(data)
    return path


def set_pixel_aspect(path: Path, aspect: float) -> Path:
    """Say in the track header of an MP4 file that pictures are shown wider than they are stored."""
    data = bytearray(path.read_bytes())
    start = find_box(bytes(data), b"moov", b"trak", b"tkhd")[-1][0]
    width = int.from_bytes(data[start + 84 : start + 88], "big")
    data[start + 84 : start + 88] = round(width * aspect).to_bytes(4, "big")
    path.write_bytes(data)
    return path


def set_durations(path: Path, parts: Sequence[int]) -> Path:
    """Make the frames of an MP4 file last as long as their parts of the whole, instead of all alike.

    The table of times must lie behind the pictures, as it does in files that OpenCV writes.
    """
    data = path.read_bytes()
    way = find_box(data, b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts")
    assert way[0][0] > find_box(data, b"mdat")[0][0]
    start, end = way[-1]
    count, delta = (int.from_bytes(data[start + i : start + i + 4], "big") for i in (16, 20))
    assert end - start == 24
    assert count == len(parts)
    ticks = np.array(parts) * delta * count // sum(parts)
    entries = np.stack((np.ones(count), ticks), axis=1).astype(">u4").tobytes()
    table = data[start + 4 : start + 12] + count.to_bytes(4, "big") + entries
    changed = bytearray(data[:start] + (4 + len(table)).to_bytes(4, "big") + table + data[end:])
    for box_start, box_end in way[:-1]:
        grown = box_end - box_start + 4 + len(table) - 24
        changed[box_start : box_start + 4] = grown.to_bytes(4, "big")
    path.write_bytes(changed)
    return path


def table_first(path: Path) -> Path:
    """Move the table of contents of an MP4 file before the pictures, as files for the web have it."""
    data = path.read_bytes()
    moov, mdat = find_box(data, b"moov")[0], find_box(data, b"mdat")[0]
    assert moov[0] > mdat[0]
    table = bytearray(data[moov[0] : moov[1]])
    start = find_box(bytes(table), b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stco")[-1][0]
    count = int.from_bytes(table[start + 12 : start + 16], "big")
    offsets = np.frombuffer(bytes(table[start + 16 : start + 16 + 4 * count]), ">u4") + len(table)
    table[start + 16 : start + 16 + 4 * count] = offsets.astype(">u4").tobytes()
    first = data[: boxes(data)[0][2]]
    path.write_bytes(first + bytes(table) + data[len(first) : moov[0]] + data[moov[1] :])
    return path
