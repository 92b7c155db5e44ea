"""Depth as OpenEXR (``depth/*.exr``): float32 meters without loss, for compositing programs and ViPE's users.

One channel ``Z``, scan lines in blocks of 16 that are compressed by zip (https://openexr.com/en/latest/OpenEXRFileLayout.html).
Written here because OpenCV's wheels have no encoder for it.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from uni4d_fg.arrays import Float32Array
from uni4d_fg.results.export.frames import frame_names
from uni4d_fg.results.export.model import ExportJob

_MAGIC_AND_VERSION = struct.pack("<II", 20000630, 2)
_FLOAT, _ZIP, _LINES = 2, 3, 16


def write_exr_depth(job: ExportJob) -> None:
    """Write ``depth/NAME.exr``; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    depths = job.run.need_depth("depth as EXR")
    folder = job.folder / "depth"
    folder.mkdir()
    for frame, (name, depth) in enumerate(zip(frame_names(job.run), depths, strict=True)):
        with np.errstate(invalid="ignore"):
            known = np.isfinite(depth) & (depth > 0.0)
        (folder / f"{name}.exr").write_bytes(exr_bytes(np.where(known, depth, 0.0).astype(np.float32)))
        job.advance(frame + 1)
    job.figures |= {"depth_maps": job.run.num_frames}
    job.facts.append(f"{job.run.num_frames} maps of depth along the optical axis: channel Z, {job.run.unit}, 0 missing")


def exr_bytes(depth: Float32Array) -> bytes:
    """Return a map (H, W) as the bytes of an OpenEXR file with the channel ``Z``."""
    height, width = depth.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        ("channels", "chlist", b"Z\0" + struct.pack("<iB3xii", _FLOAT, 1, 1, 1) + b"\0"),
        ("compression", "compression", bytes([_ZIP])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    )
    header = _MAGIC_AND_VERSION + b"".join(
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<I", len(value)) + value
        for name, kind, value in attributes
    ) + b"\0"  # fmt: skip
    tops = range(0, height, _LINES)
    blocks = [
        struct.pack("<iI", top, len(packed)) + packed for top in tops for packed in [_packed(depth[top : top + _LINES])]
    ]
    starts = len(header) + 8 * len(blocks) + np.cumsum([0, *(len(block) for block in blocks[:-1])])
    return header + starts.astype("<u8").tobytes() + b"".join(blocks)


def _packed(lines: Float32Array) -> bytes:
    """Compress scan lines as OpenEXR's zip does: even bytes before odd ones, differences of neighbors, deflate."""
    raw = np.frombuffer(lines.astype("<f4").tobytes(), np.uint8)
    apart = np.concatenate((raw[::2], raw[1::2]))
    steps = apart.copy()
    steps[1:] = apart[1:] - apart[:-1] + np.uint8(128)
    packed = zlib.compress(steps.tobytes())
    # A block that does not get smaller is stored as it is.
    return packed if len(packed) < len(raw) else raw.tobytes()
