"""The only place that makes, decodes and prints GTSAM keys.

A key is a character (the variable group) in the top 8 bits and an index in the lower 56, which is the layout
of ``gtsam.Symbol``: X(t) pose, K(0) intrinsics, S(t) depth log-scale, L(k) landmark. A dynamic point packs
(track k, frame t) as ``k * 2^28 + t`` into the index, which is invertible and keeps tracks together.
"""

from __future__ import annotations

from dataclasses import dataclass

FRAME_BITS = 28
INDEX_BITS = 56
MAX_FRAME = (1 << FRAME_BITS) - 1
MAX_INDEX = (1 << INDEX_BITS) - 1

GROUP_CHARACTER = {"pose": "x", "intrinsics": "k", "log_scale": "s", "landmark": "l", "dynamic_point": "p"}
_CHARACTER_GROUP = {ord(c): group for group, c in GROUP_CHARACTER.items()}
_GROUP_TEXT = {
    "pose": "camera pose, frame",
    "intrinsics": "intrinsics",
    "log_scale": "depth log-scale, frame",
}


def _key(group: str, index: int) -> int:
    if not 0 <= index <= MAX_INDEX:
        raise ValueError(f"{group} index {index} is outside [0, 2^{INDEX_BITS})")
    return (ord(GROUP_CHARACTER[group]) << INDEX_BITS) | int(index)


def pose_key(frame: int) -> int:
    """Return X(t)."""
    return _key("pose", frame)


def intrinsics_key(camera: int = 0) -> int:
    """Return K(0)."""
    return _key("intrinsics", camera)


def log_scale_key(frame: int) -> int:
    """Return S(t)."""
    return _key("log_scale", frame)


def landmark_key(track: int) -> int:
    """Return L(k)."""
    return _key("landmark", track)


def dynamic_point_key(track: int, frame: int) -> int:
    """Return the key of dynamic point (k, t)."""
    if not 0 <= frame <= MAX_FRAME or not 0 <= track <= MAX_FRAME:
        raise ValueError(f"dynamic point (track {track}, frame {frame}): both must lie in [0, 2^{FRAME_BITS})")
    return _key("dynamic_point", (int(track) << FRAME_BITS) | int(frame))


@dataclass(frozen=True)
class DecodedKey:
    """What a key stands for."""

    group: str
    index: int
    """Frame, camera or track; for a dynamic point its track."""
    frame: int | None = None
    """Frame of a dynamic point."""

    def __str__(self) -> str:
        if self.group == "dynamic_point":
            return f"dynamic point, track {self.index}, frame {self.frame}"
        if self.group == "landmark":
            return f"landmark, track {self.index}"
        if self.group in _GROUP_TEXT:
            return f"{_GROUP_TEXT[self.group]} {self.index}"
        return f"unknown variable {self.index}"


def decode(key: int) -> DecodedKey:
    """Return what ``key`` stands for; keys of other programs decode to group 'unknown'."""
    group = _CHARACTER_GROUP.get(key >> INDEX_BITS)
    index = key & MAX_INDEX
    if group is None:
        return DecodedKey("unknown", key)
    if group == "dynamic_point":
        return DecodedKey(group, index >> FRAME_BITS, index & MAX_FRAME)
    return DecodedKey(group, index)
