"""Videos as cameras store them: H.264 through PyAV (``pip install av``)."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import numpy as np

from uni4d_fg.arrays import ImageArray


def encode(images: Iterable[ImageArray], file: Path | BinaryIO, fps: float, kbps: int, threads: int = 0) -> None:
    """Write images (H, W, 3) as an MP4 of a bit rate in kbit/s; ``threads`` 0 lets the encoder choose."""
    import av

    with av.open(str(file) if isinstance(file, Path) else file, "w", format="mp4") as container:
        stream = None
        for image in images:
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt, stream.bit_rate, stream.thread_count = "yuv420p", 1000 * kbps, threads
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        if stream is not None:
            container.mux(stream.encode())


def decoded(file: Path | BinaryIO) -> ImageArray:
    """Return the frames (T, H, W, 3) of a video."""
    import av

    with av.open(str(file) if isinstance(file, Path) else file) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
