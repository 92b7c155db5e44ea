"""Whether a video file is as long as its container says, for MP4 and its kin, AVI, and Matroska with WebM.

A decoder takes the end of the file for the end of the video, and says nothing of a copy that was interrupted.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO

_EBML_HEADER = b"\x1a\x45\xdf\xa3"
_MATROSKA_SEGMENT = b"\x18\x53\x80\x67"


_ISO_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot", b"uuid")
_OTHER_STARTS = (b"OggS", b"FLV\x01", b"\x30\x26\xb2\x75\x8e\x66\xcf\x11", b"\x00\x00\x01\xba")
_TRANSPORT_PACKET = 188


def is_container(path: Path) -> bool:
    """Tell whether a file begins as one that holds its video itself.

    Decoders also take lists of other files and addresses for videos, which would be opened for whoever wrote the list.
    """
    try:
        with open(path, "rb") as stream:
            start = stream.read(2 * _TRANSPORT_PACKET + 1)
    except OSError:
        return False
    if start[4:8] in _ISO_BOXES or (start[:4] == b"RIFF" and start[8:12] == b"AVI "):
        return True
    if start.startswith((_EBML_HEADER, *_OTHER_STARTS)):
        return True
    return len(start) > 2 * _TRANSPORT_PACKET and all(start[i * _TRANSPORT_PACKET] == 0x47 for i in range(3))


def missing_bytes(path: Path) -> int:
    """Return how many bytes the container announces beyond the end of the file; 0 if it is whole or says nothing."""
    try:
        stream = open(path, "rb")  # noqa: SIM115 - closed below; only the opening may fail without notice
    except OSError:
        return 0
    with stream:
        size = path.stat().st_size
        start = stream.read(12)
        if start[4:8] in _ISO_BOXES:
            end = _end_of_boxes(stream, size)
        elif start[:4] == b"RIFF" and start[8:12] == b"AVI ":
            end = 8 + int.from_bytes(start[4:8], "little")
        elif start[:4] == _EBML_HEADER:
            end = _end_of_segment(stream)
        else:
            end = 0
    return max(end - size, 0)


def _end_of_boxes(stream: IO[bytes], size: int) -> int:
    """Return where the last of the boxes of an ISO base media file ends."""
    position = 0
    while position < size:
        stream.seek(position)
        header = stream.read(16)
        length = int.from_bytes(header[:4], "big")
        if length == 1:
            length = int.from_bytes(header[8:16], "big")
        # A length of 0 goes up to the end of the file, whatever that is; less is damage. What has no name of four
        # letters is no box: some programs leave bytes of their own behind the last one, which players pass over.
        if length < 8 or not all(0x20 <= letter <= 0x7E or letter == 0xA9 for letter in header[4:8]):
            return size
        position += length
    return position


def _end_of_segment(stream: IO[bytes]) -> int:
    """Return where the segment of a Matroska file ends; 0 if its length is left open."""
    stream.seek(4)
    header = _variable_length(stream)
    if header is None:
        return 0
    stream.seek(header, 1)
    if stream.read(4) != _MATROSKA_SEGMENT:
        return 0
    segment = _variable_length(stream)
    return 0 if segment is None else stream.tell() + segment


def _variable_length(stream: IO[bytes]) -> int | None:
    """Read a length of one to eight bytes, whose first set bit tells how many; None if left open or damaged."""
    first = stream.read(1)
    if not first or first[0] == 0:
        return None
    width = 9 - first[0].bit_length()
    rest = stream.read(width - 1)
    value = int.from_bytes(first + rest, "big") & ((1 << 7 * width) - 1)
    return None if value == (1 << 7 * width) - 1 or len(rest) < width - 1 else value
