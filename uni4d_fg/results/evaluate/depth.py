"""Dense depth errors of a video, streamed frame by frame: AbsRel, delta < 1.25, by region."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as SequenceOf
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.results.evaluate.flicker import FlickerAccumulator, ScaleFlicker
from uni4d_fg.results.evaluate.streaming import StreamingLine, StreamingLogMedian

DepthAlignment: TypeAlias = Literal["metric", "scale", "scale_shift_disparity"]
"""'metric': as predicted; 'scale': one factor per video, the median of truth / prediction over all scored
pixels; 'scale_shift_disparity': least-squares scale and shift of the disparity (1 / depth) per video."""

ALL_ALIGNMENTS: tuple[DepthAlignment, ...] = ("metric", "scale", "scale_shift_disparity")

_PROTOCOLS = {
    "metric": "no alignment",
    "scale": "one scale per video (median of truth / prediction)",
    "scale_shift_disparity": "one scale and shift per video (least squares in disparity)",
}


@dataclass(frozen=True)
class RegionDepthMetrics:
    """Errors over one region of a video; None where no pixel could be scored."""

    abs_rel: float | None
    """Mean of |prediction - truth| / truth."""
    delta_125: float | None
    """Share of pixels with max(prediction / truth, truth / prediction) < 1.25."""
    valid_pixels: int
    """Pixels scored: truth within the cap and prediction present."""
    missing_predictions: int
    """Pixels with truth within the cap but without a prediction; not scored."""
    frames_scored: int
    """Frames with at least one valid pixel."""
    frames_without_valid_pixels: int
    """Frames without one; they are counted here and score nothing."""


@dataclass(frozen=True)
class DepthMetrics:
    """Depth errors of one video under one alignment."""

    protocol: str
    """How the numbers were computed."""
    alignment: DepthAlignment
    max_depth_m: float
    """Truth beyond this is not scored; predictions are clipped to it."""
    scale: float
    """Factor on the depth (on the disparity for 'scale_shift_disparity')."""
    shift: float
    """Added to the disparity, 1/m; 0 for the other alignments."""
    regions: dict[str, RegionDepthMetrics]
    """By name: 'all', and with masks 'static', 'dynamic', 'instance 1', ..."""


@dataclass(frozen=True)
class DepthReport:
    """Every depth score of one video."""

    metrics: dict[str, DepthMetrics]
    """By alignment."""
    flicker: ScaleFlicker

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


@dataclass
class _RegionSums:
    relative_error: float = 0.0
    inliers: int = 0
    valid: int = 0
    missing: int = 0
    frames: int = 0


@dataclass
class _Alignment:
    name: DepthAlignment
    scale: float
    shift: float
    regions: dict[str, _RegionSums] = field(default_factory=dict)

    def apply(self, depth: FloatArray, max_depth_m: float) -> FloatArray:
        """Align predicted depths (N,) and clip them to the cap; disparities <= 0 are farther than it."""
        if self.name == "scale_shift_disparity":
            return 1.0 / np.maximum(self.scale / depth + self.shift, 1.0 / max_depth_m)
        return np.minimum(self.scale * depth, max_depth_m)


def evaluate_depth(
    prediction: FrameSource[Float32Array],
    ground_truth: FrameSource[Float32Array],
    masks: FrameSource[Int32Array] | None = None,
    *,
    alignments: SequenceOf[DepthAlignment] = ALL_ALIGNMENTS,
    max_depth_m: float = 70.0,
) -> DepthReport:
    """Score predicted depth maps; each frame is read twice and at most one is held at a time.

    Every pixel weighs the same. The alignment is fitted over all valid pixels of the video, whatever the
    region. A pixel is valid if 0 < truth <= cap and the prediction is finite and positive.

    Args:
        prediction: T maps (H, W), meters; NaN (or not positive) where missing.
        ground_truth: T maps (H, W), meters; NaN (or not positive) where unknown.
        masks: T label maps (H, W), 0 static; adds the regions static, dynamic and each instance.
        alignments: Which alignments to score.
        max_depth_m: Truth beyond this is not scored, predictions are clipped to it.

    Raises:
        InputError: If the numbers of frames or the image sizes disagree.
    """
    scale = StreamingLogMedian()
    disparity = StreamingLine()
    flicker = FlickerAccumulator()
    for predicted, truth, label in _frames(prediction, ground_truth, masks):
        valid = _has_truth(truth, max_depth_m) & _is_depth(predicted)
        p, g = predicted[valid].astype(np.float64), truth[valid].astype(np.float64)
        log_ratio = np.log(p / g)
        scale.add(-log_ratio)
        disparity.add(1.0 / p, 1.0 / g)
        flicker.add(log_ratio if label is None else log_ratio[label[valid] == 0])

    fitted = [_fit(name, scale, disparity) for name in alignments]
    for predicted, truth, label in _frames(prediction, ground_truth, masks):
        _score_frame(predicted, truth, label, fitted, max_depth_m)

    num_frames = len(ground_truth)
    metrics: dict[str, DepthMetrics] = {
        alignment.name: DepthMetrics(
            protocol=f"{_PROTOCOLS[alignment.name]}, cap {max_depth_m:g} m, mean over pixels",
            alignment=alignment.name,
            max_depth_m=max_depth_m,
            scale=alignment.scale,
            shift=alignment.shift,
            regions={name: _finish(sums, num_frames) for name, sums in _in_order(alignment.regions)},
        )
        for alignment in fitted
    }
    return DepthReport(metrics, flicker.result())


def _frames(
    prediction: FrameSource[Float32Array],
    ground_truth: FrameSource[Float32Array],
    masks: FrameSource[Int32Array] | None,
) -> Iterator[tuple[Float32Array, Float32Array, Int32Array | None]]:
    """Yield one frame's maps at a time, checked against each other."""
    counts = [len(prediction), len(ground_truth)] + ([] if masks is None else [len(masks)])
    if len(set(counts)) != 1:
        raise InputError(f"depth: prediction, ground truth (and masks) have {counts} frames; they must be equal")
    for frame in range(len(ground_truth)):
        predicted, truth = prediction[frame], ground_truth[frame]
        label = None if masks is None else masks[frame]
        if predicted.shape != truth.shape or (label is not None and label.shape != truth.shape):
            shapes = f"prediction {predicted.shape}, ground truth {truth.shape}"
            shapes += "" if label is None else f", mask {label.shape}"
            raise InputError(f"depth: frame {frame}: sizes disagree: {shapes}; resize them to the ground truth")
        yield predicted, truth, label


def _is_depth(depth: Float32Array) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.isfinite(depth) & (depth > 0.0)


def _has_truth(truth: Float32Array, max_depth_m: float) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return _is_depth(truth) & (truth <= max_depth_m)


def _fit(name: DepthAlignment, scale: StreamingLogMedian, disparity: StreamingLine) -> _Alignment:
    if name == "scale":
        return _Alignment(name, scale.median() or 1.0, 0.0)
    if name == "scale_shift_disparity":
        return _Alignment(name, *(disparity.fit() or (1.0, 0.0)))
    return _Alignment(name, 1.0, 0.0)


def _score_frame(
    predicted: Float32Array,
    truth: Float32Array,
    label: Int32Array | None,
    alignments: list[_Alignment],
    max_depth_m: float,
) -> None:
    """Add one frame to the sums of every alignment and region."""
    known = _has_truth(truth, max_depth_m)
    present = _is_depth(predicted)[known]
    p, g = predicted[known].astype(np.float64), truth[known].astype(np.float64)
    regions = _regions(None if label is None else label[known])
    for alignment in alignments:
        error = np.zeros(len(g))
        inlier = np.zeros(len(g), dtype=bool)
        aligned = alignment.apply(p[present], max_depth_m)
        error[present] = np.abs(aligned - g[present]) / g[present]
        inlier[present] = np.maximum(aligned / g[present], g[present] / aligned) < 1.25
        for name, members in regions:
            sums = alignment.regions.setdefault(name, _RegionSums())
            inside = present if members is None else present & members
            total = len(g) if members is None else int(members.sum())
            valid = int(inside.sum())
            sums.relative_error += float(error[inside].sum())
            sums.inliers += int(inlier[inside].sum())
            sums.valid += valid
            sums.missing += total - valid
            sums.frames += valid > 0


def _regions(label: Int32Array | None) -> list[tuple[str, BoolArray | None]]:
    """Return the regions of the labels (N,) of one frame's pixels with truth."""
    regions: list[tuple[str, BoolArray | None]] = [("all", None)]
    if label is not None:
        regions += [("static", label == 0), ("dynamic", label > 0)]
        regions += [(f"instance {i}", label == i) for i in np.unique(label[label > 0])]
    return regions


def _in_order(regions: dict[str, _RegionSums]) -> list[tuple[str, _RegionSums]]:
    """Sort the regions: all, static, dynamic, then the instances by number."""
    rank = {"all": -3, "static": -2, "dynamic": -1}
    return sorted(regions.items(), key=lambda item: rank.get(item[0]) or int(item[0].split()[-1]))


def _finish(sums: _RegionSums, num_frames: int) -> RegionDepthMetrics:
    return RegionDepthMetrics(
        abs_rel=sums.relative_error / sums.valid if sums.valid else None,
        delta_125=sums.inliers / sums.valid if sums.valid else None,
        valid_pixels=sums.valid,
        missing_predictions=sums.missing,
        frames_scored=sums.frames,
        frames_without_valid_pixels=num_frames - sums.frames,
    )
