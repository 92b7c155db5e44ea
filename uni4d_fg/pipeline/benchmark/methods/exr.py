"""One channel of an OpenEXR file, which OpenCV reads only in some of its builds.

Scan lines of half or float32, uncompressed or by zip (one or 16 lines at a time), as OpenEXR's Python module writes
depth by default (https://openexr.com/en/latest/OpenEXRFileLayout.html).
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from uni4d_fg.arrays import Float32Array
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.decode import MAX_PIXELS

_MAGIC = b"\x76\x2f\x31\x01"
_TYPES: dict[int, np.dtype[np.floating]] = {1: np.dtype(np.float16), 2: np.dtype(np.float32)}
_LINES = {0: 1, 2: 1, 3: 16}
"""Scan lines per block by compression: none, zips, zip."""


def read_exr(data: bytes, where: str) -> Float32Array:
    """Return the channel Z, else Y or R, else the first, as (H, W) float32.

    Args:
        data: Content of the file.
        where: Its name, for messages.

    Raises:
        InputError: If it is damaged, or of another kind than above.
    """
    try:
        return _decode(data, where)
    except (struct.error, ValueError, LookupError, OverflowError, zlib.error) as error:
        raise InputError(f"{where}: cannot be decoded as EXR ({error}); write it again, or as .npy") from error


def _decode(data: bytes, where: str) -> Float32Array:
    if data[:4] != _MAGIC:
        raise InputError(f"{where}: is not an EXR file; check what the method wrote")
    if struct.unpack_from("<I", data, 4)[0] & ~0xFF & ~0x400:
        raise InputError(f"{where}: is a tiled, deep or multi-part EXR file; write scan lines, or .npy")
    header, at = _attributes(data)
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    compression = header["compression"][0]
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise InputError(f"{where}: announces {width} x {height} px; check the file")
    if compression not in _LINES:
        raise InputError(f"{where}: has compression {compression}; write it without or with zip, or as .npy")
    channels = _channels(header["channels"])
    if not channels:
        raise ValueError("it has no channel")
    wanted = next((name for name in ("Z", "Y", "R") if name in channels), next(iter(channels)))
    lines = _LINES[compression]
    out: Float32Array = np.full((height, width), np.nan, dtype=np.float32)
    row_bytes = width * sum(kind.itemsize for kind in channels.values())
    for offset in struct.unpack_from(f"<{-(-height // lines)}Q", data, at):
        y, size = struct.unpack_from("<ii", data, offset)
        block, first = data[offset + 8 : offset + 8 + size], y - top
        count = min(lines, height - first)
        if size < count * row_bytes:
            block = _unzipped(block, count * row_bytes)
        if first < 0 or len(block) != count * row_bytes:
            raise ValueError(f"a block of {len(block)} bytes for {count} lines")
        for line in range(count):
            start = line * row_bytes
            for name, kind in channels.items():
                if name == wanted:
                    out[first + line] = np.frombuffer(block, kind, width, start)
                start += width * kind.itemsize
    return out


def _attributes(data: bytes) -> tuple[dict[str, bytes], int]:
    """Return the header's values by name, and where it ends."""
    found, at = {}, 8
    while data[at]:
        name_end = data.index(0, at)
        kind_end = data.index(0, name_end + 1)
        (size,) = struct.unpack_from("<i", data, kind_end + 1)
        if size < 0:
            raise ValueError("an attribute of negative size")
        found[data[at:name_end].decode("latin-1")] = data[kind_end + 5 : kind_end + 5 + size]
        at = kind_end + 5 + size
    return found, at + 1


def _channels(data: bytes) -> dict[str, np.dtype[np.floating]]:
    """Return the type of every channel, in the order of their names, which is that of the data."""
    found: dict[str, np.dtype[np.floating]] = {}
    at = 0
    while data[at]:
        end = data.index(0, at)
        kind, _, across, down = struct.unpack_from("<iIii", data, end + 1)
        if (across, down) != (1, 1):
            raise ValueError("a channel of another size")
        found[data[at:end].decode("latin-1")] = _TYPES[kind]
        at = end + 17
    return found


def _unzipped(block: bytes, size: int) -> bytes:
    """Undo zlib, the differences between neighbors, and the parting of even and odd bytes."""
    engine = zlib.decompressobj()
    coded = np.frombuffer(engine.decompress(block, size), np.uint8).astype(np.int64)
    coded[1:] -= 128
    plain = (np.cumsum(coded) & 0xFF).astype(np.uint8)
    out = np.empty_like(plain)
    half = (len(plain) + 1) // 2
    out[0::2], out[1::2] = plain[:half], plain[half:]
    return out.tobytes()
