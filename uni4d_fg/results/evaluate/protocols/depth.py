"""Video depth: AbsRel and delta < 1.25 after one alignment per video, as the programs behind published tables do it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.results.evaluate.protocols.fits import (
    Line,
    adam_absolute,
    least_squares,
    median_scale,
    weiszfeld_scale,
)

Fit: TypeAlias = Literal["none", "median", "weiszfeld", "lstsq", "adam"]

_FITS: dict[Fit, tuple[str, Callable[[Any, Any], Line]]] = {
    "none": ("no alignment", lambda x, y: Line()),
    "median": ("one scale per video, ratio of the medians", median_scale),
    "weiszfeld": ("one scale per video, 10 reweightings towards least absolute deviations", weiszfeld_scale),
    "lstsq": ("one scale and shift per video, least squares", least_squares),
    "adam": ("one scale and shift per video, 1,000 steps of Adam on absolute deviations", adam_absolute),
}


@dataclass(frozen=True)
class DepthRange:
    """Which depths count, and what predictions are clipped to; None for no bound."""

    truth_min_m: float = 0.0
    """Truth must be larger."""
    truth_max_m: float | None = None
    """Truth must be smaller."""
    clip_min_m: float | None = None
    clip_max_m: float | None = None


@dataclass(frozen=True)
class DepthProtocol:
    """One way to score the depth of a video."""

    name: str
    source: str
    """Whose program does so."""
    fit: Fit
    disparity: bool
    """Align 1 / depth instead of depth."""
    ranges: Mapping[str, DepthRange] = field(default_factory=dict)
    """By dataset; that of '' for the others."""
    far_disparity: float = 0.0
    """Disparities below this, 1/m, become this, before and after the fit. 0: those that are not positive after
    it become a depth of 0, as in the programs, which is as wrong as can be."""
    over_frames: bool = False
    """Average over the pixels of a frame first, then over frames; else over all pixels of the video."""
    over_videos: bool = False
    """Average over videos alike; else by their numbers of pixels."""

    def range_of(self, dataset: str) -> DepthRange:
        """Return the range for a dataset (``sintel-clean`` counts as ``sintel``)."""
        return self.ranges.get(dataset.split("-")[0], self.ranges.get("", DepthRange()))

    def text(self, dataset: str) -> str:
        """Return in words what is done."""
        bounds = self.range_of(dataset)
        upper = "no cap" if bounds.truth_max_m is None else f"truth < {bounds.truth_max_m:g} m"
        clip = "not clipped" if bounds.clip_max_m is None else f"clipped to {bounds.clip_max_m:g} m"
        space = "" if self.fit == "none" else f" in {'disparity' if self.disparity else 'depth'}"
        return (
            f"{_FITS[self.fit][0]}{space}; {upper}, predictions {clip}; mean over "
            f"{'frames' if self.over_frames else 'pixels'} ({self.source})"
        )


_MONST3R = {
    "sintel": DepthRange(truth_max_m=70.0, clip_max_m=70.0),
    "bonn": DepthRange(truth_max_m=70.0),
    "tum": DepthRange(truth_max_m=70.0),
    "kitti": DepthRange(),
    "": DepthRange(truth_max_m=70.0, clip_max_m=70.0),
}
_UNI4D = {"": DepthRange(truth_max_m=70.0, clip_max_m=70.0)}
_DEPTHCRAFTER = {
    name: DepthRange(1e-3, cap, 1e-3, cap)
    for name, cap in (("sintel", 70.0), ("bonn", 10.0), ("tum", 10.0), ("kitti", 80.0), ("", 70.0))
}

DEPTH_PROTOCOLS: dict[str, DepthProtocol] = {
    protocol.name: protocol
    for protocol in (
        DepthProtocol("metric", "CUT3R, metric", "none", False, _MONST3R),
        DepthProtocol("uni4d-scale", "Uni4D, eval_depth.py --scale_only", "median", True, _UNI4D),
        DepthProtocol("uni4d-scale-shift", "Uni4D, eval_depth.py", "lstsq", True, _UNI4D),
        DepthProtocol("monst3r-scale", "MonST3R, depth_metric.ipynb without lad2", "median", False, _MONST3R),
        DepthProtocol("monst3r-scale-shift", "MonST3R, depth_metric.ipynb; CUT3R", "adam", False, _MONST3R),
        DepthProtocol("cut3r-scale", "CUT3R, eval_depth.py --align scale", "weiszfeld", False, _MONST3R),
        DepthProtocol(
            "depthcrafter-scale-shift", "DepthCrafter, eval.py", "lstsq", True, _DEPTHCRAFTER, 1e-3, True, True
        ),
    )
}
"""By name. Ranges are those of the programs, MonST3R's and CUT3R's per dataset."""

SLOW_PROTOCOLS = ("monst3r-scale-shift",)
"""Those that take minutes for a long video."""


@dataclass(frozen=True)
class DepthScore:
    """Errors over one region of a video; None where no pixel could be scored."""

    abs_rel: float | None
    delta_125: float | None
    pixels: int
    missing: int
    """Pixels with truth but without a prediction; not scored."""


@dataclass(frozen=True)
class VideoDepthScores:
    """One video by one protocol."""

    protocol: str
    text: str
    scale: float
    shift: float
    regions: dict[str, DepthScore]
    """'all', and with masks 'static' and 'moving'. Alignment is by all pixels, whatever the region."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


@dataclass(frozen=True)
class DepthPixels:
    """The pixels of a video that have truth and a prediction."""

    prediction: Float32Array
    """(N,) m, or 1/m."""
    truth: Float32Array
    """(N,) m."""
    frame: Int32Array
    """(N,)."""
    moving: BoolArray | None
    """(N,) by the masks."""
    missing: dict[str, int]
    """Pixels without a prediction, by region."""


def score_depth(
    protocol: DepthProtocol,
    dataset: str,
    prediction: FrameSource[Float32Array],
    truth: FrameSource[Float32Array],
    masks: FrameSource[Int32Array] | None = None,
) -> VideoDepthScores:
    """Score a video's depth.

    Args:
        protocol: How.
        dataset: Name of the dataset, which decides on the range.
        prediction: T maps (h, w), meters or any unit; NaN or not positive where missing. Another size than the truth's
            is resized as the programs do: bicubic, of the depth or of the disparity that is aligned; by the nearest
            pixel where some of a map is missing.
        truth: T maps (H, W), meters; NaN or not positive where unknown.
        masks: T label maps (H, W), 0 static; adds the regions.

    Raises:
        InputError: If the numbers of frames disagree.
    """
    bounds = protocol.range_of(dataset)
    found = collect_pixels(prediction, truth, masks, bounds, disparity=protocol.disparity)
    x = found.prediction
    if protocol.far_disparity:
        x = np.maximum(x, np.float32(protocol.far_disparity))
    line = Line()
    if len(x):
        reference = found.truth.astype(np.float64)
        line = _FITS[protocol.fit][1](x, 1.0 / (reference + 1e-8) if protocol.disparity else reference)
    aligned = line.scale * x.astype(np.float64) + line.shift
    if protocol.disparity:
        aligned = np.maximum(aligned, protocol.far_disparity)
        aligned = np.divide(1.0, aligned, out=np.zeros_like(aligned), where=aligned > 0.0)
    if bounds.clip_min_m is not None or bounds.clip_max_m is not None:
        aligned = np.clip(aligned, bounds.clip_min_m, bounds.clip_max_m)
    regions: dict[str, BoolArray | None] = {"all": None}
    if found.moving is not None:
        regions |= {"static": ~found.moving, "moving": found.moving}
    scores = {name: _score(protocol, found, aligned, chosen, name) for name, chosen in regions.items()}
    return VideoDepthScores(protocol.name, protocol.text(dataset), line.scale, line.shift, scores)


def collect_pixels(
    prediction: FrameSource[Float32Array],
    truth: FrameSource[Float32Array],
    masks: FrameSource[Int32Array] | None,
    bounds: DepthRange,
    *,
    disparity: bool,
) -> DepthPixels:
    """Gather what a protocol scores, frame by frame. Raises InputError if the numbers of frames disagree."""
    counts = [len(prediction), len(truth)] + ([] if masks is None else [len(masks)])
    if len(set(counts)) != 1:
        raise InputError(f"depth: prediction, ground truth (and masks) have {counts} frames; they must be equal")
    values, known, frames, labels = [], [], [], []
    missing = dict.fromkeys(("all", "static", "moving"), 0)
    for frame in range(len(truth)):
        reference = truth[frame]
        found = _resized(np.asarray(prediction[frame], dtype=np.float32), reference.shape, disparity)
        with np.errstate(invalid="ignore"):
            scored = np.isfinite(reference) & (reference > bounds.truth_min_m)
            if bounds.truth_max_m is not None:
                scored &= reference < bounds.truth_max_m
            present = scored & np.isfinite(found) & (found > 0)
        label = None if masks is None else _label(masks[frame], reference.shape) > 0
        absent = scored & ~present
        missing["all"] += int(absent.sum())
        if label is not None:
            missing["moving"] += int((absent & label).sum())
            missing["static"] += int((absent & ~label).sum())
            labels.append(label[present])
        values.append(found[present])
        known.append(reference[present])
        frames.append(np.full(int(present.sum()), frame, dtype=np.int32))
    return DepthPixels(
        np.concatenate(values).astype(np.float32), np.concatenate(known).astype(np.float32), np.concatenate(frames),
        np.concatenate(labels) if masks is not None else None, missing,
    )  # fmt: skip


def average_depth(protocol: DepthProtocol, scores: list[DepthScore]) -> tuple[float | None, float | None]:
    """Return AbsRel and delta < 1.25 over videos, as the protocol weighs them; None without any."""
    scored = [s for s in scores if s.abs_rel is not None and s.delta_125 is not None]
    if not scored:
        return None, None
    weights: FloatArray = np.array([1.0 if protocol.over_videos else float(s.pixels) for s in scored])
    values = np.array([[s.abs_rel, s.delta_125] for s in scored], dtype=np.float64)
    mean = weights @ values / weights.sum()
    return float(mean[0]), float(mean[1])


def _score(
    protocol: DepthProtocol, found: DepthPixels, aligned: FloatArray, chosen: BoolArray | None, name: str
) -> DepthScore:
    depth, truth, frame = aligned, found.truth, found.frame
    if chosen is not None:
        depth, truth, frame = depth[chosen], truth[chosen], frame[chosen]
    if not len(truth):
        return DepthScore(None, None, 0, found.missing[name])
    reference = truth.astype(np.float64)
    error = np.abs(depth - reference) / reference
    depth = np.maximum(depth, 1e-5)
    inlier = np.maximum(depth / reference, reference / depth) < 1.25
    if not protocol.over_frames:
        return DepthScore(float(error.mean()), float(inlier.mean()), len(truth), found.missing[name])
    count = np.bincount(frame)
    means = [np.bincount(frame, weights=w)[count > 0] / count[count > 0] for w in (error, inlier)]
    return DepthScore(float(means[0].mean()), float(means[1].mean()), len(truth), found.missing[name])


def _resized(depth: Float32Array, size: tuple[int, ...], disparity: bool) -> Float32Array:
    """Return a prediction in the size of the truth, as disparity if that is what is aligned; NaN where missing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        present = np.isfinite(depth) & (depth > 0)
        values = np.where(present, np.float32(1.0) / depth if disparity else depth, np.float32(np.nan))
    if depth.shape == size:
        return values.astype(np.float32)
    method = cv2.INTER_CUBIC if present.all() else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(values.astype(np.float32), (size[1], size[0]), interpolation=method))


def _label(mask: Int32Array, size: tuple[int, ...]) -> Int32Array:
    if mask.shape == size:
        return mask
    return np.asarray(cv2.resize(mask, (size[1], size[0]), interpolation=cv2.INTER_NEAREST))
