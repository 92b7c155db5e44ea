"""Depth from camera motion alone, against the truth of synthetic scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from uni4d_fg.arrays import BoolArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.config.load import load_config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.cues.depth_settings import settings_behind_lens, settings_for_depth
from uni4d_fg.cues.geometric_depth import GeometricDepth, cut_off, depth_from_motion
from uni4d_fg.cues.interpolated_depth import (
    SparseInverseDepth,
    enlarged,
    ground_contact,
    interpolate,
    smooth_over_time,
    supported,
)
from uni4d_fg.cues.triangle_grid import linear_on_grid
from uni4d_fg.errors import Cancelled, DegenerateProblemError, InputError
from uni4d_fg.frontend.sequence.model import Video
from uni4d_fg.frontend.synthetic import make_synthetic_sequence
from uni4d_fg.frontend.synthetic.simulate import Simulation, simulate
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory, path_length

SIZE: dict[str, Any] = {
    "num_frames": 10, "height": 144, "width": 192, "focal": 180.0, "grid_columns": 20, "grid_rows": 15,
    "query_interval": 5, "render_images": False, "margin_px": 4.0,
}  # fmt: skip


def make(**changes: Any) -> Simulation:
    return simulate(SyntheticSceneConfig(**(SIZE | changes)))


def run(simulation: Simulation, is_static: BoolArray, *overrides: str, **options: Any) -> GeometricDepth:
    """Depth of a simulated video from its tracks, with the focal length guessed as 192 px (true: 180 px)."""
    sequence = simulation.sequence
    video = Video("synthetic", sequence.images, sequence.image_size, sequence.timestamps, masks=sequence.masks)
    tracks = options.pop("tracks", sequence.tracks)
    guess = np.array([192.0, 192.0, 95.5, 71.5])
    return depth_from_motion(video, tracks, is_static, guess, load_config("default", list(overrides)), **options)


@pytest.fixture(scope="module")
def scene() -> Simulation:
    return make(camera_speed=1.8)


@pytest.fixture(scope="module")
def static(scene: Simulation) -> BoolArray:
    return np.asarray(scene.tracks.instance == 0)


@pytest.fixture(scope="module")
def found(scene: Simulation, static: BoolArray) -> GeometricDepth:
    return run(scene, static)


def depth_errors(simulation: Simulation, depth: GeometricDepth) -> tuple[float, float]:
    """AbsRel at the sparse points and of the static pixels, after the one scale that fits the sparse points."""
    truth = simulation.sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.track_points is not None
    assert truth.depths is not None
    track, frame = np.nonzero(np.isfinite(depth.sparse))
    z = world_to_camera(truth.world_T_cam[frame], truth.track_points[track, frame])[:, 2]
    scale = np.median(z / depth.sparse[track, frame])
    dense = np.stack(list(depth.depths)) * scale
    exact = np.stack(list(truth.depths))
    relative = np.abs(dense / exact - 1.0)[simulation.masks == 0]
    return float(np.mean(np.abs(scale * depth.sparse[track, frame] / z - 1.0))), float(np.mean(relative))


def path_error(simulation: Simulation, depth: GeometricDepth) -> float:
    """ATE after Sim(3) alignment, as a part of the path."""
    truth = simulation.sequence.ground_truth.world_T_cam
    assert truth is not None
    return evaluate_trajectory(depth.world_T_cam, truth).ate_m / path_length(truth)


def test_cameras_focal_length_and_depth_are_right_up_to_scale(scene: Simulation, found: GeometricDepth) -> None:
    assert found.has_parallax
    assert path_error(scene, found) < 0.005
    np.testing.assert_allclose(found.intrinsics[:2], 180.0, rtol=0.03)
    sparse, dense = depth_errors(scene, found)
    assert sparse < 0.015
    assert dense < 0.06
    np.testing.assert_allclose(found.world_T_cam[0], np.eye(4), atol=1e-12)
    assert found.warnings == ()


def test_scale_is_the_configured_median_depth(found: GeometricDepth) -> None:
    assert np.nanmedian(found.sparse[:, 0]) == pytest.approx(2.0, rel=0.02)
    assert "2" in found.facts[1]


def test_most_static_observations_get_depth_and_moving_ones_none(
    scene: Simulation, static: BoolArray, found: GeometricDepth
) -> None:
    tracks = scene.sequence.tracks
    assert tracks is not None
    assert np.isfinite(found.sparse[static][tracks.visible[static]]).mean() > 0.85
    assert np.isnan(found.sparse[~static]).all()


def test_moving_tracks_that_count_as_static_are_borne(scene: Simulation) -> None:
    everything = np.ones(len(scene.tracks.instance), dtype=bool)
    assert np.mean(scene.tracks.instance != 0) > 0.05
    assert path_error(scene, run(scene, everything)) < 0.03


def test_known_intrinsics_are_kept(scene: Simulation, static: BoolArray) -> None:
    kept = run(scene, static, "input.intrinsics=fixed")
    np.testing.assert_array_equal(kept.intrinsics, [192.0, 192.0, 95.5, 71.5])


def test_the_result_is_repeatable(scene: Simulation, static: BoolArray, found: GeometricDepth) -> None:
    again = run(scene, static)
    np.testing.assert_array_equal(again.world_T_cam, found.world_T_cam)
    np.testing.assert_array_equal(again.depths[3], found.depths[3])


@pytest.mark.parametrize("path", ["static", "rotation"])
def test_camera_in_one_place_gets_a_sphere_and_a_warning(path: str) -> None:
    simulation = make(path=path, num_frames=8)
    depth = run(simulation, np.asarray(simulation.tracks.instance == 0))
    assert not depth.has_parallax
    assert "depth cannot be seen" in depth.warnings[0]
    assert ("the camera stands still" in depth.warnings[0]) is (path == "static")
    assert ("rotations" in " ".join(depth.warnings)) is (path == "rotation")
    np.testing.assert_array_equal(depth.world_T_cam[:, :3, 3], 0.0)
    truth = simulation.sequence.ground_truth.world_T_cam
    assert truth is not None
    rotation = evaluate_trajectory(depth.world_T_cam, truth, alignment="se3").rpe_rotation_deg
    assert rotation is not None
    assert rotation < 0.15
    rows, columns = np.indices((144, 192))
    ray = np.stack([(columns - 95.5) / 192.0, (rows - 71.5) / 192.0, np.ones((144, 192))], axis=-1)
    np.testing.assert_allclose(depth.depths[5] * np.linalg.norm(ray, axis=-1), 2.0, rtol=0.01)


def test_forward_motion_says_that_the_focal_length_is_unsure() -> None:
    simulation = make(path="forward", num_frames=8)
    depth = run(simulation, np.asarray(simulation.tracks.instance == 0))
    assert any("focal length" in warning for warning in depth.warnings)


def test_frames_without_tracks_are_bridged_and_named(scene: Simulation, static: BoolArray) -> None:
    tracks = scene.sequence.tracks
    assert tracks is not None
    visible = tracks.visible.copy()
    visible[:, 5] = False
    uv = np.where(visible[..., None], tracks.uv, np.float32(np.nan))
    blind = Tracks(uv, visible, tracks.query_frame)
    depth = run(scene, static, tracks=blind)
    assert any("interpolated: 5" in warning for warning in depth.warnings)
    assert path_error(scene, depth) < 0.02
    assert np.isfinite(depth.depths[5]).all()


def test_wrong_input_is_one_clear_error(scene: Simulation, static: BoolArray) -> None:
    with pytest.raises(InputError, match="one flag per track"):
        run(scene, static[:-1])
    with pytest.raises(DegenerateProblemError, match="only 0 tracks are static"):
        run(scene, np.zeros_like(static))


def test_too_few_tracks_are_told_from_masks_that_leave_none(scene: Simulation, static: BoolArray) -> None:
    with pytest.raises(DegenerateProblemError) as raised:
        run(scene, np.zeros_like(static))
    tracks = scene.sequence.tracks
    assert tracks is not None
    total = int((tracks.visible.sum(axis=1) > 1).sum())
    assert f"only 0 tracks are static, of {total} in " in str(raised.value)
    assert "15 are needed: the others are seen on what masks mark as moving. Check the masks" in str(raised.value)
    with pytest.raises(DegenerateProblemError, match=r"has only 3 tracks that two .*grid_columns") as raised:
        run(scene, np.ones(3, dtype=bool), tracks=tracks.select(np.arange(3)))
    assert "masks" not in str(raised.value)


def stop_after(calls: int) -> Callable[[], bool]:
    left = iter(range(calls))
    return lambda: next(left, None) is None


@pytest.mark.parametrize("calls", [0, 10])
def test_cancelling_ends_it(scene: Simulation, static: BoolArray, calls: int) -> None:
    with pytest.raises(Cancelled):
        run(scene, static, should_stop=stop_after(calls))


def test_settings_loosen_moving_depth_and_keep_a_focal_length_that_motion_does_not_tell() -> None:
    config = load_config("default", [])
    given = make_synthetic_sequence(SyntheticSceneConfig(num_frames=2, width=64, height=48, render_images=False))
    seen, unseen = (replace(given, depth_parallax=parallax) for parallax in (True, False))
    assert settings_for_depth(config, given) == config
    assert settings_for_depth(config, seen).nonrigid.depth_sigma == config.geometric_depth.moving_depth_sigma
    assert settings_for_depth(config, seen).input.intrinsics == "free"
    assert settings_for_depth(config, unseen).input.intrinsics == "fixed"
    assert settings_for_depth(config, replace(seen, focal_sigma=0.01)).input.intrinsics == "free"  # for a lens
    assert settings_for_depth(config, replace(seen, focal_sigma=0.05)).input.intrinsics == "fixed"
    aligned = settings_for_depth(config, replace(given, focal_sigma=0.05))  # a network's depth, scaled by motion
    assert aligned.input.intrinsics == "fixed"
    assert aligned.nonrigid.depth_sigma is None
    own = load_config("default", ["nonrigid.depth_sigma=0.02"])
    assert settings_for_depth(own, seen).nonrigid.depth_sigma == 0.02


def test_behind_the_lens_what_motion_told_is_no_cue_for_the_cameras() -> None:
    config = load_config("default", [])
    given = make_synthetic_sequence(SyntheticSceneConfig(num_frames=2, width=64, height=48, render_images=False))
    seen = replace(given, depth_parallax=True, focal_sigma=0.01)
    assert settings_behind_lens(config, given, depth_is_needed=False) == config
    stages = settings_behind_lens(config, seen, depth_is_needed=False)
    assert (stages.input.intrinsics, stages.bundle_adjustment.depth_prior) == ("fixed", False)
    assert stages.bundle_adjustment.trim_sigmas == config.geometric_depth.stage_trim_sigmas
    needed = settings_behind_lens(config, seen, depth_is_needed=True)
    assert (needed.input.intrinsics, needed.bundle_adjustment.depth_prior) == ("fixed", True)
    asked = settings_behind_lens(
        load_config("default", ["geometric_depth.depth_prior=true"]), seen, depth_is_needed=False
    )
    assert asked.bundle_adjustment.depth_prior
    turns = settings_behind_lens(config, replace(seen, depth_parallax=False), depth_is_needed=False)
    assert turns.bundle_adjustment.depth_prior  # depth by convention is all that holds the points
    aligned = settings_behind_lens(config, replace(given, focal_sigma=0.01), depth_is_needed=False)
    assert (aligned.input.intrinsics, aligned.bundle_adjustment.depth_prior) == ("fixed", True)


def plane(uv: np.ndarray) -> np.ndarray:
    """Inverse depth of a slanted plane: linear in the image."""
    return 0.2 + 0.002 * uv[:, 0] + 0.004 * uv[:, 1]


def test_a_plane_is_interpolated_exactly_within_the_hull(rng: np.random.Generator) -> None:
    uv = np.concatenate([rng.uniform(0, 100, (200, 2)), [[-1, -1], [101, -1], [-1, 101], [101, 101]]])
    dense = enlarged(interpolate(SparseInverseDepth(uv, plane(uv)), (100, 100), 4), (100, 100))
    rows, columns = np.indices((100, 100))
    exact = plane(np.stack([columns.ravel(), rows.ravel()], axis=1)).reshape(100, 100)
    # Beyond the outermost grid centers cv2.resize repeats the border.
    np.testing.assert_allclose(dense[2:-2, 2:-2], exact[2:-2, 2:-2], rtol=1e-4)


@pytest.mark.parametrize("uv", [[[10.0, 10.0]], [[0.0, 0.0], [5.0, 5.0]], [[0.0, 0.0], [5.0, 5.0], [9.0, 9.0]]])
def test_too_few_points_for_triangles_give_the_nearest(uv: list[list[float]]) -> None:
    points = SparseInverseDepth(np.array(uv), np.linspace(0.5, 0.7, len(uv)))
    grid = interpolate(points, (12, 12), 2)
    assert grid[0, 0] == np.float32(points.inverse_depth[0])
    assert grid[5, 5] == np.float32(points.inverse_depth[-1])
    assert set(np.unique(grid)) <= set(points.inverse_depth.astype(np.float32))


@pytest.mark.parametrize("kind", ["scattered", "on a lattice", "thin"])
def test_values_on_a_grid_are_those_of_scipys_interpolator(kind: str, rng: np.random.Generator) -> None:
    places = {
        "scattered": rng.uniform(-3.0, 43.0, (300, 2)),
        # Points on nodes, four on every circle; and triangles with a side along a row.
        "on a lattice": np.stack(np.meshgrid(np.arange(0.0, 41.0, 4.0), np.arange(0.0, 31.0, 3.0)), -1).reshape(-1, 2),
        "thin": rng.uniform(0.0, 1.0, (200, 2)) * [40.0, 1e-3] + [0.0, 15.0],
    }[kind]
    values = rng.uniform(0.1, 2.0, len(places))
    found = linear_on_grid(places, values, (30, 40))
    rows, columns = np.indices((30, 40))
    expected = LinearNDInterpolator(places, values)(columns, rows)
    both = np.isfinite(found) & np.isfinite(expected)
    assert np.count_nonzero(np.isfinite(found) != np.isfinite(expected)) <= 1
    np.testing.assert_allclose(found[both], expected[both], rtol=1e-6)
    assert kind == "thin" or both.sum() > 1000


def test_a_lone_wrong_point_has_no_support(rng: np.random.Generator) -> None:
    uv = rng.uniform(0, 100, (100, 2))
    inverse = plane(uv)
    inverse[7] *= 4.0
    keep = supported(uv, inverse, GeometricDepthConfig())
    assert not keep[7]
    assert keep.sum() >= 98


def test_things_whose_depth_nothing_shows_are_named_in_one_warning() -> None:
    assert cut_off([]) == []
    (one,) = cut_off([5])
    assert one.startswith("the depth of moving thing 5 is a guess: the image cuts it off below")
    (some,) = cut_off(list(range(1, 13)))
    assert "moving things 1, 2, 3, 4, 5, 6, 7, 8, 9, 10 and 2 more is a guess: the image cuts them off" in some


def test_moving_things_stand_at_the_depth_of_the_ground_below_them(rng: np.random.Generator) -> None:
    uv = rng.uniform(0, 100, (500, 2))
    mask = np.zeros((100, 100), dtype=np.int32)
    mask[20:71, 40:50] = 3  # stands at row 70
    mask[10:31, 70:90] = 5
    inverse = enlarged(interpolate(SparseInverseDepth(uv, plane(uv)), (100, 100), 4), (100, 100))
    contact = ground_contact(mask, inverse, GeometricDepthConfig())
    assert contact[3] == pytest.approx(0.2 + 0.002 * 44.5 + 0.004 * 70, rel=0.01)
    assert contact[5] == pytest.approx(0.2 + 0.002 * 79.5 + 0.004 * 30, rel=0.01)


def test_standing_depth_is_smoothed_over_the_frames_that_have_the_thing() -> None:
    values = [{1: 0.5}, {1: 0.5, 2: 0.9}, {1: 3.0}, {1: 0.5}, {}]
    assert smooth_over_time(values, 3) == ({1: 0.5}, {1: 0.5, 2: 0.9}, {1: 0.5}, {1: 0.5}, {})
    # Masks that lose feet put a thing farther than it stands: in more than half of these frames.
    lost = [{1: 0.5 if frame % 5 in (0, 3) else 0.3} for frame in range(20)]
    assert smooth_over_time(lost, 9)[4:16] == ({1: 0.5},) * 12
