"""What is known of a camera, and what a pinhole in its place would have seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.geometry.lens import PARAMETERS, PINHOLE, Lens
from uni4d_fg.slam.stages.observations import Observations


@dataclass(frozen=True)
class CameraModel:
    """A pinhole, or a camera with a lens that distorts, or one that zooms.

    Cameras are solved on ideal pixels: those of a pinhole that does not zoom, with the same intrinsics.
    """

    intrinsics: FloatArray
    """(4,) px, of the longest focal length."""
    lens: Lens = PINHOLE
    zoom: FloatArray | None = None
    """(T,) focal length of each frame over that one; None where the camera does not zoom."""
    focal_sigma: float | None = None
    """Standard deviation of the log focal length where camera motion told it with the rest; else None."""

    @classmethod
    def of_log_zoom(cls, intrinsics: FloatArray, log_zoom: FloatArray) -> CameraModel:
        """Return a pinhole whose focal lengths are ``exp(log_zoom)`` (T,) times those of intrinsics (4,), px."""
        longest, log_zoom = of_longest_focal(intrinsics, log_zoom)
        return cls(longest, zoom=np.exp(log_zoom))

    @property
    def is_plain(self) -> bool:
        """Whether real and ideal pixels are the same."""
        return self.lens.is_pinhole and self.zoom is None

    def ideal(self, uv: FloatArray, frame: IntArray) -> FloatArray:
        """Return where the pinhole shows what is seen at pixels (N, 2) of frames (N,); NaN where no direction is."""
        uv = self.lens.ideal_pixels(self.intrinsics, uv)
        if self.zoom is None:
            return uv
        center = self.intrinsics[2:]
        return center + (uv - center) / self.zoom[frame][:, None]

    def real(self, ideal: FloatArray, frame: IntArray) -> FloatArray:
        """Return where the images of frames (N,) show what the pinhole shows at pixels (N, 2)."""
        if self.zoom is not None:
            center = self.intrinsics[2:]
            ideal = center + (ideal - center) * self.zoom[frame][:, None]
        return self.lens.real_pixels(self.intrinsics, ideal)

    def ideal_weight(self, ideal: FloatArray, frame: IntArray) -> FloatArray:
        """Return the factor (N,), in (0, 1], on weights of observations at ideal pixels (N, 2) of frames (N,).

        Where the lens squeezes the image, or the focal length is shorter, an ideal pixel is less sure than a real one:
        by the area of the image on which it is seen, which is what the noise of a pixel then is in the pinhole.
        """
        with np.errstate(invalid="ignore"):
            weight: FloatArray = np.clip(self.lens.magnification(self.intrinsics, ideal), 1e-6, 1.0)
        return weight if self.zoom is None else weight * self.zoom[frame] ** 2

    def ideal_observations(self, real: Observations) -> Observations:
        """Return observations at their ideal pixels; those that no direction reaches are left out."""
        if self.is_plain:
            return real
        uv = self.ideal(real.uv, real.frame)
        moved = replace(real, uv=uv, weight=real.weight * self.ideal_weight(uv, real.frame))
        return moved.select(np.asarray(np.isfinite(uv).all(axis=1)))

    def ideal_tracks(self, tracks: Tracks) -> Tracks:
        """Return tracks at their ideal pixels; what no direction reaches counts as not visible."""
        if self.is_plain:
            return tracks
        track, frame = np.nonzero(tracks.visible)
        moved = self.ideal(tracks.uv[track, frame].astype(np.float64), frame)
        uv, visible = tracks.uv.copy(), tracks.visible.copy()
        uv[track, frame] = moved.astype(np.float32)
        visible[track, frame] = np.isfinite(moved).all(axis=1)
        uv[~visible] = np.nan
        return replace(tracks, uv=uv, visible=visible)

    def ideal_labelled(self, labelled: LabelledTracks) -> LabelledTracks:
        """Return labelled tracks at their ideal pixels, with the weights that they have there."""
        if self.is_plain:
            return labelled
        tracks, weight = self.ideal_tracks(labelled.tracks), np.zeros_like(labelled.weight)
        track, frame = np.nonzero(tracks.visible)
        there = self.ideal_weight(tracks.uv[track, frame].astype(np.float64), frame)
        weight[track, frame] = labelled.weight[track, frame] * there
        return replace(labelled, tracks=tracks, weight=weight)

    def with_intrinsics(self, intrinsics: FloatArray) -> CameraModel:
        """Return the camera with other intrinsics (4,) and the same ideal pixels; its lens has radial terms only.

        These are at ``f x (1 + k1 r^2 + ..)``, r = |x| in a plane at distance one: with f another, the same r in
        pixels is another |x|, so that k1 grows with f^2 and k2 with f^4.
        """
        ratio = float(np.mean(intrinsics[:2]) / np.mean(self.intrinsics[:2]))
        powers = [ratio ** (2 * (n + 1)) for n in range(len(self.lens.parameters))]
        parameters = tuple(k * power for k, power in zip(self.lens.parameters, powers, strict=True))
        return replace(self, intrinsics=intrinsics.copy(), lens=replace(self.lens, parameters=parameters))

    def facts(self) -> list[str]:
        """Say in words what is not that of a pinhole."""
        said = []
        if not self.lens.is_pinhole:
            values = zip(PARAMETERS[self.lens.model], self.lens.parameters, strict=True)
            said.append(
                f"camera model {self.lens.model}, " + ", ".join(f"{name} {value:.4f}" for name, value in values)
            )
        if self.zoom is not None:
            focal = self.intrinsics[0] * self.zoom
            said.append(f"the camera zooms: fx from {focal.min():.1f} to {focal.max():.1f} px")
        return said

    def to_array(self) -> FloatArray:
        """Return lens and zoom as one array: number of the model, its four parameters, and the zoom if any."""
        zoom = np.zeros(0) if self.zoom is None else self.zoom
        return np.concatenate([[list(PARAMETERS).index(self.lens.model)], self.lens.padded, zoom])

    @classmethod
    def of_array(cls, array: FloatArray, intrinsics: FloatArray) -> CameraModel:
        """Return what :meth:`to_array` returned of a camera with intrinsics (4,)."""
        lens = Lens.of(list(PARAMETERS)[int(array[0])], array[1:5])
        return cls(intrinsics, lens, array[5:] if len(array) > 5 else None)


def of_longest_focal(intrinsics: FloatArray, log_zoom: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the intrinsics (4,), px, of the frame with the longest focal length, and the zoom (T,) relative to it.

    Args:
        intrinsics: (4,) px.
        log_zoom: (T,) log focal length of each frame over theirs.
    """
    longest, most = intrinsics.copy(), float(log_zoom.max())
    longest[:2] *= np.exp(most)
    return longest, log_zoom - most
