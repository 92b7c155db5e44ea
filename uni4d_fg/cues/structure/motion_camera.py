"""A camera that motion alone tells: intrinsics, distortion, and the focal length of every frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.lens import PARAMETERS, PINHOLE, Lens
from uni4d_fg.slam.lens.tracks import ideal_weight
from uni4d_fg.slam.stages.observations import Observations


@dataclass(frozen=True)
class MotionCamera:
    """A pinhole, or one with radial distortion, or one that zooms."""

    intrinsics: FloatArray
    """(4,) px, of the longest focal length."""
    lens: Lens = PINHOLE
    zoom: FloatArray | None = None
    """(T,) log focal length of each frame over that of the intrinsics, not positive; None where it does not zoom."""

    @property
    def is_plain(self) -> bool:
        """Whether real and ideal pixels are the same."""
        return self.lens.is_pinhole and self.zoom is None

    def ideal(self, uv: FloatArray, frame: IntArray) -> FloatArray:
        """Return where the pinhole of the longest focal length shows what is seen at pixels (N, 2) of frames (N,)."""
        uv = self.lens.ideal_pixels(self.intrinsics, uv)
        if self.zoom is None:
            return uv
        center = self.intrinsics[2:]
        return center + (uv - center) * np.exp(-self.zoom[frame])[:, None]

    def real(self, ideal: FloatArray, frame: IntArray) -> FloatArray:
        """Return where the images of frames (N,) show what that pinhole shows at pixels (N, 2)."""
        if self.zoom is not None:
            center = self.intrinsics[2:]
            ideal = center + (ideal - center) * np.exp(self.zoom[frame])[:, None]
        return self.lens.real_pixels(self.intrinsics, ideal)

    def ideal_weight(self, ideal: FloatArray, frame: IntArray) -> FloatArray:
        """Return the factor (N,) on weights: by which area of the image a pixel of that pinhole is seen."""
        weight = ideal_weight(self.lens, self.intrinsics, ideal)
        return weight if self.zoom is None else weight * np.exp(2.0 * self.zoom[frame])

    def ideal_observations(self, real: Observations) -> Observations:
        """Return observations at their ideal pixels; those that no direction reaches are left out."""
        if self.is_plain:
            return real
        uv = self.ideal(real.uv, real.frame)
        moved = replace(real, uv=uv, weight=real.weight * self.ideal_weight(uv, real.frame))
        return moved.select(np.asarray(np.isfinite(uv).all(axis=1)))

    def ideal_tracks(self, tracks: Tracks) -> Tracks:
        """Return tracks at their ideal pixels."""
        if self.is_plain:
            return tracks
        track, frame = np.nonzero(tracks.visible)
        moved = self.ideal(tracks.uv[track, frame].astype(np.float64), frame)
        uv, visible = tracks.uv.copy(), tracks.visible.copy()
        uv[track, frame] = moved.astype(np.float32)
        visible[track, frame] = np.isfinite(moved).all(axis=1)
        uv[~visible] = np.nan
        return replace(tracks, uv=uv, visible=visible)

    def with_intrinsics(self, intrinsics: FloatArray) -> MotionCamera:
        """Return the camera with other intrinsics (4,) and the same ideal pixels.

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
            focal = self.intrinsics[0] * np.exp(self.zoom)
            said.append(f"the camera zooms: fx from {focal.min():.1f} to {focal.max():.1f} px")
        return said

    def to_array(self) -> FloatArray:
        """Return lens and zoom as one array: number of the model, its four parameters, and the zoom if any."""
        zoom = np.zeros(0) if self.zoom is None else self.zoom
        return np.concatenate([[list(PARAMETERS).index(self.lens.model)], self.lens.padded, zoom])

    @classmethod
    def of_array(cls, array: FloatArray, intrinsics: FloatArray) -> MotionCamera:
        """Return what :meth:`to_array` returned of a camera with intrinsics (4,)."""
        lens = Lens.of(list(PARAMETERS)[int(array[0])], array[1:5])
        return cls(intrinsics, lens, array[5:] if len(array) > 5 else None)
