"""Depth metrics equal direct formulas on whole arrays, count what is missing, and stream."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.results.evaluate.depth import evaluate_depth
from uni4d_fg.results.evaluate.streaming import StreamingLine, StreamingLogMedian


def random_video(seed: int, frames: int = 6, height: int = 12, width: int = 16) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    truth = np.exp(rng.normal(0.7, 0.4, (frames, height, width))).astype(np.float32)
    predicted = (truth * np.exp(rng.normal(0.2, 0.15, truth.shape))).astype(np.float32)
    truth[rng.random(truth.shape) < 0.1] = np.nan
    truth[rng.random(truth.shape) < 0.05] = 0.0
    truth[rng.random(truth.shape) < 0.02] = 100.0
    predicted[rng.random(truth.shape) < 0.1] = np.nan
    predicted[rng.random(truth.shape) < 0.02] = -1.0
    label = rng.choice([0, 0, 0, 1, 7], truth.shape).astype(np.int32)
    return predicted, truth, label


def direct(aligned: np.ndarray, truth: np.ndarray, cap: float) -> tuple[float, tuple[float, float]]:
    """AbsRel, and between what delta lies: a pixel right at the limit may be on either side of it."""
    aligned = np.minimum(aligned, cap)
    ratio = np.maximum(aligned / truth, truth / aligned)
    least, most = (float(np.mean(ratio < limit)) for limit in (1.2499, 1.2501))
    return float(np.mean(np.abs(aligned - truth) / truth)), (least, most)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
@example(450)
def test_equals_direct_formulas(seed: int) -> None:
    predicted, truth, label = random_video(seed)
    cap = 70.0
    report = evaluate_depth(ArrayFrames(predicted), ArrayFrames(truth), ArrayFrames(label), max_depth_m=cap)
    known = np.isfinite(truth) & (truth > 0) & (truth <= cap)
    valid = known & np.isfinite(predicted) & (predicted > 0)
    p, g, m = predicted[valid].astype(float), truth[valid].astype(float), label[valid]
    scale = np.median(g / p)
    slope, shift = np.polyfit(1 / p, 1 / g, 1)
    aligned = {
        "metric": p,
        "scale": scale * p,
        "scale_shift_disparity": 1 / np.maximum(slope / p + shift, 1e-9),
    }
    assert report.metrics["scale"].scale == pytest.approx(scale, rel=2e-5)
    assert report.metrics["scale_shift_disparity"].scale == pytest.approx(slope, rel=1e-6)
    assert report.metrics["scale_shift_disparity"].shift == pytest.approx(shift, abs=1e-7)
    regions = {"all": m >= 0, "static": m == 0, "dynamic": m > 0, "instance 1": m == 1, "instance 7": m == 7}
    for name, depth in aligned.items():
        found = report.metrics[name].regions
        assert list(found) == list(regions)
        for region, inside in regions.items():
            abs_rel, (least, most) = direct(depth[inside], g[inside], cap)
            assert found[region].abs_rel == pytest.approx(abs_rel, rel=1e-4)
            assert least - 1e-9 <= found[region].delta_125 <= most + 1e-9
            assert found[region].valid_pixels == inside.sum()
            assert found[region].frames_scored == 6
        assert found["all"].missing_predictions == (known & ~valid).sum()
        assert found["dynamic"].missing_predictions == (known & ~valid & (label > 0)).sum()


def test_perfect_up_to_scale() -> None:
    _, truth, _ = random_video(1)
    truth = np.abs(np.nan_to_num(truth, nan=1.0)) + 0.1
    report = evaluate_depth(ArrayFrames((truth / 3).astype(np.float32)), ArrayFrames(truth), max_depth_m=200.0)
    assert report.metrics["scale"].regions["all"].abs_rel == pytest.approx(0.0, abs=2e-5)
    assert report.metrics["scale_shift_disparity"].regions["all"].abs_rel == pytest.approx(0.0, abs=1e-5)
    assert report.metrics["metric"].regions["all"].abs_rel == pytest.approx(2 / 3, abs=1e-6)
    assert report.metrics["metric"].regions["all"].delta_125 == 0.0
    assert list(report.metrics["metric"].regions) == ["all"]
    assert report.flicker.standard_deviation == pytest.approx(0.0, abs=1e-6)


def test_flicker_is_that_of_the_static_pixels() -> None:
    rng = np.random.default_rng(2)
    truth = np.exp(rng.normal(size=(5, 8, 8))).astype(np.float32)
    label = np.zeros(truth.shape, np.int32)
    label[:, :, 5:] = 3
    wave = np.array([0.0, 0.1, -0.1, 0.05, 0.02])
    predicted = truth * np.exp(wave[:, None, None]).astype(np.float32)
    predicted[:, :, 5:] *= 7.0
    flicker = evaluate_depth(ArrayFrames(predicted), ArrayFrames(truth), ArrayFrames(label)).flicker
    np.testing.assert_allclose(flicker.log_scales, wave, atol=1e-6)
    assert flicker.standard_deviation == pytest.approx(wave.std(), abs=1e-6)
    assert flicker.frame_to_frame == pytest.approx(np.diff(wave).std(), abs=1e-6)
    predicted[2] = np.nan
    flicker = evaluate_depth(ArrayFrames(predicted), ArrayFrames(truth), ArrayFrames(label)).flicker
    assert flicker.log_scales[2] is None
    assert flicker.frames_scored == 4
    assert flicker.frame_to_frame == pytest.approx(np.std([wave[1] - wave[0], wave[4] - wave[3]]), abs=1e-6)


def test_frames_without_valid_pixels_are_counted_not_scored() -> None:
    truth = np.ones((4, 3, 3), np.float32)
    predicted = np.full((4, 3, 3), 1.1, np.float32)
    predicted[1] = np.nan
    truth[3] = 0.0
    found = (
        evaluate_depth(ArrayFrames(predicted), ArrayFrames(truth), alignments=["metric"])
        .metrics["metric"]
        .regions["all"]
    )
    assert (found.frames_scored, found.frames_without_valid_pixels) == (2, 2)
    assert (found.valid_pixels, found.missing_predictions) == (18, 9)
    assert found.abs_rel == pytest.approx(0.1, abs=1e-6)


def test_nothing_valid_gives_no_number() -> None:
    nothing = ArrayFrames(np.full((2, 3, 3), np.nan, np.float32))
    report = evaluate_depth(nothing, ArrayFrames(np.ones((2, 3, 3), np.float32)))
    for metrics in report.metrics.values():
        assert metrics.regions["all"].abs_rel is None
        assert metrics.regions["all"].missing_predictions == 18
    assert report.flicker.standard_deviation is None
    assert "nan" not in str(report.to_dict())


def test_constant_depth_has_a_disparity_scale_and_no_shift() -> None:
    flat = np.full((2, 3, 3), 2.0, np.float32)
    metrics = evaluate_depth(ArrayFrames(flat), ArrayFrames(flat * 2)).metrics["scale_shift_disparity"]
    assert (metrics.scale, metrics.shift) == (pytest.approx(0.5), 0.0)


def test_negative_disparity_counts_as_the_cap() -> None:
    predicted = np.array([[[1.0, 2.0, 1e6]]], np.float32)
    truth = 1 / (1 / predicted - 0.2)
    truth[0, 0, 2] = 20.0
    found = evaluate_depth(ArrayFrames(predicted), ArrayFrames(truth.astype(np.float32)), max_depth_m=30.0)
    assert np.isfinite(found.metrics["scale_shift_disparity"].regions["all"].abs_rel)


class CountingFrames:
    """Frames made on demand, that remember how many are alive at once."""

    def __init__(self, count: int, value: float) -> None:
        self.count, self.value, self.reads = count, value, 0

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, frame: int) -> np.ndarray:
        self.reads += 1
        return np.full((4, 4), self.value, np.float32)

    def __iter__(self) -> Iterator[np.ndarray]:
        raise AssertionError("frames are read by index")


def test_each_frame_is_read_twice() -> None:
    predicted, truth = CountingFrames(9, 1.0), CountingFrames(9, 2.0)
    evaluate_depth(predicted, truth)
    assert (predicted.reads, truth.reads) == (18, 18)


def test_sizes_that_disagree_are_refused() -> None:
    a, b = ArrayFrames(np.ones((2, 3, 3), np.float32)), ArrayFrames(np.ones((2, 3, 4), np.float32))
    with pytest.raises(InputError, match=r"frame 0: sizes disagree"):
        evaluate_depth(a, b)
    with pytest.raises(InputError, match=r"\[2, 3\] frames"):
        evaluate_depth(a, ArrayFrames(np.ones((3, 3, 3), np.float32)))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.lists(st.floats(-11, 11), max_size=20), min_size=1, max_size=5))
def test_streaming_median_equals_numpy(chunks: list[list[float]]) -> None:
    stream = StreamingLogMedian()
    for chunk in chunks:
        stream.add(np.array(chunk))
    values = np.concatenate([np.array(chunk) for chunk in chunks])
    if len(values) == 0:
        assert stream.median() is None
    else:
        assert stream.median() == pytest.approx(np.median(np.exp(values)), rel=1.1e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_streaming_line_equals_numpy(seed: int, chunks: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.normal(100.0, 1.0, (chunks, 8))
    y = 3.0 * x - 2.0 + rng.normal(size=x.shape)
    line = StreamingLine()
    for chunk in range(chunks):
        line.add(x[chunk], y[chunk])
    expected = np.polyfit(x.ravel() - 100, y.ravel(), 1)
    found = line.fit()
    assert found is not None
    assert found[0] == pytest.approx(expected[0], rel=1e-9)
    assert found[1] == pytest.approx(expected[1] - 100 * expected[0], rel=1e-8)
