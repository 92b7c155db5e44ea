"""What is wrong with a cue is measured and taken out of it, and a frame that contradicts the scene is found."""

from __future__ import annotations

import numpy as np

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.results.fusion.broken_frames import contradicting_frames
from uni4d_fg.results.fusion.cue_error import KnownDepth, correct_cue, fit_affine
from uni4d_fg.results.fusion.densify import ControlPoints
from uni4d_fg.results.fusion.static_depth import StaticDepth, known_depth, spread_at_landmarks

HEIGHT, WIDTH = 60, 80


def room(rng: np.random.Generator, scale: float = 1.2, shift: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a slanted wall, and a cue that is affinely off in disparity with a smooth error on top."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    depth = 2.0 + 0.02 * u + 0.01 * v
    field = 0.08 * np.sin(2 * np.pi * u / 45) * np.cos(2 * np.pi * v / 40)
    cue = 1.0 / ((1.0 / depth - shift) / scale) * np.exp(field)
    return depth.astype(np.float32), cue.astype(np.float32)


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


def test_a_frame_without_anything_known_keeps_its_scale() -> None:
    cue = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    nothing = KnownDepth(np.full_like(cue, np.nan), np.zeros_like(cue))
    corrected = correct_cue(cue, nothing, 0.1, FusionConfig())
    np.testing.assert_allclose(corrected.log_depth, np.log(2.0) + 0.1, rtol=1e-6)


def frames(rng: np.random.Generator, broken: set[int], count: int = 12) -> list[ControlPoints]:
    out = []
    for frame in range(count):
        depth = rng.uniform(1.0, 4.0, 200)
        cue = 1.0 / (rng.uniform(0.8, 1.2) / depth + 0.02) * np.exp(0.05 * rng.standard_normal(200))
        if frame in broken:
            cue = np.full(200, 2.0) if frame % 2 else rng.uniform(1.0, 4.0, 200)
        log_scale = np.log(depth) - np.log(cue)
        out.append(ControlPoints(np.zeros((200, 2)), cue, log_scale, np.zeros(200, np.int32), np.zeros((200, 3))))
    return out


def test_frames_that_contradict_the_scene_are_named_and_no_other(rng: np.random.Generator) -> None:
    assert contradicting_frames(frames(rng, {3, 8}), FusionConfig()) == [3, 8]
    assert contradicting_frames(frames(rng, set()), FusionConfig()) == []


def test_landmarks_tell_which_depth_is_the_better_one(rng: np.random.Generator) -> None:
    truth = np.log(room(rng)[0])
    landmarks = rng.random(truth.shape) < 0.1
    uv = np.argwhere(landmarks)[:, ::-1].astype(np.float64)
    known = known_depth(None, uv, truth[landmarks].astype(np.float64), np.ones(truth.shape, bool), truth.shape)
    sigma = np.full(truth.shape, 0.01, np.float32)
    for noise in (0.005, 0.05):
        seen = (truth + noise * rng.standard_normal(truth.shape)).astype(np.float32)
        spread = spread_at_landmarks(StaticDepth(seen, sigma, 0.0), known)
        assert abs(spread / noise - 1.0) < 0.15
    nothing = known_depth(None, uv[:0], truth[:0, 0].astype(np.float64), np.ones(truth.shape, bool), truth.shape)
    assert spread_at_landmarks(StaticDepth(truth, sigma, 0.0), nothing) == float("inf")
