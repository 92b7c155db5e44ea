"""Dense depth correction against a known scale field."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.results.fusion.densify import ControlPoints, densify_frame

INTRINSICS = np.array([300.0, 300.0, 79.5, 59.5])
HEIGHT, WIDTH = 120, 160


def scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A slanted wall with a nearer box of instance 3; the cue is off by different smooth fields on each."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    truth = 3.0 + 0.005 * u
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.int32)
    mask[40:90, 60:120] = 3
    truth[mask == 3] = 1.5
    log_scale = np.where(mask == 3, -0.08 + 0.0005 * (v - 60), 0.05 + 0.0003 * u)
    return truth, mask, log_scale


def control_points(rng, truth, mask, log_scale, count=600, noise=0.0, outliers=0.0) -> ControlPoints:
    uv = np.stack([rng.uniform(0, WIDTH - 1, count), rng.uniform(0, HEIGHT - 1, count)], axis=1)
    x, y = np.rint(uv).astype(int).T
    s = log_scale[y, x] + noise * rng.normal(size=count)
    s[rng.random(count) < outliers] += 0.8
    cue = truth[y, x] * np.exp(-log_scale[y, x])
    return ControlPoints(uv, cue, s, mask[y, x], np.zeros((count, 3)))


def relative_error(estimate: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    return float(np.nanmean(np.abs(estimate[where] / truth[where] - 1.0)))


def test_each_instance_follows_its_own_scale_field(rng: np.random.Generator) -> None:
    truth, mask, log_scale = scene(rng)
    cue = (truth * np.exp(-log_scale)).astype(np.float32)
    control = control_points(rng, truth, mask, log_scale)
    fused = densify_frame(cue, mask, INTRINSICS, control, 0.04, 0.1, FusionConfig(smoothing=1))
    for where in (mask == 0, mask == 3):
        assert relative_error(cue, truth, where) > 0.04
        assert relative_error(fused, truth, where) < 0.003


@pytest.mark.parametrize("averaged", ["log", "linear"])
@pytest.mark.parametrize("power", [1, 2])
def test_every_pixel_is_the_weighted_mean_of_its_nearest_control_points(
    power: int, averaged: str, rng: np.random.Generator
) -> None:
    """Equation by equation, pixel by pixel; the grid is every pixel."""
    height, width, count = 9, 12, 3
    mask = np.zeros((height, width), np.int32)
    mask[:, 7:] = 2
    cue = rng.uniform(1.5, 2.5, (height, width)).astype(np.float32)
    uv = np.stack([rng.uniform(0, width - 1, 16), rng.uniform(0, height - 1, 16)], axis=1)
    instance = np.array([0] * 8 + [2] * 8, np.int32)
    control = ControlPoints(uv, rng.uniform(1.5, 2.5, 16), rng.normal(scale=0.5, size=16), instance, np.zeros((16, 3)))
    config = FusionConfig(
        smoothing=1, stride=1, neighbors=count, min_control_points=1, max_scale_sigmas=1000.0, distance_power=power,
        averaged_scale=averaged,
    )  # type: ignore[arg-type]  # fmt: skip
    fused = densify_frame(cue, mask, INTRINSICS, control, 0.0, 1.0, config)

    def lift(u: float, v: float, z: float) -> np.ndarray:
        fx, fy, cx, cy = INTRINSICS
        return np.array([(u - cx) / fx * z, (v - cy) / fy * z, z])

    for v in range(height):
        for u in range(width):
            mine = [i for i in range(16) if instance[i] == mask[v, u]]
            pixel = lift(u, v, float(cue[v, u]))
            distance = {i: float(np.linalg.norm(lift(*uv[i], control.cue[i]) - pixel)) for i in mine}
            nearest = sorted(mine, key=distance.__getitem__)[:count]
            weight = [1.0 / distance[i] ** power for i in nearest]
            values = [control.log_scale[i] if averaged == "log" else np.exp(control.log_scale[i]) for i in nearest]
            mean = sum(w * s for w, s in zip(weight, values, strict=True)) / sum(weight)
            expected = cue[v, u] * (np.exp(mean) if averaged == "log" else mean)
            assert fused[v, u] == pytest.approx(expected, rel=2e-6)


@pytest.mark.parametrize("averaged", ["log", "linear"])
def test_beside_nodes_without_depth_the_frames_scale_holds(averaged: str) -> None:
    cue = np.full((8, 8), 2.0, np.float32)
    cue[np.ix_([2, 6], [2, 6])] = np.nan  # where the four nodes of the grid are
    one = ControlPoints(np.ones((1, 2)), np.full(1, 2.0), np.full(1, 0.5), np.zeros(1, np.int32), np.zeros((1, 3)))
    config = FusionConfig(averaged_scale=averaged, smoothing=1, min_control_points=1)  # type: ignore[arg-type]
    fused = densify_frame(cue, np.zeros((8, 8), np.int32), INTRINSICS, one, 0.3, 1.0, config)
    np.testing.assert_allclose(fused[np.isfinite(cue)], 2.0 * np.exp(0.3), rtol=1e-6)
    assert np.isnan(fused).sum() == 4


def test_noise_and_outliers_of_control_points_are_not_copied(rng: np.random.Generator) -> None:
    truth, mask, log_scale = scene(rng)
    cue = (truth * np.exp(-log_scale)).astype(np.float32)
    control = control_points(rng, truth, mask, log_scale, noise=0.03, outliers=0.1)
    smooth = densify_frame(cue, mask, INTRINSICS, control, 0.04, 0.06, FusionConfig(smoothing=16))
    raw = densify_frame(cue, mask, INTRINSICS, control, 0.04, 1.0, FusionConfig(smoothing=1))
    everywhere = np.ones_like(mask, dtype=bool)
    assert relative_error(smooth, truth, everywhere) < 0.012
    assert relative_error(smooth, truth, everywhere) < 0.25 * relative_error(raw, truth, everywhere)


def test_few_control_points_give_the_frame_scale(rng: np.random.Generator) -> None:
    truth, mask, log_scale = scene(rng)
    cue = truth.astype(np.float32)
    control = control_points(rng, truth, mask, log_scale, count=3)
    fused = densify_frame(cue, mask, INTRINSICS, control, 0.1, 0.1, FusionConfig())
    np.testing.assert_allclose(fused, cue * np.exp(0.1), rtol=1e-5)


def test_missing_depth_stays_missing_and_only_there(rng: np.random.Generator) -> None:
    truth, mask, log_scale = scene(rng)
    cue = (truth * np.exp(-log_scale)).astype(np.float32)
    cue[10:30, 20:60] = np.nan
    control = control_points(rng, truth, mask, log_scale)
    fused = densify_frame(cue, mask, INTRINSICS, control, 0.04, 0.1, FusionConfig())
    np.testing.assert_array_equal(np.isnan(fused), np.isnan(cue))
