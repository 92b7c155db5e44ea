"""How sure the depth of landmarks is, as fusion weighs them."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.pipeline.landmark_sigma import common_sigma, landmark_shares, variance_of_rays

FRAMES = 20


def shares(points: FloatArray, step: FloatArray, noise_depth: float = 10.0) -> FloatArray:
    """Shares of landmarks (L, 3) that a camera sees which moves by ``step`` (3,) per frame."""
    labelled, scene, intrinsics = seen_from(points, step, noise_depth)
    return landmark_shares(labelled, scene, variance_of_rays(labelled, scene, intrinsics))


def seen_from(
    points: FloatArray, step: FloatArray, noise_depth: float = 10.0
) -> tuple[LabelledTracks, dict[str, FloatArray], FloatArray]:
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = np.arange(FRAMES)[:, None] * step
    count = len(points)
    seen = np.ones((count, FRAMES), dtype=bool)
    labelled = LabelledTracks(
        Tracks(np.zeros((count, FRAMES, 2), np.float32), seen, np.zeros(count, np.int32)),
        label=np.ones(count, np.int8), instance=np.zeros(count, np.int32),
        weight=seen.astype(np.float32), depth=np.ones((count, FRAMES), np.float32),
    )  # fmt: skip
    scene = {
        "landmarks": points, "landmark_track": np.arange(count), "world_T_cam": poses,
        "noise": np.array([0.1, noise_depth]),
    }  # fmt: skip
    return labelled, scene, np.tile([400.0, 400.0, 160.0, 120.0], (FRAMES, 1))


def test_landmarks_in_the_direction_of_motion_count_little(rng: np.random.Generator) -> None:
    points = np.column_stack([rng.uniform(-1.5, 1.5, (4000, 2)), np.full(4000, 4.0)])
    found = shares(points, np.array([0.0, 0.0, 0.03]))
    off_axis = np.linalg.norm(points[:, :2], axis=1)
    assert found[off_axis < 0.06].max() < 0.1
    assert found[off_axis > 1.0].min() == 1.0
    # The variance falls with the square of the distance from the axis.
    between = (off_axis > 0.06) & (off_axis < 0.15)
    ratio = found[between] / off_axis[between] ** 2
    assert ratio.std() / ratio.mean() < 0.1


@pytest.mark.parametrize(("step", "noise_depth"), [([0.03, 0.0, 0.0], 10.0), ([0.0, 0.0, 0.0], 10.0),
                                                   ([0.0, 0.0, 0.03], 0.01)])  # fmt: skip
def test_all_count_alike_with_parallax_everywhere_or_nowhere_and_with_a_good_cue(
    rng: np.random.Generator, step: list[float], noise_depth: float
) -> None:
    points = np.column_stack([rng.uniform(-1.5, 1.5, (400, 2)), np.full(400, 4.0)])
    np.testing.assert_allclose(shares(points, np.array(step), noise_depth), 1.0, atol=1e-9)


def test_no_landmarks() -> None:
    assert shares(np.zeros((0, 3)), np.zeros(3)).shape == (0,)


def test_depth_of_landmarks_alone_is_as_sure_as_parallax_makes_it(rng: np.random.Generator) -> None:
    """With noise of s px, focal length f and steps b beside depth z, log depth has s z / (f b) / sqrt(sum of i^2)."""
    z, step = 4.0, 0.002
    points = np.column_stack([rng.uniform(-0.2, 0.2, (500, 2)), np.full(500, z)])
    variance = variance_of_rays(*seen_from(points, np.array([step, 0.0, 0.0])))
    # Where the landmark is across its rays is unknown, too: depth is told by how far cameras are from their mean.
    spread = np.sqrt(np.sum((np.arange(FRAMES) - (FRAMES - 1) / 2) ** 2))
    expected = 0.1 * z / (400.0 * step) / spread
    assert np.sqrt(np.median(variance)) == pytest.approx(expected, rel=0.03)
    assert common_sigma(variance) == pytest.approx(min(20 * expected, 1.0), rel=0.03)
    assert common_sigma(variance_of_rays(*seen_from(points, np.zeros(3)))) == 1.0
    assert common_sigma(np.zeros(0)) == 1.0
