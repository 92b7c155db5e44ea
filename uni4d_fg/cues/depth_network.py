"""Depth of one image by a network that a card describes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray
from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.card import DepthCard, ModelFile
from uni4d_fg.cues.preprocess import Placement, input_shape, place, prepare
from uni4d_fg.cues.session import Network
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.sequence.calibration import implausible

_SMALLEST_INVERSE = 1e-6


@dataclass(frozen=True)
class DepthEstimate:
    """What a network says of one frame."""

    values: Float32Array
    """(H, W): z-depth in meters, or disparity up to scale and shift (see ``is_affine``); NaN where missing."""
    intrinsics: FloatArray | None
    """(4,) fx, fy, cx, cy, px of the image; None where the network says nothing of use."""


class DepthNetwork:
    """A depth network.

    Args:
        model: Card and ONNX file.
        config: Provider and threads.

    Raises:
        ConfigError: If the card is not for depth.
        InputError: If the file is missing, damaged or does not fit the card.
        MissingDependencyError: If ONNX Runtime is not installed.
    """

    def __init__(self, model: ModelFile, config: NetworkConfig) -> None:
        card = model.card
        if not isinstance(card, DepthCard):
            raise ConfigError(f"{model.name}: this card is for {card.kind}, but one for depth is needed")
        self.card = card
        extra = [spec.name for spec in (card.confidence, card.intrinsics) if spec.name]
        outputs = tuple(dict.fromkeys((card.depth.name, *extra)))
        self.network = Network(model, {card.input.name: input_shape(card.input, card.size)}, outputs, config)

    @property
    def is_affine(self) -> bool:
        """Whether it gives disparity up to scale and shift instead of depth."""
        return self.card.depth.kind == "affine_disparity"

    @property
    def needs_focal(self) -> bool:
        """Whether its depth depends on the focal length of the camera."""
        return self.card.depth.kind == "canonical_depth"

    def estimate(self, image: ImageArray, focal_px: float) -> DepthEstimate:
        """Estimate the depth of one image.

        Args:
            image: (H, W, 3) uint8 RGB.
            focal_px: Focal length of the camera, px; of influence for a canonical camera only.

        Raises:
            InputError: If the network cannot be run, or gives other shapes than the card says.
        """
        card = self.card
        placement = place((image.shape[0], image.shape[1]), card.size)
        outputs = self.network.run({card.input.name: prepare(image, placement, card.input, card.size)[None]})
        depth = self._map(card.depth.name, outputs[card.depth.name], card.depth.channel)
        if card.confidence.name and card.confidence.minimum is not None:
            sure = self._map(card.confidence.name, outputs[card.confidence.name], card.confidence.channel)
            if sure.shape != depth.shape:
                raise self.network.misfit(card.confidence.name, sure.shape, f"that of the depth map, {depth.shape}")
            depth = np.where(sure >= card.confidence.minimum, depth, np.float32(np.nan))
        intrinsics = self._intrinsics(outputs, placement) if card.intrinsics.name else None
        if self.is_affine:
            return DepthEstimate(placement.restore(depth), intrinsics)
        if card.depth.kind == "inverse_depth":
            # Interpolated before it is inverted: disparity, not depth, is what the network means to be smooth.
            inverse = placement.restore(depth)
            metric = np.full_like(inverse, np.nan)
            np.divide(1.0, inverse, out=metric, where=np.isfinite(inverse) & (inverse > _SMALLEST_INVERSE))
        else:
            factor = 1.0
            if card.depth.canonical_focal_px is not None:
                factor = focal_px * float(placement.scale[0]) / card.depth.canonical_focal_px
            metric = placement.restore(depth * np.float32(factor))
        return DepthEstimate(self._within_bounds(metric), intrinsics)

    def _within_bounds(self, depth: Float32Array) -> Float32Array:
        bounds = self.card.depth
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(depth) & (depth > max(bounds.min_depth, 0.0))
            if bounds.max_depth is not None:
                valid &= depth <= bounds.max_depth
        return np.where(valid, depth, np.float32(np.nan))

    def _map(self, name: str, output: npt.NDArray[Any], channel: int | None) -> Float32Array:
        """Return one (h, w) map of an output that may have axes of length 1 and several channels."""
        values = output.astype(np.float32, copy=False)
        if channel is None:
            squeezed = values.squeeze()
            if squeezed.ndim != 2:
                raise self.network.misfit(name, output.shape, "one map (1, H, W); name its channel otherwise")
            return squeezed
        if values.ndim == 4 and values.shape[0] == 1:
            # There are fewer channels than columns.
            channels = values[0] if values.shape[1] <= values.shape[3] else values[0].transpose(2, 0, 1)
            if channel < len(channels):
                return np.asarray(channels[channel])
        raise self.network.misfit(name, output.shape, f"(1, C, H, W) or (1, H, W, C) with a channel {channel}")

    def _intrinsics(self, outputs: dict[str, npt.NDArray[Any]], placement: Placement) -> FloatArray | None:
        spec = self.card.intrinsics
        values = outputs[spec.name].astype(np.float64)
        height, width = placement.image_size
        center = np.array([(width - 1) / 2, (height - 1) / 2])
        if spec.kind == "matrix":
            if values.size != 9:
                raise self.network.misfit(spec.name, values.shape, "(1, 3, 3)")
            matrix = values.reshape(3, 3)
            at_input = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
            at_input[2:] -= spec.pixel_center
            found = placement.intrinsics_to_image(at_input)
        else:
            if values.size != 1:
                raise self.network.misfit(spec.name, values.shape, "one number")
            value = float(values.reshape(-1)[0])
            if spec.kind == "focal_px":
                focal = value / float(placement.scale[0])
            else:
                angle = np.deg2rad(value) if spec.kind == "fov_deg" else value
                focal = 0.5 * width / np.tan(0.5 * angle) if 0 < angle < np.pi else np.nan
            found = np.array([focal, focal, *center])
        return None if not np.isfinite(found).all() or implausible(found, placement.image_size) else found
