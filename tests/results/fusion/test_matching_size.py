"""Large frames are matched at half their size, with settings that do there what they do at the usual one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.results.fusion.matching_choice import bleeding_of
from uni4d_fg.results.fusion.matching_size import USUAL_SIDE, finer_settings, matching_side, times_finer
from uni4d_fg.results.fusion.multiview.ideal_size import ideal_size
from uni4d_fg.results.fusion.multiview.sweep import sweep
from uni4d_fg.results.fusion.multiview.working_frame import WorkingSize
from uni4d_fg.results.fusion.pixel_transfer import pixel_transfer
from uni4d_fg.results.fusion.told_error import without_texture

GIVEN = MultiviewConfig()


@pytest.mark.parametrize(
    ("size", "side"),
    [
        ((480, 640), 320),
        ((480, 854), 427),
        ((854, 480), 427),
        ((540, 960), 448),
        ((1080, 1920), 448),
        ((240, 320), 320),
    ],
)
def test_large_frames_are_matched_at_half_their_size(size: tuple[int, int], side: int) -> None:
    assert matching_side(size, GIVEN) == side
    made = WorkingSize.of(size, matching_side(size, GIVEN))
    assert max(made.height, made.width) == min(side, max(size))
    assert made.times_finer == pytest.approx(max(1.0, side / USUAL_SIDE))


def test_who_wants_less_gets_less() -> None:
    assert matching_side((1080, 1920), MultiviewConfig(longer_side_px=256)) == 256
    assert matching_side((480, 640), MultiviewConfig(least_side_px=480, longer_side_px=480)) == 480


def test_settings_stay_at_the_usual_size_and_below() -> None:
    for side in (100, USUAL_SIDE):
        assert finer_settings(GIVEN, times_finer((side,))) == GIVEN
    finer = finer_settings(GIVEN, times_finer((2 * USUAL_SIDE,)))
    assert finer.image_noise == 2 * GIVEN.image_noise
    assert finer.large_step_penalty == 4 * GIVEN.large_step_penalty
    assert (finer.small_step_penalty, finer.mask_band_px) == (120, 6)
    assert finer_settings(MultiviewConfig(small_step_penalty=200), 2.0).small_step_penalty == 255  # of a byte
    assert finer_settings(MultiviewConfig(large_step_penalty=900), 2.0).large_step_penalty == 1000
    assert bleeding_of(np.nan, poor=True, finer=2.0) == 2 * bleeding_of(np.nan, poor=True)


def test_a_lens_makes_maps_larger_and_not_finer() -> None:
    plain = WorkingSize.of((240, 320), 320)
    bent = ideal_size(plain, Lens("SIMPLE_RADIAL", (-0.12,)), np.array([200.0, 200.0, 159.5, 119.5]))
    assert bent is not None
    assert times_finer((bent.height, bent.width)) > 1.0
    assert bent.times_finer == 1.0


def test_noise_of_finer_pixels_is_no_texture(rng: np.random.Generator) -> None:
    """The mean of fewer pixels has more noise: what it takes from confidence is the same."""
    lost = []
    for finer in (1.0, 1.4):
        shape = (round(180 * finer), round(320 * finer))
        gray = (0.5 + 0.003 * finer * rng.standard_normal(shape)).astype(np.float32)
        lost.append(float(without_texture(np.full(shape, 0.9, np.float32), gray, 2).mean()))
    assert lost[0] < 0.7
    assert lost[1] == pytest.approx(lost[0], abs=0.05)


def test_a_plain_wall_is_flatter_with_the_settings_of_its_size(rng: np.random.Generator) -> None:
    """Plain but for noise between two textured parts, found from two views beside each other."""
    texture, noise = rng.uniform(0.2, 0.8, (256, 904)), 0.012 * rng.standard_normal((2, 256, 896))
    images = np.stack([texture[:, 8:], texture[:, :-8]])
    images[0, :, 250:650] = images[1, :, 258:658] = 0.5
    side = 448
    own, other = (
        cv2.resize(image.astype(np.float32), (side, 128), interpolation=cv2.INTER_AREA) for image in images + noise
    )
    camera, pose = np.array([400.0, 400.0, 223.5, 63.5]), np.eye(4)
    pose[0, 3] = 0.01  # 4 px at a depth of 1
    at = pixel_transfer(camera, camera, pose)

    def unevenness(settings: MultiviewConfig) -> float:
        found = sweep(own, [other], [at], np.linspace(0.2, 2.0, 32), settings, 1).inverse_depth
        assert np.median(found[10:-10, 10:115]) == pytest.approx(1.0, abs=0.03)
        return float(np.std(found[10:-10, 135:315]))

    assert unevenness(finer_settings(GIVEN, side / USUAL_SIDE)) < 0.8 * unevenness(GIVEN)
