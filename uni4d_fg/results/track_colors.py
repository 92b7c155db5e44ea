"""Colors of tracks, from the images."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import ImageArray, Int32Array
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.frontend.track_model import LabelledTracks


def track_colors(sequence: Sequence | Video, labelled: LabelledTracks, tracks: Int32Array) -> ImageArray:
    """Return the image color of each track in the first frame that shows it, (N, 3) RGB."""
    out = np.zeros((len(tracks), 3), dtype=np.uint8)
    if len(tracks) == 0:
        return out
    first = np.argmax(labelled.weight[tracks] > 0, axis=1)
    height, width = sequence.image_size
    for frame in np.unique(first).tolist():
        mine = np.flatnonzero(first == frame)
        uv = np.rint(labelled.tracks.uv[tracks[mine], frame]).astype(np.int64)
        image = sequence.images[frame]
        out[mine] = image[np.clip(uv[:, 1], 0, height - 1), np.clip(uv[:, 0], 0, width - 1)]
    return out
