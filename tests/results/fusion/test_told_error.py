"""Confidence after averaging, and the error that is told, against what is known."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.results.fusion.averaging import Averaged
from uni4d_fg.results.fusion.told_error import ToldError, as_often_right, final_confidence, without_texture

SHAPE = (60, 80)


def averaged(alike: float, seeing: float, depth: np.ndarray | None = None) -> Averaged:
    maps = [np.full(SHAPE, value, np.float32) for value in (alike, seeing, alike)]
    return Averaged(np.full(SHAPE, 2.0, np.float32) if depth is None else depth, *maps)


def test_confidence_falls_where_frames_disagree_and_beside_edges() -> None:
    alone = np.full(SHAPE, 0.95, np.float32)
    agreed = final_confidence(alone, averaged(8, 8))
    assert agreed.min() > 0.9
    assert final_confidence(alone, averaged(2, 8)).max() < 0.7
    assert final_confidence(np.full(SHAPE, 0.3, np.float32), averaged(8, 8)).max() < 0.9
    step = np.where(np.arange(SHAPE[1]) < 40, 2.0, 3.0).astype(np.float32) * np.ones((SHAPE[0], 1), np.float32)
    step[:, 70] = np.nan
    beside = final_confidence(alone, averaged(8, 8, step))
    np.testing.assert_allclose(beside[:, :36], agreed[:, :36])
    assert (beside[:, 38:42] < agreed[:, 38:42] - 0.01).all()
    np.testing.assert_array_equal(beside[:, 70], 0)
    np.testing.assert_allclose(beside[:, 72:], agreed[:, 72:])


def test_where_the_cue_bleeds_depth_that_bends_between_two_surfaces_is_unsure() -> None:
    """A step of 20 % that is spread over 12 px is unsure at both of its ends; a slanted plane is not."""
    alone, u = np.full(SHAPE, 0.95, np.float32), np.arange(SHAPE[1], dtype=np.float32)
    plane = -np.log(0.6 - 0.004 * u) * np.ones((SHAPE[0], 1), np.float32)
    assert final_confidence(alone, averaged(8, 8, plane), bleeds=True).min() > 0.9
    spread = np.log(2.0) + 0.2 * np.clip((u - 34) / 12, 0, 1) * np.ones((SHAPE[0], 1), np.float32)
    before = final_confidence(alone, averaged(8, 8, spread))
    after = final_confidence(alone, averaged(8, 8, spread), bleeds=True)
    ends = [34, 46]
    assert before[:, ends].min() > 0.9
    assert (after[:, ends] < before[:, ends] - 0.03).all()
    assert after[:, :30].min() > 0.95


@pytest.mark.parametrize(("share", "noise"), [(0.0, 0.003), (0.1, 0.004), (0.2, 0.008)])
def test_the_error_is_told_from_landmarks_and_confidence(share: float, noise: float, rng: np.random.Generator) -> None:
    """A part of the depth is off by 10 %, and as unsure as that; landmarks lie there three times as often."""
    told, errors = ToldError(), []
    for _ in range(5):
        wrong = np.zeros(SHAPE, bool)
        wrong[:, : round(share * SHAPE[1])] = True
        off = np.where(wrong, 0.1, 0.0) + noise * rng.standard_normal(SHAPE)
        confidence = np.where(wrong, 0.1, 0.985).astype(np.float32)
        places = np.argwhere(rng.random(SHAPE) < np.where(wrong, 0.15, 0.05))
        uv = np.concatenate([places[:, ::-1], [[-3, 5], [500, 5]]]).astype(np.float64)
        told.add(off.astype(np.float32), confidence, np.ones(SHAPE, bool), uv, np.zeros(len(uv)))
        errors.append(np.abs(off).mean())
    mean = told.mean()
    assert mean is not None
    assert 1 / 1.5 < mean / np.mean(errors) < 1.5


def test_without_static_pixels_no_error_is_told_and_without_landmarks_the_usual_one() -> None:
    told, everywhere = ToldError(), np.ones(SHAPE, bool)
    assert told.mean() is None
    told.add(np.zeros(SHAPE, np.float32), np.ones(SHAPE, np.float32), everywhere, np.zeros((0, 2)), np.zeros(0))
    assert told.mean() == pytest.approx(0.0025)
    told.focal_depth_error = 0.01
    assert told.mean() == pytest.approx(np.hypot(0.0025, 0.01)), "what the focal length leaves open comes on top"


def test_an_error_that_all_frames_share_comes_on_top() -> None:
    told, everywhere = ToldError(from_motion=True), np.ones(SHAPE, bool)
    sure = np.full(SHAPE, 0.2, np.float32)
    told.add(np.zeros(SHAPE, np.float32), sure, everywhere, np.zeros((0, 2)), np.zeros(0), common_sigma=0.2)
    assert told.mean() == pytest.approx(np.hypot(0.066, 0.2 * np.sqrt(2 / np.pi)), rel=1e-5)


def test_depth_interpolated_between_points_is_farther_off_where_it_is_as_sure() -> None:
    """Two thirds of the pixels are quite sure, a third hardly; landmarks lie on what is interpolated between them."""
    sure, everywhere = np.full(SHAPE, 0.95, np.float32), np.ones(SHAPE, bool)
    sure[:, : SHAPE[1] // 3] = 0.2
    means = []
    for from_motion in (False, True):
        told = ToldError(from_motion)
        places = np.argwhere(everywhere)[:: 7 if from_motion else SHAPE[0] * SHAPE[1], ::-1].astype(np.float64)
        told.add(np.zeros(SHAPE, np.float32), sure, everywhere, places, np.zeros(len(places)))
        means.append(told.mean())
    part = (SHAPE[1] // 3) / SHAPE[1]
    expected = [part * 0.05 + (1 - part) * 0.0045, part * 0.066 + (1 - part) * 0.0102]
    np.testing.assert_allclose(means, expected, rtol=1e-5)


def test_high_probabilities_of_depth_from_motion_alone_are_as_often_right_as_they_were_on_rendered_clips() -> None:
    """Means over fifteen clips of how many pixels were right to 3 % of those that said 0.5 to 0.99."""
    said = np.float32([0.0, 0.5, 0.726, 0.824, 0.91, 0.95, 0.965, 0.983, 0.996, 1.0])
    right = [0.0, 0.5, 0.716, 0.756, 0.822, 0.879, 0.909, 0.947, 0.979, 1.0]
    told = as_often_right(said)
    np.testing.assert_allclose(told, right, atol=0.04)
    np.testing.assert_array_equal(told[:2], said[:2])
    assert np.all(np.diff(told) > 0)
    assert np.all(told <= said)


def test_depth_of_a_plain_surface_is_less_sure_and_that_of_texture_as_sure_as_before() -> None:
    """A wall beside a box: where the window of its pixels has the box in it, the texture is the box's."""
    gray = np.full((40, 60), 0.6, np.float32)
    gray[:, 30:] += np.random.default_rng(0).normal(0, 0.1, (40, 30)).astype(np.float32)
    gray[:5] = np.nan
    sure = np.full(gray.shape, 0.95, np.float32)
    told = without_texture(sure, gray, 2)
    np.testing.assert_allclose(told[5:, 30:], 0.95, atol=1e-5)
    assert told[5:, :30].max() < 0.01
    faint = np.float32(0.6) + np.float32(0.004) * (-1.0) ** np.indices(gray.shape, np.float32).sum(axis=0)
    # Half of what is plain: a quarter of the odds, 19 to 1.
    np.testing.assert_allclose(without_texture(sure, faint, 2).mean(), 4.75 / 5.75, atol=0.02)
    assert without_texture(np.float32([[0.0, 1.0]]), np.zeros((1, 2), np.float32), 2).max() == 0.0
