"""Tracks by a point-tracking network that a card describes, in windows, forwards and backwards in time.

Grids of queries start in every ``query_interval``-th frame. A sweep goes over the video in windows that overlap. In
its window a track is asked for at the frame where it starts; in the next one at the last frame of the overlap in
which it was seen, so that it goes on from there. A track that is not seen in the overlap ends. The second sweep does
the same with time reversed. Only the frames of one window are held.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.cache import FrameCache
from uni4d_fg.cues.card import ModelFile, TracksCard
from uni4d_fg.cues.preprocess import Placement, place, prepare
from uni4d_fg.cues.session import Network
from uni4d_fg.errors import Cancelled, ConfigError
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.track_model import Tracks

_DEFAULT_POINTS = 512
"""Points per call where the file takes any number."""

Progress = Callable[[int, int], None]


class PointTrackerNetwork:
    """A point tracker.

    Args:
        model: Card and ONNX file.
        config: Provider, threads and grid of queries.

    Raises:
        ConfigError: If the card is not for tracks.
        InputError: If the file is missing, damaged or does not fit the card.
        MissingDependencyError: If ONNX Runtime is not installed.
    """

    def __init__(self, model: ModelFile, config: NetworkConfig) -> None:
        card = model.card
        if not isinstance(card, TracksCard):
            raise ConfigError(f"{model.name}: this card is for {card.kind}, but one for tracks is needed")
        self.card = card
        self.config = config
        video, size = card.video, card.size
        image = (3, size.height, size.width) if video.axes == "NTCHW" else (size.height, size.width, 3)
        shapes = {card.input.name: (1, video.frames, *image), video.queries: (1, video.points, 3)}
        spec = card.outputs
        outputs = (spec.tracks, spec.visibility, *((spec.confidence,) if spec.confidence else ()))
        self.network = Network(model, shapes, outputs, config)

    def track(
        self,
        images: FrameSource[ImageArray],
        progress: Progress | None = None,
        should_stop: Callable[[], bool] | None = None,
        cache: FrameCache | None = None,
    ) -> Tracks:
        """Track grids of points through a video.

        Args:
            images: T images (H, W, 3) uint8 RGB.
            progress: Told the windows done and to do.
            should_stop: Asked before every window.
            cache: Keeps the result of every window, for this video, card and configuration alone.

        Returns:
            Tracks with confidence, seen in at least ``min_observations`` frames (or all of a shorter video).

        Raises:
            InputError: If the network cannot be run, or gives other shapes than the card says.
            Cancelled: If ``should_stop`` said so.
        """
        num_frames = len(images)
        first = images[0]
        placement = place((first.shape[0], first.shape[1]), self.card.size)
        starts = np.arange(0, num_frames, self.config.query_interval)
        grid = query_grid(placement.image_size, self.config)
        query_frame = np.repeat(starts, len(grid)).astype(np.int32)
        uv = np.full((len(query_frame), num_frames, 2), np.nan, np.float32)
        confidence = np.zeros((len(query_frame), num_frames), np.float32)
        queries = np.tile(grid, (len(starts), 1))
        windows = window_starts(num_frames, self.card.video.frames, self.card.overlap)
        done = 0
        for backward in (False, True):
            # The latest sighting of every track in this sweep: where the next window asks for it.
            seen_frame, seen_uv = query_frame.astype(np.int64).copy(), queries.astype(np.float64).copy()
            ended = np.zeros(len(query_frame), bool)
            for begin in windows:
                if should_stop is not None and should_stop():
                    raise Cancelled(f"tracking stopped at window {done} of {2 * len(windows)}")
                end = min(begin + self.card.video.frames, num_frames)
                frames = np.arange(begin, end)
                frames = num_frames - 1 - frames if backward else frames
                active = np.flatnonzero(~ended & np.isin(seen_frame, frames))
                # A track that was last seen before this window is lost to this sweep.
                passed = seen_frame > frames[0] if backward else seen_frame < frames[0]
                ended |= passed
                if len(active):
                    asked = np.abs(seen_frame[active] - frames[0])
                    name = f"{'back' if backward else 'forth'}-{begin:06d}"
                    found, probability = self._remembered(
                        cache, name, images, frames, placement, asked, seen_uv[active]
                    )
                    self._note(active, frames, asked, found, probability, uv, confidence)
                    _carry(
                        active, frames, asked, found, self._visible(probability, found, placement), seen_frame, seen_uv
                    )
                done += 1
                if progress is not None:
                    progress(done, 2 * len(windows))
        at_query = (np.arange(len(query_frame)), query_frame)
        uv[at_query], confidence[at_query] = queries, 1.0
        height, width = placement.image_size
        with np.errstate(invalid="ignore"):
            inside = (uv[..., 0] >= 0) & (uv[..., 0] < width) & (uv[..., 1] >= 0) & (uv[..., 1] < height)
        visible: BoolArray = inside & (confidence >= self.card.outputs.min_probability)
        keep = visible.sum(axis=1) >= min(self.config.min_observations, num_frames)
        uv[~visible] = np.nan
        return Tracks(uv[keep], visible[keep], query_frame[keep], confidence[keep])

    def _remembered(
        self, cache: FrameCache | None, name: str, images: FrameSource[ImageArray], frames: IntArray,
        placement: Placement, asked: IntArray, uv: FloatArray,
    ) -> tuple[Float32Array, Float32Array]:  # fmt: skip
        """Return what :meth:`_window` returns, from the cache where it is there."""
        if cache is None:
            return self._window(images, frames, placement, asked, uv)
        shape = (len(asked), len(frames))
        stored = cache.arrays(name, {"uv": 3, "probability": 2})
        if stored is not None and stored["uv"].shape == (*shape, 2) and stored["probability"].shape == shape:
            return stored["uv"], stored["probability"]
        found, probability = self._window(images, frames, placement, asked, uv)
        cache.put_arrays(name, uv=found, probability=probability)
        return found, probability

    def _visible(self, probability: Float32Array, uv: Float32Array, placement: Placement) -> BoolArray:
        height, width = placement.image_size
        inside = (uv >= 0).all(axis=2) & (uv[..., 0] < width) & (uv[..., 1] < height)
        result: BoolArray = inside & (probability >= self.card.outputs.min_probability)
        return result

    @staticmethod
    def _note(
        active: IntArray, frames: IntArray, asked: IntArray, found: Float32Array, probability: Float32Array,
        uv: Float32Array, confidence: Float32Array,
    ) -> None:  # fmt: skip
        """Write down what lies behind the frame where a track was asked for, as the sweep goes."""
        after = np.arange(len(frames)) > asked[:, None]
        rows, columns = np.nonzero(after)
        uv[active[rows], frames[columns]] = found[rows, columns]
        confidence[active[rows], frames[columns]] = probability[rows, columns]

    def _window(
        self, images: FrameSource[ImageArray], frames: IntArray, placement: Placement, asked: IntArray, uv: FloatArray
    ) -> tuple[Float32Array, Float32Array]:
        """Track points through one window.

        Args:
            images: The video.
            frames: (S,) its frames in the window, in the order in which they are shown.
            placement: Of an image in the input.
            asked: (N,) index into ``frames`` where each point is known.
            uv: (N, 2) where it is there, px of the image.

        Returns:
            uv (N, S, 2) px of the image; probability (N, S) that it is seen there.
        """
        card = self.card
        length = card.video.frames
        shown = [prepare(images[int(frame)], placement, card.input, card.size) for frame in frames]
        # The last window of a short video is filled with its last frame.
        video = np.stack(shown + [shown[-1]] * (length - len(shown)))[None]
        if card.video.axes == "NTCHW" and card.input.layout == "NHWC":
            video = video.transpose(0, 1, 4, 2, 3)
        elif card.video.axes == "NTHWC" and card.input.layout == "NCHW":
            video = video.transpose(0, 1, 3, 4, 2)
        at_input = placement.to_input(uv) + card.video.pixel_center
        columns = (asked[:, None], at_input) if card.video.query_order == "txy" else (asked[:, None], at_input[:, ::-1])
        queries = np.concatenate(columns, axis=1).astype(np.float32)
        chunk = card.video.points or min(_DEFAULT_POINTS, len(queries))
        parts = [
            self._points(video, queries[begin : begin + chunk], chunk, placement)
            for begin in range(0, len(queries), chunk)
        ]
        found = np.concatenate([part[0] for part in parts])
        probability = np.concatenate([part[1] for part in parts])
        return found[:, : len(frames)], probability[:, : len(frames)]

    def _points(
        self, video: npt.NDArray[Any], queries: Float32Array, chunk: int, placement: Placement
    ) -> tuple[Float32Array, Float32Array]:
        card, spec = self.card, self.card.outputs
        count = len(queries)
        filled = np.concatenate((queries, np.repeat(queries[-1:], chunk - count, axis=0)))
        outputs = self.network.run({card.input.name: video, card.video.queries: filled[None]})
        shape = (1, card.video.frames, chunk) if spec.order == "TN" else (1, chunk, card.video.frames)
        positions = outputs[spec.tracks]
        if positions.shape != (*shape, 2):
            raise self.network.misfit(spec.tracks, positions.shape, str((*shape, 2)))
        probability = self._probability(spec.visibility, outputs, shape, spec.visibility_kind)
        if spec.confidence:
            probability = probability * self._probability(spec.confidence, outputs, shape, spec.confidence_kind)
        if spec.order == "TN":
            positions, probability = positions.swapaxes(1, 2), probability.swapaxes(1, 2)
        uv = placement.to_image(positions[0, :count].astype(np.float64) - card.video.pixel_center)
        return uv.astype(np.float32), probability[0, :count].astype(np.float32)

    def _probability(
        self, name: str, outputs: dict[str, npt.NDArray[Any]], shape: tuple[int, ...], kind: str
    ) -> Float32Array:
        values = outputs[name]
        if values.size != np.prod(shape) or values.shape[: len(shape)] != shape:
            raise self.network.misfit(name, values.shape, str(shape))
        numbers = values.reshape(shape).astype(np.float32)
        if kind == "probability":
            return numbers
        sign = np.float32(1.0 if kind in ("occlusion_logit", "error_logit") else -1.0)
        return np.asarray(1 / (1 + np.exp(np.clip(sign * numbers, -80, 80))), np.float32)


def query_grid(image_size: tuple[int, int], config: NetworkConfig) -> Float32Array:
    """Return the query points (rows * columns, 2) in px, row by row, of an image of (height, width)."""
    height, width = image_size
    margin_x, margin_y = (min(config.margin_px, (side - 1) / 2) for side in (width, height))
    columns = np.linspace(margin_x, width - 1 - margin_x, config.grid_columns)
    rows = np.linspace(margin_y, height - 1 - margin_y, config.grid_rows)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float32)


def window_starts(num_frames: int, length: int, overlap: int) -> list[int]:
    """Return the first frames of windows of ``length`` that cover a video; each shares ``overlap`` or more."""
    if num_frames <= length:
        return [0]
    starts = list(range(0, num_frames - length, length - overlap))
    return [*starts, num_frames - length]


def _carry(
    active: IntArray, frames: IntArray, asked: IntArray, found: Float32Array, visible: BoolArray,
    seen_frame: IntArray, seen_uv: FloatArray,
) -> None:  # fmt: skip
    """Move the latest sighting of every active track to the last frame of the window in which it is seen."""
    behind = visible & (np.arange(len(frames)) > asked[:, None])
    last = len(frames) - 1 - behind[:, ::-1].argmax(axis=1)
    moved = behind.any(axis=1)
    rows = np.flatnonzero(moved)
    seen_frame[active[rows]] = frames[last[rows]]
    seen_uv[active[rows]] = found[rows, last[rows]]
