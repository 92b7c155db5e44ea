"""Which dynamic tracks are neighbors: the links of as-rigid-as-possible."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray


def nearest_neighbors(
    points: FloatArray, observed: BoolArray, instance: IntArray, count: int, max_ratio: float
) -> tuple[IntArray, IntArray]:
    """Link every trajectory to its nearest neighbors of the same instance.

    Neighbors are searched in the frame in which most of the instance's trajectories are seen together with
    the trajectory itself: of the frames that see it, the one with the largest number of seen trajectories.

    Args:
        points: (M, T, 3) starting points, world; NaN where there is none.
        observed: (M, T).
        instance: (M,) mask ids; only trajectories of one instance are linked.
        count: Neighbors per trajectory.
        max_ratio: Links longer than this many times the instance's median link are dropped.

    Returns:
        (L, 2) pairs of trajectories, first < second, each once, and how often each was found, (L,): 2 where each is a
        neighbor of the other, else 1.
    """
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    usable = observed & np.isfinite(points).all(axis=2)
    for label in np.unique(instance).tolist():
        members = np.flatnonzero(instance == label)
        if count == 0 or len(members) < 2:
            continue
        seen = usable[members]
        crowd = seen.sum(axis=0)
        frame_of = np.argmax(np.where(seen, crowd, -1), axis=1)
        found, lengths = [], []
        for frame in np.unique(frame_of[seen.any(axis=1)]).tolist():
            present = members[seen[:, frame]]
            asking = members[(frame_of == frame) & seen[:, frame]]
            k = min(count + 1, len(present))
            if k < 2:
                continue
            distance, index = cKDTree(points[present, frame]).query(points[asking, frame], k=k)
            other = present[index]
            own = np.repeat(asking[:, None], k, axis=1)
            real = other != own
            found.append(np.stack([own[real], other[real]], axis=1))
            lengths.append(distance[real])
        if found:
            pair, length = np.concatenate(found), np.concatenate(lengths)
            pairs.append(np.sort(pair[length <= max_ratio * np.median(length)], axis=1))
    unique, found_times = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    return unique, found_times.astype(np.int64)
