"""Frames whose depth cue contradicts the landmarks are named, and no other; samples that err alike make up no shift."""

from __future__ import annotations

import numpy as np

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.slam.stages.affine_error import fit_affine
from uni4d_fg.slam.stages.contradicting_depth import contradicting_frames

Seen = list[tuple[np.ndarray, np.ndarray]]


def frames(rng: np.random.Generator, broken: set[int], count: int = 12) -> Seen:
    """Return the cue at the landmarks of each frame, and its log-scale."""
    out: Seen = []
    for frame in range(count):
        depth = rng.uniform(1.0, 4.0, 200)
        cue = 1.0 / (rng.uniform(0.8, 1.2) / depth + 0.02) * np.exp(0.05 * rng.standard_normal(200))
        if frame in broken:
            cue = np.full(200, 2.0) if frame % 2 else rng.uniform(1.0, 4.0, 200)
        out.append((cue, np.log(depth) - np.log(cue)))
    return out


def test_frames_that_contradict_the_scene_are_named_and_no_other(rng: np.random.Generator) -> None:
    assert contradicting_frames(frames(rng, {3, 8}), FusionConfig()) == [3, 8]
    assert contradicting_frames(frames(rng, set()), FusionConfig()) == []


def test_a_constant_cue_before_a_wall_is_named(rng: np.random.Generator) -> None:
    """Most landmarks are on the wall, for which a constant depth is as good as any; what stands before it tells."""
    seen = frames(rng, set())
    for frame in range(len(seen)):
        wall = rng.uniform(3.9, 4.1, 200)
        depth = np.where(np.arange(200) < 40, rng.uniform(1.0, 2.0, 200), wall)
        cue = np.full(200, 4.0) if frame == 5 else depth * np.exp(0.05 * rng.standard_normal(200))
        seen[frame] = cue, np.log(depth / cue)
    assert contradicting_frames(seen, FusionConfig()) == [5]


def test_a_constant_cue_is_named_where_all_is_about_as_far_and_other_cues_err_by_as_much(
    rng: np.random.Generator,
) -> None:
    seen = frames(rng, set())
    for frame in range(len(seen)):
        depth = rng.uniform(3.8, 4.2, 200)
        cue = np.full(200, 4.0) if frame == 5 else depth * np.exp(0.05 * rng.standard_normal(200))
        if frame == 7:  # a wall that is seen straight on and nothing else: flat, and right
            depth, cue = 4.0 * np.exp(0.002 * rng.standard_normal(200)), 4.0 + 1e-4 * np.linspace(-1.0, 1.0, 200)
        seen[frame] = cue, np.log(depth / cue)
    assert contradicting_frames(seen, FusionConfig()) == [5]


def test_a_frame_that_shows_little_but_a_wall_is_not_named_for_what_its_cue_misses_before_it(
    rng: np.random.Generator,
) -> None:
    """Somebody who passes hides what is near: nine landmarks in ten are on the wall, which the cue knows well."""
    seen = frames(rng, set())
    for frame in range(len(seen)):
        near = np.arange(200) < (24 if frame == 5 else 100)
        depth = np.where(near, 2.0, 4.0) * np.exp(0.04 * rng.standard_normal(200))
        cue = depth * np.exp((0.02 if frame == 5 else 0.08) * rng.standard_normal(200))
        if frame == 5:  # the place of what is near is known to it by half
            cue[:24] = 3.6 * np.exp(0.1 * rng.standard_normal(24))
        if frame == 8:
            cue = np.full(200, 4.0)
        seen[frame] = cue, np.log(depth / cue)
    assert contradicting_frames(seen, FusionConfig()) == [8]


def test_samples_that_err_alike_do_not_make_up_a_shift(rng: np.random.Generator) -> None:
    """A smooth error looks like a shift over a small range of depth, and things nearer than that pay for it."""
    error = {np.inf: 0.0, 0.08: 0.0}
    for _ in range(20):
        depth = rng.uniform(2.8, 3.6, 400)
        slope = 0.08 * rng.standard_normal()
        cue = depth * np.exp(slope * (depth - 3.2) / 0.4 + 0.02 * rng.standard_normal(400))
        for shift_sigma in error:
            a, b, _spread = fit_affine(cue, np.log(depth), np.ones(400), shift_sigma)
            error[shift_sigma] += abs(float(np.log((a / 1.6 + b) * 1.6))) / 20
    assert error[0.08] < 0.75 * error[np.inf]
