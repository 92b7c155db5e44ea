"""Where all pixels of small images would be seen in other frames of a static scene, through any camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.cues.static_scene import StaticPrediction, predict_static_at
from uni4d_fg.cues.track_motion import SharedError
from uni4d_fg.frontend.sequence.resize import scale_intrinsics
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.reconstruction import zoomed


@dataclass(frozen=True)
class PixelGrid:
    """All pixels of images of one size."""

    camera: CameraModel
    """Of that size."""
    columns: Float32Array
    """Of the pixels, or of the ideal ones of a lens, of a shape that NumPy broadcasts to (h, w)."""
    rows: Float32Array
    scale: FloatArray
    """(2,) pixels per pixel of the images, x and y."""

    @classmethod
    def of(cls, camera: CameraModel, size: tuple[int, int], image_size: tuple[int, int]) -> PixelGrid:
        """Return the grid of images of (h, w) ``size``, of a camera whose images have ``image_size``."""
        scale = np.array([size[1] / image_size[1], size[0] / image_size[0]])
        intrinsics = scale_intrinsics(camera.intrinsics, image_size, size)
        camera = replace(camera, intrinsics=intrinsics)
        columns, rows = np.arange(size[1], dtype=np.float32), np.arange(size[0], dtype=np.float32)[:, None]
        if camera.lens.is_pinhole:
            return cls(camera, columns, rows, scale)
        pixels = np.stack(np.broadcast_arrays(columns, rows), axis=-1).astype(np.float64)
        ideal = camera.lens.ideal_pixels(intrinsics, pixels).astype(np.float32)
        return cls(camera, np.ascontiguousarray(ideal[..., 0]), np.ascontiguousarray(ideal[..., 1]), scale)

    def predict(self, z: Float32Array, target_T_source: FloatArray, source: int, target: int) -> StaticPrediction:
        """Return where the pixels of a frame with depth z (h, w) are seen in another; NaN where no ray is known.

        Derivatives are those of ideal pixels: what they weigh needs no more.
        """
        own, other = self._intrinsics(source), self._intrinsics(target)
        static = predict_static_at(self.columns, self.rows, z, target_T_source, own, other)
        if self.camera.lens.is_pinhole:
            return static
        ideal = np.stack([static.u, static.v], axis=-1).astype(np.float64)
        real = self.camera.lens.real_pixels(self.camera.intrinsics, ideal).astype(np.float32)
        return replace(static, u=real[..., 0], v=real[..., 1])

    def displacement(self, error: SharedError, source: int, target: int) -> tuple[Float32Array, Float32Array]:
        """Return what tracks of two frames share at ideal pixels of the images, as displacements (h, w) in x and y.

        Through a lens they are taken as they are: that they are squeezed there matters less than that they are known.
        """
        (cx, cy), zoom = self.camera.intrinsics[2:], self.camera.zoom
        shrunk, grown = (1.0, 1.0) if zoom is None else (1.0 / zoom[source], zoom[target])
        u, v = (
            (center + (at - center) * shrunk + 0.5) / scale - 0.5
            for at, center, scale in ((self.columns, cx, self.scale[0]), (self.rows, cy, self.scale[1]))
        )
        x, y = (part * grown * scale for part, scale in zip(error.at(u, v), self.scale, strict=True))
        return np.asarray(x, np.float32), np.asarray(y, np.float32)

    def _intrinsics(self, frame: int) -> FloatArray:
        intrinsics, zoom = self.camera.intrinsics, self.camera.zoom
        return intrinsics if zoom is None else zoomed(intrinsics, zoom[frame : frame + 1], 1)[0]
