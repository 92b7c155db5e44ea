"""Depth of moving things from one camera: its shake, apparent sizes, and where things stand."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.cues.camera_noise import CameraNoise
from uni4d_fg.cues.moving_parallax import moving_parallax, regress
from uni4d_fg.cues.moving_things import Sightings, place_moving, weigh
from uni4d_fg.factors.static_reprojection import static_reprojection_jacobian
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry import se3

FRAMES, FOCAL, SIZE = 40, 400.0, (240, 320)
INTRINSICS = np.array([FOCAL, FOCAL, 160.0, 120.0])
TIME = np.arange(FRAMES) / 15.0
EXACT = CameraNoise(np.zeros((FRAMES, 3, 3)), 0.0)


def camera(tremor_m: float) -> FloatArray:
    """A camera that goes sideways, (T, 3), with a hand's tremor at 2.3 Hz."""
    phase = np.array([0.0, 2.1, 4.4])
    return TIME[:, None] * [0.3, 0.05, 0.0] + tremor_m * np.sin(2 * np.pi * 2.3 * TIME[:, None] + phase)


def thing(speed_z: float = 0.0) -> FloatArray:
    """The middle (T, 3) of a thing 2 m away that swings at 0.25 Hz."""
    swing = 0.3 * np.sin(2 * np.pi * 0.25 * TIME)
    return np.stack([swing, 0.4 * swing**2, 2.0 + speed_z * TIME], axis=1)


def poses(centers: FloatArray) -> FloatArray:
    out = np.tile(np.eye(4), (FRAMES, 1, 1))
    out[:, :3, 3] = centers
    return out


def seen(middle: FloatArray, centers: FloatArray, noise_px: float, seed: int = 0) -> Tracks:
    """60 points of a thing of 0.4 m as tracks."""
    rng = np.random.default_rng(seed)
    points = middle + rng.uniform(-0.2, 0.2, (60, 1, 3)) * [1, 1, 0]
    x = points - centers
    uv = FOCAL * x[..., :2] / x[..., 2:] + INTRINSICS[2:] + rng.normal(0, noise_px, (60, FRAMES, 2))
    return Tracks(uv.astype(np.float32), np.ones((60, FRAMES), dtype=bool), np.zeros(60, dtype=np.int32))


@pytest.mark.parametrize("seed", range(4))
def test_the_cameras_shake_shows_how_far_a_moving_thing_is(seed: int) -> None:
    centers = camera(0.006)
    tracks = seen(thing(), centers, 0.1, seed)
    (found,) = moving_parallax(tracks.uv.astype(np.float64), tracks.visible, poses(centers), INTRINSICS, EXACT)
    assert found.first == 0
    assert found.size.shape == (FRAMES,)
    assert found.inverse_depth == pytest.approx(0.5, rel=0.1)
    assert found.sigma < 0.05


def test_a_camera_that_moves_evenly_shows_nothing_of_it() -> None:
    centers = camera(0.0)
    tracks = seen(thing(), centers, 0.1)
    (found,) = moving_parallax(tracks.uv.astype(np.float64), tracks.visible, poses(centers), INTRINSICS, EXACT)
    assert found.sigma > 10 * abs(0.5)


def test_errors_of_the_image_do_not_bias_the_regression() -> None:
    estimates = [
        regress(-0.5 * camera(0.006)[:, :2] + np.random.default_rng(seed).normal(0, 3e-3, (FRAMES, 2)),
                camera(0.006)[:, :2], np.zeros((FRAMES, 2)), 0.0)[0]
        for seed in range(200)
    ]  # fmt: skip
    assert np.mean(estimates) == pytest.approx(0.5, abs=4 * np.std(estimates) / np.sqrt(200))


@pytest.mark.parametrize(("sigma_m", "is_open"), [(0.0012, False), (0.004, True)])
def test_errors_of_the_cameras_are_not_taken_for_shake(sigma_m: float, is_open: bool) -> None:
    """A camera that is wrong in position turns so that what stands 5 m away stays: things seem to be there, too."""
    behind, found = 0.2, []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        wrong = rng.normal(0, sigma_m, (FRAMES, 2))
        centers = camera(0.006)[:, :2]
        path = -0.5 * centers - behind * wrong + rng.normal(0, 2e-4, (FRAMES, 2))
        variance = np.full((FRAMES, 2), sigma_m**2)
        trusting = regress(path, centers + wrong, np.zeros((FRAMES, 2)), behind)
        found.append((*trusting, *regress(path, centers + wrong, variance, behind)))
    trusted, trusted_sigma, u, sigma = np.array(found).T
    if is_open:
        assert np.mean(np.abs(trusted - 0.5) > 4 * trusted_sigma) > 0.9  # wrong, and sure of it
        assert np.mean(np.isinf(sigma)) > 0.9
    else:
        assert np.mean(np.abs(u - 0.5) < 2 * sigma) > 0.95
        assert abs(u.mean() - 0.5) < 0.3 * abs(trusted.mean() - 0.5)


def test_cameras_are_as_exact_as_is_told(rng: np.random.Generator) -> None:
    """Poses that are found again and again from known points spread as the covariance says."""
    points = np.stack([rng.uniform(-2, 2, 80), rng.uniform(-1.5, 1.5, 80), rng.uniform(3, 8, 80)], axis=1)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = se3.so3_exp(np.array([0.1, -0.2, 0.05])), [0.3, -0.1, 0.2]
    x = (points - pose[:3, 3]) @ pose[:3, :3]
    uv = FOCAL * x[:, :2] / x[:, 2:] + INTRINSICS[2:]

    def seen_as(pixels: np.ndarray) -> Tracks:
        return Tracks(pixels[:, None].astype(np.float32), np.ones((80, 1), bool), np.zeros(80, np.int32))

    centers = []
    for _ in range(300):
        noisy, found = uv + rng.normal(0, 0.3, uv.shape), pose
        for _ in range(3):
            at = np.broadcast_to(found, (80, 4, 4)), points, np.broadcast_to(INTRINSICS, (80, 4))
            residual, (by_pose, *_) = static_reprojection_jacobian(*at, uv=noisy)
            step = np.linalg.lstsq(by_pose.reshape(-1, 6), -residual.ravel(), rcond=None)[0]
            found = found @ se3.se3_exp(step)
        centers.append(found[:3, 3])
    told = CameraNoise.of_points(np.arange(80), points, seen_as(noisy), found[None], INTRINSICS)
    np.testing.assert_allclose(np.sqrt(np.diag(told.covariance[0])), np.std(centers, axis=0), rtol=0.35)
    assert told.inverse_depth == pytest.approx(float(np.median(1 / x[:, 2])), rel=0.02)
    few = CameraNoise.of_points(np.arange(5), points[:5], seen_as(noisy), found[None], INTRINSICS)
    assert np.isinf(np.diag(few.covariance[0])).all()


def test_the_apparent_size_follows_a_thing_that_comes_near() -> None:
    centers, middle = camera(0.006), thing(speed_z=-0.3)
    tracks = seen(middle, centers, 0.1)
    (found,) = moving_parallax(tracks.uv.astype(np.float64), tracks.visible, poses(centers), INTRINSICS, EXACT)
    z = (middle - centers)[:, 2]
    at_one = found.size * z
    assert at_one.std() / at_one.mean() < 0.01
    assert found.inverse_depth == pytest.approx(1 / at_one.mean(), rel=0.1)


def test_what_turns_about_its_height_changes_its_size_half_as_much(rng: np.random.Generator) -> None:
    # A thing half a meter deep and 0.1 m wide turns by 80 degrees at 2.5 m, and is as tall as before.
    inside = rng.uniform((-0.05, -0.3, -0.25), (0.05, 0.3, 0.25), size=(200, 3))
    angle = np.radians(np.linspace(0, 80, FRAMES))
    cosine, sine = np.cos(angle), np.sin(angle)
    x = inside[:, :1] * cosine + inside[:, 2:] * sine
    z = 2.5 - inside[:, :1] * sine + inside[:, 2:] * cosine
    uv = np.stack((FOCAL * x / z + 160, FOCAL * inside[:, 1:2] / z + 120), axis=2)
    (found,) = moving_parallax(uv, np.ones(uv.shape[:2], bool), poses(np.zeros((FRAMES, 3))), INTRINSICS, EXACT)
    # Distances in all directions say 0.35, those along its height nothing.
    assert np.ptp(np.log(found.size)) < 0.2


@pytest.mark.parametrize(
    ("ratio", "sigma", "cut", "stands", "factor", "contradicts"),
    [
        (0.0, np.inf, False, True, 1.0, False),
        (1.05, 0.1, False, True, 1.04, False),
        (2.5, 0.15, False, False, 2.5, False),
        (10.0, 4.0, False, True, 1.0, False),  # nearly nothing
        (-30.0, 10.0, False, True, 1.0, True),  # not a motion that the model has
        (-3.0, 0.1, True, False, 1.8, True),
        (0.4, 0.1, False, True, 1.0, True),  # nothing is behind what it hides
        (2.5, 0.15, True, False, 2.5, False),
        (0.0, np.inf, True, False, 1.8, False),
    ],
)
def test_standing_and_being_nearer_are_weighed(
    ratio: float, sigma: float, cut: bool, stands: bool, factor: float, contradicts: bool
) -> None:
    found = weigh(ratio, sigma, cut)
    assert found.stands == stands
    assert np.exp(found.log_ratio) == pytest.approx(factor, rel=0.1, abs=0.01)
    assert found.contradicts == contradicts


def sightings(tracks: Tracks, rows: slice) -> Sightings:
    """A mask that holds all tracks but for its rows."""
    out = Sightings(tracks)
    mask = np.zeros(SIZE, dtype=np.int32)
    mask[rows] = 3
    for frame in range(FRAMES):
        out.add(frame, mask)
    return out


def test_a_thing_that_floats_is_put_nearer_than_what_is_below_it() -> None:
    centers = camera(0.006)
    middle = thing(speed_z=-0.2)
    tracks = seen(middle, centers, 0.1)
    contacts = tuple({3: 0.2} for _ in range(FRAMES))
    placed = place_moving(contacts, sightings(tracks, slice(0, 239)), tracks, poses(centers), INTRINSICS, EXACT)
    z = 1 / np.array([values[3] for values in placed.inverse_depth])
    np.testing.assert_allclose(z, (middle - centers)[:, 2], rtol=0.12)
    assert placed.nearer[3] == pytest.approx(2.7, rel=0.1)
    assert not placed.open


def test_without_shake_it_stays_where_it_may_stand_and_a_thing_that_is_cut_off_is_named() -> None:
    centers = camera(0.0)
    tracks = seen(thing(), centers, 0.1)
    contacts = tuple({3: 0.2} for _ in range(FRAMES))
    placed = place_moving(contacts, sightings(tracks, slice(0, 239)), tracks, poses(centers), INTRINSICS, EXACT)
    # It keeps its distance, as its apparent size tells with noise of its own.
    np.testing.assert_allclose([values[3] for values in placed.inverse_depth], 0.2, rtol=2e-3)
    assert not placed.nearer
    assert not placed.open
    cut = place_moving(contacts, sightings(tracks, slice(0, 240)), tracks, poses(centers), INTRINSICS, EXACT)
    assert cut.open == [3]
    assert not cut.nearer  # that it is nearer than what is seen below is a guess


def test_frames_whose_masks_lose_feet_follow_the_others_by_apparent_size() -> None:
    centers, middle = camera(0.0), thing(speed_z=-0.2)
    tracks = seen(middle, centers, 0.1)
    z = (middle - centers)[:, 2]
    # It stands where its mask ends, but in three of five frames that ends higher.
    lost = np.where(np.arange(FRAMES) % 5 > 1, 0.7, 1.0)
    contacts = tuple({3: value} for value in (lost / z).tolist())
    placed = place_moving(contacts, sightings(tracks, slice(0, 239)), tracks, poses(centers), INTRINSICS, EXACT)
    found = 1 / np.array([values[3] for values in placed.inverse_depth])
    np.testing.assert_allclose(found, z, rtol=0.02)


@pytest.mark.parametrize(
    ("whole", "at_border", "stands"),
    [
        (1.0, 0.85, True),  # it comes nearer until its feet are below the image
        (0.6, 0.85, False),  # its lower part was missed in the frames in which it does not reach the border
    ],
)
def test_what_is_seen_whole_in_some_frames_stands_where_it_does_there(
    whole: float, at_border: float, stands: bool
) -> None:
    centers, middle = camera(0.0), thing(speed_z=-0.2)
    tracks, z = seen(middle, centers, 0.1), (middle - centers)[:, 2]
    is_cut = np.arange(FRAMES) >= 0.4 * FRAMES
    contacts = tuple({3: value} for value in (np.where(is_cut, at_border, whole) / z).tolist())
    found = Sightings(tracks)
    for frame in range(FRAMES):
        mask = np.zeros(SIZE, dtype=np.int32)
        mask[: 240 if is_cut[frame] else 239] = 3
        found.add(frame, mask)
    placed = place_moving(contacts, found, tracks, poses(centers), INTRINSICS, EXACT)
    ratio = np.array([values[3] for values in placed.inverse_depth]) * z
    assert placed.open == ([] if stands else [3])
    if stands:
        np.testing.assert_allclose(ratio, 1.0, rtol=0.02)
    else:
        # As where it is always cut off: nearer by the mean of what is likely.
        assert np.median(ratio) == pytest.approx(at_border * np.exp(weigh(0.0, np.inf, True).log_ratio), rel=0.03)


@pytest.mark.parametrize(("width", "factor"), [(0, 1.0), (100, np.exp(0.2))])
def test_what_walks_with_its_legs_cut_off_is_a_little_nearer(width: int, factor: float) -> None:
    centers = camera(0.0)
    tracks = seen(thing(), centers, 0.1)
    found = Sightings(tracks)
    mask = np.zeros(SIZE, dtype=np.int32)
    mask[:200] = 3
    mask[200:, :width] = 3
    for frame in range(FRAMES):
        found.add(frame, mask)
    contacts = tuple({3: 0.2} for _ in range(FRAMES))
    placed = place_moving(contacts, found, tracks, poses(centers), INTRINSICS, EXACT)
    np.testing.assert_allclose([values[3] for values in placed.inverse_depth], 0.2 * factor, rtol=0.03)
    assert not placed.nearer
    assert not placed.open


def test_things_without_tracks_and_frames_without_things_are_left_alone() -> None:
    nothing = Tracks(np.zeros((0, 3, 2), np.float32), np.zeros((0, 3), dtype=bool), np.zeros(0, dtype=np.int32))
    found = Sightings(nothing)
    for frame in range(3):
        mask = np.zeros(SIZE, dtype=np.int32)
        mask[50:60] = 2 * (frame > 0)
        found.add(frame, mask)
    placed = place_moving(
        ({}, {2: 0.3}, {2: 0.4}),
        found,
        nothing,
        np.tile(np.eye(4), (3, 1, 1)),
        INTRINSICS,
        CameraNoise(np.zeros((3, 3, 3)), 0.0),
    )
    assert placed.inverse_depth == ({}, {2: 0.3}, {2: 0.4})


@pytest.mark.parametrize(("width", "is_cut"), [(0, False), (12, False), (20, True), (40, True)])
def test_a_foot_or_a_shadow_at_the_lower_border_cuts_nothing_off(width: int, is_cut: bool) -> None:
    mask = np.zeros((60, 80), np.int32)
    mask[10:50, 20:60] = 2
    mask[50:, 20 : 20 + width] = 2
    tracks = Tracks(np.full((1, 1, 2), 30.0, np.float32), np.ones((1, 1), bool), np.zeros(1, np.int32))
    seen = Sightings(tracks)
    seen.add(0, mask)
    assert seen.is_cut(2) == is_cut
    remnant = np.zeros_like(mask)
    remnant[45:49, 20:24] = 2
    for _ in range(5):  # what is left of a mask while the thing comes and goes
        seen.add(0, remnant)
    assert seen.is_cut(2) == is_cut


def test_what_stands_by_a_thing_that_is_cut_off_is_cut_off_as_well() -> None:
    tracks = Tracks(np.zeros((1, 2, 2), np.float32), np.zeros((1, 2), dtype=bool), np.zeros(1, dtype=np.int32))
    sightings = Sightings(tracks)
    mask = np.zeros((60, 40), np.int32)
    mask[10:30, 10:30], mask[30:, 12:28] = 1, 2
    for frame in range(2):
        sightings.add(frame, mask)
    assert (sightings.is_cut(1), sightings.is_cut(2)) == (False, True)
    sightings.stand_by([{1: 2, 2: 2}, {1: 2, 2: 2}])
    assert (sightings.is_cut(1), sightings.is_cut(2)) == (True, True)
