"""Tracks on ideal pixels: what a pinhole would have seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.geometry.lens import Lens


def ideal_tracks(labelled: LabelledTracks, intrinsics: FloatArray, lens: Lens) -> LabelledTracks:
    """Move every observation to its ideal pixel.

    Where the lens squeezes the image, an ideal pixel is less sure than a real one: weights are lowered by the
    magnification, which is what the noise of a pixel then is in the pinhole. Observations in pixels that no direction
    in front of the camera reaches count as not visible.

    Args:
        labelled: Observations on real pixels.
        intrinsics: (4,) px.
        lens: What is undone; the tracks are returned as they are for a pinhole.
    """
    if lens.is_pinhole:
        return labelled
    tracks = labelled.tracks
    uv = lens.ideal_pixels(intrinsics, tracks.uv.astype(np.float64))
    visible = tracks.visible & np.isfinite(uv).all(axis=2)
    uv[~visible] = np.nan
    weight = np.where(visible, labelled.weight * ideal_weight(lens, intrinsics, uv), 0.0)
    moved = Tracks(uv.astype(np.float32), visible, tracks.query_frame, tracks.confidence)
    return replace(labelled, tracks=moved, weight=weight.astype(np.float32))


def ideal_weight(lens: Lens, intrinsics: FloatArray, ideal: FloatArray) -> FloatArray:
    """Return the factor, in (0, 1], on the weights of observations at ideal pixels (..., 2)."""
    with np.errstate(invalid="ignore"):
        size: FloatArray = np.clip(lens.magnification(intrinsics, ideal), 1e-6, 1.0)
    return size


def unzoomed_tracks(labelled: LabelledTracks, intrinsics: FloatArray, zoom: FloatArray) -> LabelledTracks:
    """Move every observation to where a camera without zoom would have seen it.

    A pixel of a shorter focal length is less sure on that camera: weights are lowered by the area it covers there.

    Args:
        labelled: Observations on real pixels.
        intrinsics: (4,) px, of the longest focal length; the principal point is the center of the zoom.
        zoom: (T,) log focal length of each frame over that of the intrinsics, not positive.
    """
    tracks, center = labelled.tracks, intrinsics[2:]
    factor = np.exp(-zoom)[None, :, None]
    uv = (center + (tracks.uv - center) * factor).astype(np.float32)
    weight = labelled.weight * np.exp(2.0 * zoom)[None].astype(np.float32)
    return replace(labelled, tracks=replace(tracks, uv=uv), weight=weight.astype(np.float32))
