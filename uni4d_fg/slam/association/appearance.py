r"""Whether two landmarks look the same: patches around their projections, compared under the solved geometry.

The patch of one view is brought into the other by the affine map of its surroundings, taken as a piece of a plane
parallel to its image at the landmark's depth z:

    A = d pi_j(T_j^{-1} T_i pi_i^{-1}(u, z)) / du        2 x 2, at the landmark's pixel u in view i.

Normalized cross-correlation over offsets of up to two pixels then gives how alike they look and where the best match
lies. Patches are cut at the projections of the landmarks, not at single observations, whose noise is larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.rejoin import RejoinConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.slam.association.candidates import Candidates
from uni4d_fg.slam.stages.observations import Observations

_SEARCH_PX = 2
_NEAREST_VIEW, _FARTHEST_VIEW = 0.1, 0.6
"""The compared views, as parts of a fragment's observations counted from the gap."""
_CHUNK = 512
"""Pairs that are compared at once, for the sake of memory."""
_LARGEST_STRETCH = 2.0
"""Views that differ by more in scale are not compared."""


@dataclass(frozen=True)
class Likeness:
    """How alike P pairs of landmarks look, in the pair of views in which they look most alike."""

    correlation: FloatArray
    """(P,) in [-1, 1]; -1 where nothing can be compared."""
    offset_px: FloatArray
    """(P,) distance of the best match from the projection; infinite where nothing can be compared."""


def compare(
    images: FrameSource[ImageArray],
    raw_uv: Float32Array,
    state: State,
    observations: Observations,
    pairs: Candidates,
    config: RejoinConfig,
) -> Likeness:
    """Compare the patches of every pair of landmarks in the views on both sides of the gap.

    Args:
        images: T images; only those needed are read, each once.
        raw_uv: (K, T, 2) px of the tracks in these images (the observations' own pixels are those of a pinhole).
        state: Solved cameras and landmarks, ascending by track.
        observations: Their observations.
        pairs: P pairs of landmark rows.
        config: Size and number of the patches.
    """
    best = Likeness(np.full(len(pairs), -1.0), np.full(len(pairs), np.inf))
    if len(pairs) == 0:
        return best
    _, row = observations.rows()
    count = np.bincount(row)
    start = np.cumsum(count) - count
    half = config.patch_px // 2
    reach = int(np.ceil(half * _LARGEST_STRETCH))
    cutter = _Cutter(images, raw_uv, state, observations)
    # Views are spread over each fragment: right at the gap, what hides the point is often in the patch.
    for view in np.linspace(_NEAREST_VIEW, _FARTHEST_VIEW, config.views):
        source = start[pairs.earlier] + ((1.0 - view) * (count[pairs.earlier] - 1)).astype(np.int64)
        target = start[pairs.later] + (view * (count[pairs.later] - 1)).astype(np.int64)
        stretch, usable = _stretch(state, observations, source, target, pairs.earlier)
        use = np.flatnonzero(usable)
        if len(use) == 0:
            continue
        here = cutter.windows(source[use], pairs.earlier[use], reach)
        there = cutter.windows(target[use], pairs.later[use], half + _SEARCH_PX)
        for first in range(0, len(use), _CHUNK):
            part = slice(first, first + _CHUNK)
            reference = _warped(here[part], stretch[use[part]], half)
            correlation, offset = _match(reference, there[part], config.min_contrast)
            chosen = correlation > best.correlation[use[part]]
            better = use[part][chosen]
            best.correlation[better], best.offset_px[better] = correlation[chosen], offset[chosen]
    return best


@dataclass(frozen=True)
class _Cutter:
    images: FrameSource[ImageArray]
    raw_uv: Float32Array
    state: State
    observations: Observations

    def windows(self, observation: IntArray, landmark: IntArray, reach: int) -> Float32Array:
        """Return gray windows (N, 2 reach + 1, 2 reach + 1) around where the landmarks project, NaN off the image."""
        seen = self.observations.select(observation)
        x = world_to_camera(self.state[POSE][seen.frame], self.state[LANDMARK][landmark])
        center = self.raw_uv[seen.track, seen.frame] + (project(self.state[INTRINSICS][0], x) - seen.uv)
        side, grid = 2 * reach + 1, np.arange(-reach, reach + 1)
        out = np.full((len(seen), side, side), np.nan, np.float32)
        for frame in np.unique(seen.frame):
            image = self.images[int(frame)]
            gray = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
            size = np.array(gray.shape[::-1])
            members = np.flatnonzero(seen.frame == frame)
            inside = ((center[members] >= 0) & (center[members] <= size - 1)).all(axis=1)
            for n in members[inside]:
                u, v = center[n].tolist()
                out[n] = cv2.getRectSubPix(gray, (side, side), (u, v), patchType=cv2.CV_32F)
                if not (reach <= u <= size[0] - 1 - reach and reach <= v <= size[1] - 1 - reach):
                    column, line = u + grid, v + grid
                    out[n][:, (column < 0) | (column > size[0] - 1)] = np.nan
                    out[n][(line < 0) | (line > size[1] - 1)] = np.nan
        return out


def _stretch(
    state: State, observations: Observations, source: IntArray, target: IntArray, landmark: IntArray
) -> tuple[FloatArray, BoolArray]:
    """Return the maps A (N, 2, 2) from source to target observations of landmarks, and whether they are moderate."""
    poses, intrinsics = state[POSE], state[INTRINSICS][0]
    here, there = poses[observations.frame[source]], poses[observations.frame[target]]
    x = world_to_camera(here, state[LANDMARK][landmark])
    uv = np.asarray(project(intrinsics, x))
    columns = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        ends = [
            project(intrinsics, world_to_camera(there, camera_to_world(here, unproject(intrinsics, moved, x[:, 2]))))
            for moved in (uv + step, uv - step)
        ]
        columns.append(0.5 * (ends[0] - ends[1]))
    stretch = np.stack(columns, axis=-1)
    singular = np.linalg.svd(stretch, compute_uv=False)
    moderate = (singular.max(axis=1) <= _LARGEST_STRETCH) & (singular.min(axis=1) >= 1.0 / _LARGEST_STRETCH)
    return stretch, np.asarray(moderate & np.isfinite(singular).all(axis=1))


def _warped(windows: Float32Array, stretch: FloatArray, half: int) -> FloatArray:
    """Sample windows (N, S, S) at A^{-1} d for the offsets d of a patch; returns (N, 2 half + 1, 2 half + 1)."""
    reach = windows.shape[1] // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    offset = np.stack((u.ravel(), v.ravel()))
    at = np.linalg.inv(stretch) @ offset + reach
    limit = windows.shape[1] - 1
    outside = ((at < 0) | (at > limit)).any(axis=1)
    at = np.clip(at, 0, limit - 1e-6)
    low = at.astype(np.int64)
    fu, fv = at[:, 0] - low[:, 0], at[:, 1] - low[:, 1]
    n = np.arange(len(windows))[:, None]
    column, line = low[:, 0], low[:, 1]
    top = windows[n, line, column] * (1 - fu) + windows[n, line, column + 1] * fu
    bottom = windows[n, line + 1, column] * (1 - fu) + windows[n, line + 1, column + 1] * fu
    sampled = np.where(outside, np.nan, top * (1 - fv) + bottom * fv)
    result: FloatArray = sampled.reshape(len(windows), 2 * half + 1, 2 * half + 1)
    return result


def _match(reference: FloatArray, searched: Float32Array, min_contrast: float) -> tuple[FloatArray, FloatArray]:
    """Return the highest correlation (N,) of patches (N, P, P) in windows (N, P + 4, P + 4), and its offset (N,) px.

    -1 and infinity where a patch leaves the image, has too little contrast, or fits best at the edge of the search.
    """
    size = reference.shape[1]
    shifted = sliding_window_view(searched, (size, size), axis=(1, 2)).astype(np.float64)
    patch = reference - reference.mean(axis=(1, 2), keepdims=True)
    spread = np.sqrt(np.mean(patch**2, axis=(1, 2)))
    mean = shifted.mean(axis=(3, 4))
    deviation = np.sqrt(np.maximum(np.mean(shifted**2, axis=(3, 4)) - mean**2, 0.0))
    product = np.einsum("nabuv,nuv->nab", shifted, patch) / size**2
    with np.errstate(invalid="ignore", divide="ignore"):
        score = product / (deviation * spread[:, None, None])
    middle = deviation[:, _SEARCH_PX, _SEARCH_PX]
    usable = np.isfinite(score).all(axis=(1, 2)) & (np.minimum(spread, middle) >= min_contrast)
    score[~usable] = -1.0
    side = score.shape[1]
    peak = score.reshape(len(score), -1).argmax(axis=1)
    line, column = np.divmod(peak, side)
    interior = usable & (line > 0) & (line < side - 1) & (column > 0) & (column < side - 1)
    n = np.arange(len(score))
    line, column = np.clip(line, 1, side - 2), np.clip(column, 1, side - 2)
    du = column - _SEARCH_PX + _vertex(*(score[n, line, column + s] for s in (-1, 0, 1)))
    dv = line - _SEARCH_PX + _vertex(*(score[n, line + s, column] for s in (-1, 0, 1)))
    correlation = np.where(interior, score[n, line, column], -1.0)
    return correlation, np.where(interior, np.hypot(du, dv), np.inf)


def _vertex(before: FloatArray, at: FloatArray, after: FloatArray) -> FloatArray:
    """Return where the parabola through three values at -1, 0, 1 is highest."""
    bend = before - 2.0 * at + after
    with np.errstate(invalid="ignore", divide="ignore"):
        result: FloatArray = np.where(bend < 0, np.clip(0.5 * (before - after) / bend, -0.5, 0.5), 0.0)
    return result
