"""What is wrong with a cue is measured and taken out of it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.results.fusion.cue_error import (
    KnownDepth,
    correct_cue,
    smooth_field,
    smooth_field_of_points,
)
from uni4d_fg.results.fusion.multiview.measured import Measured
from uni4d_fg.results.fusion.static_depth import fuse_static, held_out_errors, known_depth, without_edges
from uni4d_fg.results.nearest import from_nearest
from uni4d_fg.slam.stages.affine_error import fit_affine

HEIGHT, WIDTH = 60, 80
NOWHERE = np.zeros((HEIGHT, WIDTH), bool)


def room(rng: np.random.Generator, scale: float = 1.2, shift: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a slanted wall, and a cue that is affinely off in disparity with a smooth error on top."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    depth = 2.0 + 0.02 * u + 0.01 * v
    field = 0.08 * np.sin(2 * np.pi * u / 45) * np.cos(2 * np.pi * v / 40)
    cue = 1.0 / ((1.0 / depth - shift) / scale) * np.exp(field)
    return depth.astype(np.float32), cue.astype(np.float32)


def step() -> np.ndarray:
    """Depth of a surface at 2 m on the left, and one at 3 m behind it on the right."""
    return np.where(np.arange(WIDTH) < 40, 2.0, 3.0).astype(np.float32) * np.ones((HEIGHT, 1), np.float32)


def landmarks(log_depth: np.ndarray, where: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and log depth of landmarks on a fifth of the pixels ``where`` there may be some."""
    places = np.argwhere((rng.random(log_depth.shape) < 0.2) & where)
    return places[:, ::-1].astype(np.float64), log_depth[places[:, 0], places[:, 1]].astype(np.float64)


def test_an_affine_fit_bears_outliers(rng: np.random.Generator) -> None:
    depth = rng.uniform(1.0, 5.0, 400)
    cue = 1.25 / (1.0 / depth - 0.04)
    log_depth = np.log(depth) + 0.002 * rng.standard_normal(400)
    log_depth[:100] += rng.uniform(0.2, 1.0, 100)
    a, b, spread = fit_affine(cue, log_depth, np.ones(400))
    assert abs(a - 1.25) < 0.01
    assert abs(b - 0.04) < 0.004
    assert spread < 0.01


def test_affine_and_smooth_errors_are_taken_out(rng: np.random.Generator) -> None:
    depth, cue = room(rng)
    known = rng.random(depth.shape) < 0.15
    weight = known.astype(np.float32)
    log_depth = np.where(known, np.log(depth) + 0.003 * rng.standard_normal(depth.shape), np.nan).astype(np.float32)
    corrected = correct_cue(cue, KnownDepth(log_depth, weight), 0.0, FusionConfig())
    before, after = (np.abs(x - np.log(depth)).mean() for x in (np.log(cue), corrected.log_depth))
    assert before > 0.1
    assert after < 0.012


@pytest.mark.parametrize("part", [1.0, 0.02])
def test_windows_on_coarse_grids_are_windows_on_the_map(rng: np.random.Generator, part: float) -> None:
    shape, config = (240, 320), FusionConfig()
    coarse = rng.normal(0.0, 0.05, (6, 8)).astype(np.float32)
    smooth = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    weight = (rng.random(shape) < part).astype(np.float32)
    residual = (smooth + 0.01 * rng.standard_normal(shape)).astype(np.float32)
    expected = np.zeros(shape, np.float32)
    for share in config.field_windows:
        mass = cv2.GaussianBlur(weight, (0, 0), share * shape[1])
        pull = cv2.GaussianBlur(weight * (residual - expected), (0, 0), share * shape[1])
        expected += pull / (mass + np.float32(config.field_prior))
    found = smooth_field(residual, weight, config)
    assert np.abs(found - expected).mean() < 0.01 * np.abs(expected).mean()
    assert np.abs(found - smooth).mean() < 1.01 * np.abs(expected - smooth).mean()
    at = np.nonzero(weight)
    of_points = smooth_field_of_points(at, residual[at].astype(np.float64), 1.0, shape, config)
    np.testing.assert_allclose(of_points, found, atol=1e-5)


def test_points_may_share_a_pixel_and_be_on_a_large_image(rng: np.random.Generator) -> None:
    config, shape = FusionConfig(), (480, 640)
    at = tuple(rng.integers(0, side, 500) for side in shape)
    twice = tuple(np.concatenate([where, where]) for where in at)
    residual = rng.normal(0.1, 0.02, 500)
    once = smooth_field_of_points(at, residual, 1.0, shape, config)
    np.testing.assert_allclose(
        smooth_field_of_points(twice, np.concatenate([residual] * 2), 0.5, shape, config), once, atol=1e-6
    )
    assert once.shape == shape


def test_a_frame_without_anything_known_keeps_its_scale() -> None:
    cue = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    nothing = KnownDepth(np.full_like(cue, np.nan), np.zeros_like(cue))
    corrected = correct_cue(cue, nothing, 0.1, FusionConfig())
    np.testing.assert_allclose(corrected.log_depth, np.log(2.0) + 0.1, rtol=1e-6)


def test_held_out_landmarks_tell_the_error_of_the_cue_and_which_depth_is_better(rng: np.random.Generator) -> None:
    depth, cue = room(rng)
    truth = np.log(depth).astype(np.float64)
    static, sigma = np.ones(depth.shape, bool), np.full(depth.shape, 0.004, np.float32)
    uv, log_z = landmarks(truth, ~NOWHERE, rng)
    noisy = (cue * np.exp(0.03 * rng.standard_normal(depth.shape))).astype(np.float32)
    for error, better in ((0.005, True), (0.1, False)):
        seen = np.exp(truth + error * rng.standard_normal(truth.shape)).astype(np.float32)
        measured = Measured(np.log(seen), np.full(depth.shape, 0.95, np.float32), sigma)
        judged = held_out_errors(noisy, measured, uv, log_z, static, 0.0, FusionConfig())
        assert (judged.matching < 0.8) is better, judged
        assert judged.telling
        if better:  # landmarks that a cue was made from agree with it wherever they are held out
            assert not held_out_errors(depth, measured, uv, log_z, static, 0.0, FusionConfig()).telling
    found = held_out_errors(noisy, None, uv, log_z, static, 0.0, FusionConfig())
    known = known_depth(None, uv, log_z, static, (HEIGHT, WIDTH))
    fused = fuse_static(noisy, None, known, found.cue, static, NOWHERE, 0.0, 0.0, FusionConfig())
    true_error = float(np.abs(fused.log_depth - truth).mean())
    assert 1 / 1.5 < found.cue / true_error < 1.5
    right = float((np.abs(fused.log_depth - truth) < 0.03).mean())
    assert abs(float(fused.confidence.mean()) - right) < 0.15


def test_matched_depth_that_is_sure_wins_over_a_cue_that_is_wrong_and_says_so(rng: np.random.Generator) -> None:
    depth, cue = room(rng)
    truth = np.log(depth)
    sure = np.full(depth.shape, 0.97, np.float32)
    sure[:, :10] = 0.1
    seen = np.where(sure > 0.5, truth + 0.004 * rng.standard_normal(truth.shape), truth + 0.5).astype(np.float32)
    measured = Measured(seen, sure, np.full(depth.shape, 0.004, np.float32))
    bled = cue.copy()
    bled[20:30, 30:50] *= 1.4
    places = np.argwhere(rng.random(depth.shape) < 0.1)
    uv, log_z = places[:, ::-1].astype(np.float64), truth[places[:, 0], places[:, 1]].astype(np.float64)
    known = known_depth(measured, uv, log_z, np.ones(depth.shape, bool), (HEIGHT, WIDTH))
    fused = fuse_static(bled, measured, known, 0.02, ~NOWHERE, NOWHERE, 0.0, 0.0, FusionConfig())
    error = np.abs(fused.log_depth - truth)
    assert error[20:30, 30:50].mean() < 0.02
    chosen = fused.confidence > 0.9
    assert chosen.mean() > 0.5
    assert (error[chosen] < 0.03).mean() > 0.95
    assert not chosen[:, :5].any() or error[:, :5][chosen[:, :5]].mean() < 0.03


def test_matched_depth_leaves_the_edges_to_a_cue_that_has_them(rng: np.random.Generator) -> None:
    """A step from 2 to 3 m: the cue has it where it is, with an error beside; matching has blurred it."""
    depth = step()
    cue = (depth * np.exp(0.01 * rng.standard_normal(depth.shape))).astype(np.float32)
    blurred = cv2.GaussianBlur(depth, (0, 0), 2.0)
    measured = Measured(
        np.log(blurred), np.full(depth.shape, 0.97, np.float32), np.full(depth.shape, 0.003, np.float32)
    )
    said = without_edges(measured, cue)
    assert (said.confidence[:, 36:44] == 0).all()
    np.testing.assert_array_equal(said.confidence[:, :30], measured.confidence[:, :30])
    np.testing.assert_array_equal(said.confidence[:, 50:], measured.confidence[:, 50:])
    beside = np.zeros(depth.shape, bool)
    beside[:, 37:43] = True
    errors = {}
    uv, log_z = landmarks(np.log(depth), ~beside, rng)
    for name, matched in (("as it is", measured), ("without edges", said)):
        known = known_depth(matched, uv, log_z, np.ones(depth.shape, bool), (HEIGHT, WIDTH))
        fused = fuse_static(cue, matched, known, 0.01, ~NOWHERE, NOWHERE, 0.0, 0.0, FusionConfig())
        errors[name] = float(np.abs(fused.log_depth - np.log(depth))[beside].mean())
    assert errors["without edges"] < 0.015
    assert errors["without edges"] < errors["as it is"]


def test_what_a_cue_mixes_is_taken_from_matching(rng: np.random.Generator) -> None:
    """A step from 2 to 3 m that the cue has blurred; matching has it, half sure, but for a strip beside it."""
    depth = step()
    cue = cv2.GaussianBlur(depth, (0, 0), 3.0)
    sure = np.full(depth.shape, 0.97, np.float32)
    sure[:, 36:41], sure[:, 41:44] = 0.5, 0.2
    seen = np.where(sure > 0.4, depth, np.float32(5.0)).astype(np.float32)
    measured = Measured(np.log(seen), sure, np.full(depth.shape, 0.004, np.float32))
    uv, log_z = landmarks(np.log(depth), np.abs(np.arange(WIDTH) - 40) > 8, rng)
    known = known_depth(measured, uv, log_z, ~NOWHERE, (HEIGHT, WIDTH))
    errors, told = {}, {}
    for bleeding_px in (0.0, 6.0):
        fused = fuse_static(cue, measured, known, 0.01, ~NOWHERE, NOWHERE, 0.0, bleeding_px, FusionConfig())
        errors[bleeding_px] = np.abs(fused.log_depth - np.log(depth))
        told[bleeding_px] = fused.confidence[:, 41:44]
    assert errors[6.0][:, 36:41].max() < 0.02
    assert errors[0.0][:, 36:41].max() > 0.1
    # The strip keeps the mixture, which is nearer to the truth than a match that is not sure, and is not sure of it.
    assert errors[6.0][:, 41:44].max() < 0.12
    assert (told[6.0] <= 0.5).all()


def test_a_mixture_beside_a_mask_is_the_nearest_static_surface_unless_it_looks_like_what_moves(
    rng: np.random.Generator,
) -> None:
    """A step that the cue has blurred, with a strip behind a mask on its far side, where nothing is matched."""
    depth = step()
    cue = cv2.GaussianBlur(depth, (0, 0), 3.0)
    static = np.broadcast_to((np.arange(WIDTH) < 41) | (np.arange(WIDTH) >= 44), depth.shape)
    sure = np.where(static, np.float32(0.97), np.float32(0))
    measured = Measured(np.log(depth), sure, np.full(depth.shape, 0.004, np.float32))
    uv, log_z = landmarks(np.log(depth), np.abs(np.arange(WIDTH) - 40) > 8, rng)
    known = known_depth(measured, uv, log_z, static, (HEIGHT, WIDTH))
    errors = {}
    for looks_like_it in (False, True):
        like_moving = ~static & looks_like_it
        fused = fuse_static(cue, measured, known, 0.01, static, like_moving, 0.0, 6.0, FusionConfig())
        errors[looks_like_it] = np.abs(fused.log_depth - np.log(depth))[:, 41:44]
    assert errors[False].max() < 0.02
    assert errors[True].mean() > 0.05


def test_matching_need_not_be_as_sure_where_edges_are_of_other_frames(rng: np.random.Generator) -> None:
    depth = step()
    cue = np.roll(depth, 3, axis=1)  # the edge has moved
    sure = np.full(depth.shape, 0.97, np.float32)
    sure[:, 36:44] = 0.15
    measured = Measured(np.log(depth), sure, np.full(depth.shape, 0.004, np.float32))
    uv, log_z = landmarks(np.log(depth), np.abs(np.arange(WIDTH) - 40) > 8, rng)
    known = known_depth(measured, uv, log_z, ~NOWHERE, (HEIGHT, WIDTH))
    errors = {}
    for foreign in (False, True):
        fused = fuse_static(cue, measured, known, 0.01, ~NOWHERE, NOWHERE, 0.0, 6.0, FusionConfig(), foreign)
        errors[foreign] = np.abs(fused.log_depth - np.log(depth))[:, 40:43]
    assert errors[True].max() < 0.02
    assert errors[False].min() > 0.3


def test_ground_that_goes_to_the_horizon_is_no_mixture(rng: np.random.Generator) -> None:
    """Depth changes as fast there as at an edge; where matching ends the cue goes on, and not the ground before it."""
    inverse = np.linspace(1 / 40, 1 / 2, HEIGHT, dtype=np.float32)[:, None] * np.ones((1, WIDTH), np.float32)
    truth = -np.log(inverse)
    cue = np.exp(truth + 0.02 * rng.standard_normal(truth.shape)).astype(np.float32)
    sure = np.full(truth.shape, 0.97, np.float32)
    sure[:6] = 0.2
    seen = np.where(sure > 0.5, truth, truth - 0.5).astype(np.float32)
    measured = Measured(seen, sure, np.full(truth.shape, 0.004, np.float32))
    uv, log_z = landmarks(truth, np.arange(HEIGHT)[:, None] > 6, rng)
    known = known_depth(measured, uv, log_z, ~NOWHERE, (HEIGHT, WIDTH))
    fused = fuse_static(cue, measured, known, 0.02, ~NOWHERE, NOWHERE, 0.0, 6.0, FusionConfig())
    assert np.abs(fused.log_depth - truth)[:6].mean() < 0.05


def test_a_map_is_filled_from_the_nearest_known_pixel() -> None:
    values = np.array([[1.0, 9.0, 9.0, 2.0]], np.float32)
    known = np.array([[True, False, False, True]])
    np.testing.assert_array_equal(from_nearest(values, known), [[1.0, 1.0, 2.0, 2.0]])
    np.testing.assert_array_equal(from_nearest(values, ~(known | True)), values)
