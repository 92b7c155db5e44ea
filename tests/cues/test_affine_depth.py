"""Scale and shift of relative depth, against known ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.config.geometric_depth import AffineDepthConfig
from uni4d_fg.cues.affine_depth import AffineAlignment, align_affine
from uni4d_fg.errors import Cancelled, DegenerateProblemError, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.track_model import Tracks

FRAMES, POINTS, HEIGHT, WIDTH = 6, 120, 60, 80


class Case:
    """Frames whose inverse depth is smooth in the image, points on them, and a network's affine view of them."""

    def __init__(self, seed: int, scale: np.ndarray, shift: np.ndarray) -> None:
        rng = np.random.default_rng(seed)
        rows, columns = np.indices((HEIGHT, WIDTH))
        slope = rng.uniform(0.004, 0.006, (FRAMES, 1, 1))
        self.inverse = 0.15 + slope * rows + 0.002 * columns  # bilinear sampling of it is exact
        uv = rng.uniform(0, (WIDTH - 1, HEIGHT - 1), (POINTS, FRAMES, 2)).astype(np.float32)
        self.tracks = Tracks(uv, np.ones((POINTS, FRAMES), dtype=bool), np.zeros(POINTS, dtype=np.int32))
        exact = 0.15 + slope[:, 0, 0] * uv[..., 1] + 0.002 * uv[..., 0]
        self.sparse = (1.0 / exact).astype(np.float32)
        self.scale, self.shift = scale, shift
        # 1/z = a d + b
        self.network = ((self.inverse - shift[:, None, None]) / scale[:, None, None]).astype(np.float32)

    def align(self, config: AffineDepthConfig | None = None, **options: object) -> AffineAlignment:
        return align_affine(
            ArrayFrames(self.network), self.tracks, self.sparse, config or AffineDepthConfig(), **options  # type: ignore[arg-type]
        )  # fmt: skip


def smooth_case(seed: int = 0) -> Case:
    t = np.arange(FRAMES)
    return Case(seed, 0.02 * (1 + 0.03 * np.sin(t)), 0.05 + 0.01 * np.cos(t))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 100), unit=st.floats(1e-3, 1e3), origin=st.floats(-5, 5))
def test_known_scale_and_shift_are_found_whatever_the_networks_unit(seed: int, unit: float, origin: float) -> None:
    case = smooth_case(seed)
    case.network = (unit * (case.network + origin)).astype(np.float32)
    found = case.align()
    scale = case.scale / unit
    np.testing.assert_allclose(found.scale, scale, rtol=2e-3)
    np.testing.assert_allclose(found.shift, case.shift - case.scale * origin, atol=2e-3)
    np.testing.assert_allclose(found.depths[2], 1.0 / case.inverse[2], rtol=3e-3)
    assert found.points.tolist() == [POINTS] * FRAMES


def test_outliers_and_noise_are_borne(rng: np.random.Generator) -> None:
    case = smooth_case()
    case.sparse *= np.exp(rng.normal(0, 0.02, case.sparse.shape)).astype(np.float32)
    case.sparse[: POINTS // 4] *= 3.0
    found = case.align()
    for frame in range(FRAMES):
        relative = np.abs(found.depths[frame] * case.inverse[frame] - 1.0)
        assert relative.max() < 0.03
        assert relative.mean() < 0.01
    assert found.sigma == pytest.approx(0.02, rel=0.7)


def test_a_frame_without_points_follows_its_neighbors() -> None:
    case = Case(1, np.full(FRAMES, 0.02), np.full(FRAMES, 0.05))
    case.sparse[:, 3] = np.nan
    case.sparse[:3, 3] = 0.01  # three wild points are no say
    found = case.align()
    np.testing.assert_allclose(found.scale[3], 0.02, rtol=1e-3)
    np.testing.assert_allclose(found.shift[3], 0.05, rtol=1e-2)
    assert found.points[3] == 0
    assert found.warnings == (
        "relative depth of 1 frame(s) has too few points (or contradicts them) and takes scale and shift from its "
        "neighbors: 3",
    )


def test_jumps_of_the_network_are_followed_where_there_are_points() -> None:
    case = Case(2, np.array([0.02, 0.02, 0.05, 0.02, 0.02, 0.02]), np.full(FRAMES, 0.05))
    found = case.align()
    np.testing.assert_allclose(found.scale, case.scale, rtol=0.02)


def test_no_depth_is_negative_and_far_ones_are_cut() -> None:
    case = smooth_case()
    case.network[:, :5] = -1000.0
    case.tracks.uv[..., 1] = np.clip(case.tracks.uv[..., 1], 8, None)
    exact = case.inverse[:, 0, 0, None] * 0  # depth at the moved points
    rows = np.swapaxes(case.tracks.uv[..., 1], 0, 1)
    slope = case.inverse[:, 1, 0] - case.inverse[:, 0, 0]
    exact = 0.15 + slope[:, None] * rows + 0.002 * np.swapaxes(case.tracks.uv[..., 0], 0, 1)
    case.sparse = (1.0 / exact.T).astype(np.float32)
    found = case.align(AffineDepthConfig(max_depth_ratio=5.0))
    far = found.depths[0]
    assert (far > 0).all()
    np.testing.assert_allclose(far[:5], 5.0 * np.median(case.sparse[:, 0]), rtol=1e-3)
    np.testing.assert_allclose(far[8:], 1.0 / case.inverse[0, 8:], rtol=5e-3)


def test_inverse_depth_up_to_scale_keeps_its_origin() -> None:
    case = Case(3, np.linspace(0.5, 0.6, FRAMES), np.zeros(FRAMES))
    found = case.align(free_shift=False)
    np.testing.assert_array_equal(found.shift, 0.0)
    np.testing.assert_allclose(found.scale, case.scale, rtol=2e-3)


def test_missing_values_stay_missing() -> None:
    case = smooth_case()
    case.network[:, 10:20] = np.nan
    found = case.align()
    assert np.isnan(found.depths[1][10:20]).all()
    np.testing.assert_allclose(found.depths[1][30:], 1.0 / case.inverse[1, 30:], rtol=5e-3)


def test_values_that_fall_with_nearness_are_refused() -> None:
    case = smooth_case()
    case.network = -case.network
    with pytest.raises(DegenerateProblemError, match="fall where the scene comes nearer"):
        case.align()


def test_one_frame_that_contradicts_its_points_is_bridged() -> None:
    case = Case(4, np.full(FRAMES, 0.02), np.full(FRAMES, 0.05))
    case.network[2] = -case.network[2]
    found = case.align()
    assert (found.scale > 0).all()
    assert found.points[2] == 0
    np.testing.assert_allclose(found.scale[[0, 5]], 0.02, rtol=0.02)


def test_wrong_input_is_one_clear_error() -> None:
    case = smooth_case()
    with pytest.raises(InputError, match="one map per frame"):
        align_affine(ArrayFrames(case.network[:-1]), case.tracks, case.sparse, AffineDepthConfig())
    with pytest.raises(Cancelled):
        case.align(should_stop=lambda: True)
    case.sparse[:] = np.nan
    with pytest.raises(DegenerateProblemError, match="no frame has 8 points"):
        case.align()
