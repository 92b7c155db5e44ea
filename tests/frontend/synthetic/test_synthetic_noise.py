import numpy as np
import pytest

from uni4d_fg.config.cue_noise import CueNoise
from uni4d_fg.frontend.synthetic.noise import noisy_depths, noisy_masks, noisy_tracks
from uni4d_fg.frontend.synthetic.tracks import ExactTracks

SIZE = (240, 320)


@pytest.fixture(scope="module")
def exact() -> ExactTracks:
    """Tracks well inside the image, seen in most frames."""
    rng = np.random.default_rng(7)
    uv = rng.uniform([40, 40], [280, 200], (2000, 20, 2))
    visible = rng.random((2000, 20)) < 0.8
    query_frame = rng.integers(0, 20, 2000).astype(np.int32)
    visible[np.arange(2000), query_frame] = True
    return ExactTracks(np.zeros((2000, 20, 3)), uv, visible, query_frame, np.zeros(2000, dtype=np.int32))


def test_track_noise_has_its_deviation(exact: ExactTracks) -> None:
    noise = CueNoise.none().model_copy(update={"track_sigma_px": 0.5})
    tracks = noisy_tracks(exact, noise, SIZE, seed=0)
    np.testing.assert_array_equal(tracks.visible, exact.visible)
    error = (tracks.uv - exact.uv)[tracks.visible]
    assert error.std() == pytest.approx(0.5, rel=0.02)
    assert abs(error.mean()) < 0.01


def test_outliers_have_their_fraction_and_size(exact: ExactTracks) -> None:
    noise = CueNoise.none().model_copy(update={"outlier_fraction": 0.02})
    tracks = noisy_tracks(exact, noise, SIZE, seed=0)
    distance = np.linalg.norm(tracks.uv - exact.uv, axis=-1)
    outlier = distance > 0.1
    later = exact.visible & (np.arange(20) != exact.query_frame[:, None])
    assert outlier[later].mean() == pytest.approx(0.02, rel=0.15)
    assert not outlier[exact.visible & ~later].any()
    assert distance[outlier].min() > 3.99
    assert 19.0 < distance[outlier].max() < 20.01


def test_visibility_errors_have_their_fractions(exact: ExactTracks) -> None:
    noise = CueNoise.none().model_copy(update={"visibility_drop_fraction": 0.05, "false_visibility_fraction": 0.1})
    tracks = noisy_tracks(exact, noise, SIZE, seed=0)
    later = np.arange(20) != exact.query_frame[:, None]
    assert 1 - tracks.visible[exact.visible & later].mean() == pytest.approx(0.05, rel=0.1)
    assert tracks.visible[~exact.visible].mean() == pytest.approx(0.1, rel=0.1)
    assert tracks.visible[~later].all()


def test_observations_pushed_out_of_the_image_are_not_visible(exact: ExactTracks) -> None:
    noise = CueNoise.none().model_copy(update={"track_sigma_px": 20.0})
    tracks = noisy_tracks(exact, noise, SIZE, seed=0)
    assert tracks.visible.sum() < exact.visible.sum()
    seen = tracks.uv[tracks.visible]
    assert (seen >= 0).all()
    assert (seen <= [319, 239]).all()


def test_depth_flicker_matches_its_parameter_and_its_truth() -> None:
    depths = np.full((400, 24, 32), 2.0, dtype=np.float32)
    noise = CueNoise.none().model_copy(update={"depth_flicker": 0.04})
    cue, log_scale = noisy_depths(depths, noise, seed=3)
    assert log_scale.std() == pytest.approx(0.04, rel=0.1)
    assert abs(log_scale.mean()) < 0.01
    np.testing.assert_allclose(cue * np.exp(log_scale)[:, None, None], depths, rtol=1e-6)


def test_the_depth_field_is_smooth_and_independent_per_frame() -> None:
    depths = np.full((20, 120, 160), 2.0, dtype=np.float32)
    cue, log_scale = noisy_depths(depths, CueNoise.none().model_copy(update={"depth_field": 0.02}), seed=0)
    np.testing.assert_array_equal(log_scale, 0.0)
    error = np.log(cue / 2.0)
    np.testing.assert_allclose(error.std(axis=(1, 2)), 0.02, rtol=1e-3)
    assert np.abs(np.diff(error, axis=2)).max() < 0.006
    correlation = np.corrcoef(error.reshape(20, -1))
    assert np.abs(correlation[~np.eye(20, dtype=bool)]).mean() < 0.3


def test_pixel_noise_is_relative_and_holes_have_their_fraction() -> None:
    depths = np.full((4, 240, 320), 3.0, dtype=np.float32)
    noise = CueNoise.none().model_copy(update={"depth_pixel": 0.01, "hole_fraction": 0.05})
    cue, _ = noisy_depths(depths, noise, seed=0)
    assert np.isnan(cue).mean() == pytest.approx(0.05, rel=0.02)
    assert np.nanstd(np.log(cue / 3.0)) == pytest.approx(0.01, rel=0.02)
    assert (cue[np.isfinite(cue)] > 0).all()


def test_masks_leak_by_no_more_than_their_limit() -> None:
    masks = np.zeros((12, 120, 160), dtype=np.int32)
    masks[:, 40:80, 50:90] = 1
    masks[:, 60:100, 110:140] = 2
    leaking = noisy_masks(masks, CueNoise(mask_error_px=3), seed=0)
    assert leaking.dtype == np.int32
    assert set(np.unique(leaking)) == {0, 1, 2}
    assert (leaking[:, 46:74, 56:84] == 1).all()
    assert (leaking[:, :34] == 0).all()
    wrong = (leaking != masks).mean(axis=(1, 2))
    assert (wrong > 0).mean() > 0.8
    assert len(np.unique(wrong)) > 4
    np.testing.assert_array_equal(noisy_masks(masks, CueNoise(mask_error_px=0), seed=0), masks)


def test_the_noise_of_one_cue_does_not_change_another(exact: ExactTracks) -> None:
    quiet = noisy_tracks(exact, CueNoise(depth_flicker=0.0, mask_error_px=0), SIZE, seed=5)
    loud = noisy_tracks(exact, CueNoise(depth_flicker=0.2, mask_error_px=9), SIZE, seed=5)
    np.testing.assert_array_equal(quiet.uv, loud.uv)
