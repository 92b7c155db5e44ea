"""Masks from motion alone: the tests of tracks and pixels one by one, then whole scenes with known masks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from uni4d_fg.config.models import Config
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.appearance import frame_appearance, moved_evidence
from uni4d_fg.cues.depth_range import UNKNOWN_RANGE, depth_range, spread_at_tracks
from uni4d_fg.cues.guided_filter import guided_filter
from uni4d_fg.cues.motion_masks import MotionMasks, motion_masks
from uni4d_fg.cues.moving_regions import track_evidence, trusted_components
from uni4d_fg.cues.outlier_tracks import find_outlier_tracks
from uni4d_fg.cues.pixel_grid import PixelGrid
from uni4d_fg.cues.static_scene import predict_static, relative_pose
from uni4d_fg.cues.track_motion import Cameras, TrackMotion, find_moving_tracks
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames, Content, Video
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.synthetic import Simulation, SyntheticSceneConfig, simulate
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.slam.lens.camera_model import CameraModel

INTRINSICS = np.array([200.0, 210.0, 79.5, 59.5])


def video_of(simulation: Simulation) -> Video:
    sequence = simulation.sequence
    return Video("synthetic", sequence.images, sequence.image_size, sequence.timestamps)


def masks_of(
    simulation: Simulation, depths: np.ndarray | None = None, tracks: Tracks | None = None,
    world_T_cam: np.ndarray | None = None, is_interpolated: bool = False, content: Content | None = None,
) -> MotionMasks:  # fmt: skip
    sequence = simulation.sequence
    tracks = sequence.tracks if tracks is None else tracks
    assert tracks is not None
    # The images are small.
    config = MotionMaskConfig(baselines=(2, 5), depth_edge_px=7, smoothing_px=6, grow_px=1)
    source = sequence.depths if depths is None else ArrayFrames(depths)
    video = dataclasses.replace(video_of(simulation), content=content)
    return motion_masks(
        video, source, tracks, sequence.intrinsics, config, world_T_cam=world_T_cam,
        is_interpolated=is_interpolated,
    )  # fmt: skip


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    """Mean intersection over union over the frames in which there is anything to find."""
    pairs = [(a, b) for a, b in zip(found > 0, true > 0, strict=True) if b.any()]
    return float(np.mean([(a & b).sum() / (a | b).sum() for a, b in pairs]))


@pytest.fixture(scope="module")
def moving_config() -> SyntheticSceneConfig:
    return SyntheticSceneConfig(
        num_frames=12, height=120, width=160, focal=150.0, margin_px=3, grid_columns=24, grid_rows=18, frame_rate=10.0
    )


@pytest.fixture(scope="module")
def moving_scene(moving_config: SyntheticSceneConfig) -> Simulation:
    return simulate(moving_config)


@pytest.fixture(scope="module")
def static_scene(moving_config: SyntheticSceneConfig) -> Simulation:
    return simulate(moving_config.model_copy(update={"objects": "none", "num_frames": 8}))


@pytest.fixture(scope="module")
def moving_result(moving_scene: Simulation) -> MotionMasks:
    return masks_of(moving_scene)


def test_the_static_prediction_is_the_projection_and_its_slope_the_derivative(rng: np.random.Generator) -> None:
    uv, depth = rng.uniform((0, 0), (160, 120), (50, 2)), rng.uniform(1, 4, 50)
    poses = np.stack([np.eye(4), se3.se3_exp(rng.normal(0, 0.1, 6))])
    static = predict_static(uv[:, 0], uv[:, 1], np.log(depth), relative_pose(poses, 0, 1), INTRINSICS)
    point = camera_to_world(poses[[0] * 50], unproject(INTRINSICS, uv, depth))
    there = world_to_camera(poses[[1] * 50], point)
    expected = project(INTRINSICS, there)
    np.testing.assert_allclose(np.stack((static.u, static.v), axis=1), expected, atol=1e-3)
    np.testing.assert_allclose(np.log(static.z), np.log(there[:, 2]), atol=1e-5)
    near, far = (
        predict_static(uv[:, 0], uv[:, 1], np.log(depth) + h, relative_pose(poses, 0, 1), INTRINSICS)
        for h in (-1e-3, 1e-3)
    )
    np.testing.assert_allclose(static.du, (far.u - near.u) / 2e-3, atol=0.02)
    np.testing.assert_allclose(static.dv, (far.v - near.v) / 2e-3, atol=0.02)


def test_depth_range_knows_edges_and_holes() -> None:
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 15:], depth[5, 5], depth[:, 25:] = 4.0, np.nan, np.nan
    around = depth_range(depth, 3)
    assert around.spread[10, 10] == 0
    assert around.spread[10, 14] == pytest.approx(np.log(2), abs=1e-6)
    assert around.spread[5, 5] == around.spread[10, 28] == np.float32(UNKNOWN_RANGE)
    assert around.log_depth[5, 5] == pytest.approx(np.log(2), abs=1e-6)
    assert bool(around.known[5, 5])
    assert not around.known[10, 28]
    assert np.isfinite(around.log_depth).all()
    tracks = Tracks(np.array([[[10, 10]], [[14, 10]]], np.float32), np.ones((2, 1), bool), np.zeros(2, np.int32))
    np.testing.assert_allclose(spread_at_tracks(tracks, ArrayFrames(depth[None]), 3), [[0], [np.log(2)]], atol=1e-6)


def test_the_guided_filter_keeps_the_edges_of_its_guide(rng: np.random.Generator) -> None:
    guide = np.zeros((60, 80, 3), np.float32)
    guide[:, 40:] = (0.8, 0.2, 0.4)
    truth = np.where(guide[..., 0] > 0, 1.0, -1.0)
    smooth = guided_filter(guide, (truth + rng.normal(0, 1, truth.shape)).astype(np.float32), 8, 0.03)
    assert np.abs(smooth - truth).max() < 0.6
    assert np.abs(smooth - truth).mean() < 0.1


def test_evidence_of_pixels(rng: np.random.Generator) -> None:
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (120, 160, 3)).astype(np.float32), (0, 0), 2)
    image = np.clip(128 + 4 * (noise - noise.mean()), 0, 255).astype(np.uint8)
    image[90:] = 100
    after = image.copy()
    after[20:50, 28:58] = image[20:50, 20:50]  # moved by 8 px
    near = np.full((120, 160), 2.0, np.float32)
    near[20:60, 100:140] = 1.0  # something else in front
    pixels = PixelGrid.of(CameraModel(INTRINSICS), (120, 160), (120, 160))

    def evidence(second: np.ndarray, depth: np.ndarray, pose: np.ndarray, edge_px: int = 1) -> np.ndarray:
        first, other = (
            frame_appearance(i, d, 0.0, edge_px, MotionMaskConfig()) for i, d in ((image, depth), (second, near))
        )
        static = pixels.predict(first.z, pose, 0, 1)
        return moved_evidence(first, other.compared, static, MotionMaskConfig())

    far = np.full((120, 160), 2.0, np.float32)
    found = evidence(after, far, np.eye(4))
    assert found[25:45, 33:53].mean() > 1.0
    assert found[5:15].mean() < -0.2
    assert found[60:80].mean() < -0.2
    assert (found[25:55, 105:135] == 0).all()  # hidden
    assert np.abs(found[100:]).max() < 0.1  # nothing to see
    # The camera moved by 8 px of parallax at 2 m. Where depth says 1 m it contradicts, unless depth varies there.
    pose, wrong = np.eye(4), far.copy()
    pose[0, 3] = 8 * 2.0 / INTRINSICS[0]
    wrong[60:85] = 1.0
    shifted = np.roll(image, 8, axis=1)
    band = np.s_[66:79, 40:130]
    assert evidence(shifted, far, pose)[band].mean() < -0.2
    assert evidence(shifted, wrong, pose)[band].mean() > 0.5
    wrong[60:85, ::6] = 2.0
    assert evidence(shifted, wrong, pose, 7)[band].mean() < 0.1


def labelled_scene(rng: np.random.Generator, poses: np.ndarray) -> tuple[LabelledTracks, np.ndarray]:
    """300 static points and 60 that drift by 3 cm per frame, seen by cameras with known poses."""
    count, frames = 360, len(poses)
    start = unproject(INTRINSICS, rng.uniform((5, 5), (155, 115), (count, 2)), rng.uniform(1.5, 3.0, count))
    moves = np.arange(count) >= 300
    world = start[:, None] + np.where(moves[:, None, None], np.arange(frames)[:, None] * np.array([0.03, 0.01, 0]), 0)
    camera = np.stack([world_to_camera(np.tile(p, (count, 1, 1)), world[:, t]) for t, p in enumerate(poses)], axis=1)
    uv = project(INTRINSICS, camera) + rng.normal(0, 0.3, (count, frames, 2))
    depth = camera[..., 2] * np.exp(rng.normal(0, 0.02, (count, frames)))
    inside = (uv > 0).all(axis=2) & (uv < (159, 119)).all(axis=2)
    tracks = Tracks(
        np.where(inside[..., None], uv, np.nan).astype(np.float32), inside, np.zeros(count, np.int32)
    )  # fmt: skip
    zero = np.zeros(count, np.int32)
    return LabelledTracks(tracks, zero, zero, inside.astype(np.float32), depth.astype(np.float32)), moves


def test_tracks_that_move_are_told_from_those_that_do_not(rng: np.random.Generator) -> None:
    poses = np.stack([se3.se3_exp(t * np.array([0.002, 0.004, 0.001, 0.02, 0.0, 0.005])) for t in range(10)])
    labelled, moves = labelled_scene(rng, poses)
    config = MotionMaskConfig()
    none = np.zeros(len(moves), bool)
    first = find_outlier_tracks(labelled, INTRINSICS * (1.1, 1.1, 1, 1), config, none)
    assert first[moves].mean() > 0.9
    assert first[~moves].mean() < 0.05
    spread = np.zeros(labelled.depth.shape, np.float32)
    found = find_moving_tracks(labelled, spread, Cameras(poses, INTRINSICS, np.zeros(10)), (120, 160), config, none)
    assert found.moving[moves].mean() > 0.95
    assert found.static[~moves].mean() > 0.95
    assert not (found.static & moves).any()
    assert found.moving[~moves].mean() < 0.02
    # What all tracks share is an error of the cameras: here, poses that are turned by about 2 px.
    turned = poses @ np.stack([se3.se3_exp(np.append(rng.normal(0, 0.01, 3), (0, 0, 0))) for _ in poses])
    found = find_moving_tracks(labelled, spread, Cameras(turned, INTRINSICS, np.zeros(10)), (120, 160), config, none)
    assert found.static[~moves].mean() > 0.8
    assert found.moving[moves].mean() > 0.7


def test_depth_may_be_wrong_where_it_varies_and_motion_across_the_epipolar_line_still_counts(
    rng: np.random.Generator,
) -> None:
    # The camera moves to the right: parallax is horizontal. Depth is wrong by 60 % for 40 static tracks.
    poses = np.stack([se3.se3_exp(t * np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0])) for t in range(10)])
    labelled, moves = labelled_scene(rng, poses)
    depth, spread = labelled.depth.copy(), np.zeros(labelled.depth.shape, np.float32)
    depth[:40] *= 1.6
    config, cameras, none = MotionMaskConfig(), Cameras(poses, INTRINSICS, np.zeros(10)), np.zeros(len(moves), bool)
    wrong = dataclasses.replace(labelled, depth=depth)
    sure = find_moving_tracks(wrong, spread, cameras, (120, 160), config, none)
    assert sure.moving[:40].mean() > 0.5
    spread[:40] = 1.0
    unsure = find_moving_tracks(wrong, spread, cameras, (120, 160), config, none)
    assert unsure.moving[:40].mean() < 0.05
    lost = dataclasses.replace(labelled, depth=np.where(moves[:, None], np.float32(np.nan), labelled.depth))
    vertical = find_moving_tracks(lost, spread, cameras, (120, 160), config, none)
    assert vertical.moving[moves].mean() > 0.5  # by their 1 cm per frame downwards


@pytest.mark.parametrize("spacing", [4, 8])
def test_many_tracks_that_agree_say_much_and_a_single_one_little(spacing: int) -> None:
    """Whatever their density: on the left all move, on the right one does among static ones."""
    grid = np.stack(np.meshgrid(np.arange(4, 160, spacing), np.arange(4, 120, spacing)), axis=-1).reshape(-1, 2)
    moving = (grid[:, 0] < 80) & (grid[:, 0] > 20)
    alone = np.array([100 // spacing * spacing + 4, 60 // spacing * spacing + 4])
    moving |= (grid == alone).all(axis=1)
    tracks = Tracks(grid[:, None].astype(np.float32), np.ones((len(grid), 1), bool), np.zeros(len(grid), np.int32))
    motion = TrackMotion(moving, ~moving, np.zeros(len(grid)))
    config = MotionMaskConfig(track_reach_px=6.0)
    evidence = track_evidence(tracks, motion, 0, (120, 160), np.ones(2), config)
    assert evidence[20:100, 40:60].min() > 0.55
    assert evidence[20:100, 130:150].max() < -0.55
    assert evidence[alone[1], alone[0]] < 0.0
    by_itself = TrackMotion(moving & (grid == alone).all(axis=1), np.zeros(len(grid), bool), np.zeros(len(grid)))
    assert track_evidence(tracks, by_itself, 0, (120, 160), np.ones(2), config).max() < 0.65


def test_a_region_whose_tracks_are_static_is_not_believed() -> None:
    region = np.zeros((120, 160), bool)
    region[20:60, 20:60], region[80:110, 80:110], region[5, 5] = True, True, True
    uv = np.array([[[30, 30]], [[40, 40]], [[90, 90]], [[95, 95]]], np.float32)
    tracks = Tracks(uv, np.ones((4, 1), bool), np.zeros(4, np.int32))
    moving = np.array([True, True, False, True])
    motion = TrackMotion(moving, np.array([False, False, True, False]), np.zeros(4))
    config = MotionMaskConfig(grow_px=0, max_static_fraction=0.4)
    kept = trusted_components(region, tracks, motion, 0, config)
    assert [int(m.sum()) for m in kept] == [1600]
    kept = trusted_components(region, tracks, motion, 0, MotionMaskConfig(grow_px=0, max_static_fraction=0.5))
    assert sorted(int(m.sum()) for m in kept) == [900, 1600]


@pytest.mark.parametrize(("moving_tracks", "is_kept"), [(5, True), (1, False)])
def test_of_a_region_that_joins_what_stands_the_part_that_moves_is_kept(moving_tracks: int, is_kept: bool) -> None:
    """A child before a climbing frame: bars around which evidence errs are joined to it, and have more tracks."""
    region = np.zeros((240, 320), bool)
    region[60:180, 60:100] = True  # the child
    region[100:106, 100:260] = True  # a bar
    moves = np.array([[80, 70 + 25 * n] for n in range(moving_tracks)])
    stands = np.array([[105 + 12 * n, 103] for n in range(12)])
    uv = np.concatenate([moves, stands])[:, None].astype(np.float32)
    tracks = Tracks(uv, np.ones((len(uv), 1), bool), np.zeros(len(uv), np.int32))
    moving = np.arange(len(uv)) < moving_tracks
    kept = trusted_components(region, tracks, TrackMotion(moving, ~moving, np.zeros(len(uv))), 0, MotionMaskConfig())
    if not is_kept:
        assert len(kept) == 0
        return
    (mask,) = kept
    assert mask[60:180, 60:100].mean() > 0.97
    assert mask[100:106, 110:240].mean() < 0.05


def test_moving_things_are_masked(moving_scene: Simulation, moving_result: MotionMasks) -> None:
    labels = np.stack(list(moving_result.labels))
    assert labels.dtype == np.int32
    assert overlap(labels, moving_scene.masks) > 0.7
    assert (labels > 0)[moving_scene.masks == 0].mean() < 0.03
    for instance in (1, 2):
        assert (labels > 0)[moving_scene.masks == instance].mean() > 0.7
    moves = moving_scene.tracks.instance > 0
    assert moving_result.tracks.moving[moves].mean() > 0.9
    assert moving_result.tracks.moving[~moves].mean() < 0.12


def test_nothing_is_masked_in_black_bars(moving_scene: Simulation, moving_result: MotionMasks) -> None:
    seen, whole = np.s_[:, 50:80], np.stack(list(moving_result.labels)) > 0
    found = np.stack(list(masks_of(moving_scene, content=Content(50, 80, 0, 160)).labels)) > 0
    assert whole[:, :48].any()
    assert not found[:, :48].any()
    assert not found[:, 82:].any()
    assert overlap(found[seen], moving_scene.masks[seen]) > 0.65


def test_the_cameras_are_not_drawn_to_what_moves(moving_scene: Simulation, moving_result: MotionMasks) -> None:
    truth = moving_scene.sequence.ground_truth
    assert truth.world_T_cam is not None
    found = align_trajectories(moving_result.cameras.world_T_cam, truth.world_T_cam)
    miss = found.apply(moving_result.cameras.world_T_cam[:, :3, 3]) - truth.world_T_cam[:, :3, 3]
    assert np.sqrt((miss**2).sum(axis=1).mean()) < 0.02
    assert abs(moving_result.cameras.intrinsics[0] / 150.0 - 1) < 0.15


def test_cameras_that_are_known_are_not_solved(moving_scene: Simulation, moving_result: MotionMasks) -> None:
    poses = moving_scene.sequence.ground_truth.world_T_cam
    assert poses is not None
    result = masks_of(moving_scene, world_T_cam=poses)
    np.testing.assert_array_equal(result.cameras.world_T_cam, poses)
    np.testing.assert_array_equal(result.cameras.log_scale, 0.0)
    found, solved = (overlap(np.stack(list(one.labels)), moving_scene.masks) for one in (result, moving_result))
    assert found > max(0.7, solved - 0.02)
    moves = moving_scene.tracks.instance > 0
    assert result.tracks.moving[moves].mean() > 0.9
    assert result.tracks.moving[~moves].mean() < 0.12


def test_interpolated_depth_is_not_believed_where_tracks_move(rng: np.random.Generator) -> None:
    """A thing that goes along with the camera looks like a still one that is nearer; its tracks are known to move."""
    frames, focal, step, far, near = 14, 150.0, 0.03, 4.0, 1.5
    textures = [
        cv2.GaussianBlur(rng.uniform(0, 255, (120, 300, 3)).astype(np.float32), (0, 0), 2.0) * 4 - 3 * 127.5
        for _ in range(2)
    ]
    images, masks = np.empty((frames, 120, 160, 3), np.uint8), np.zeros((frames, 120, 160), bool)
    for frame in range(frames):
        shift = [frame * step * focal / depth for depth in (far, near)]
        scene, thing = (
            cv2.warpAffine(texture, np.float32([[1, 0, -moved], [0, 1, 0]]), (160, 120), borderMode=cv2.BORDER_REFLECT)
            for texture, moved in zip(textures, shift, strict=True)
        )
        left = round(90 - shift[1])
        masks[frame, 40:80, left : left + 30] = True
        images[frame] = np.clip(np.where(masks[frame, ..., None], thing, scene), 0, 255)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = step * np.arange(frames)
    depths = np.where(masks, near, far).astype(np.float32)
    at = np.stack(np.meshgrid(np.arange(4, 156, 4), np.arange(4, 116, 4)), axis=-1).reshape(-1, 2).astype(np.float32)
    moves = masks[0, at[:, 1].astype(int), at[:, 0].astype(int)]
    moved = np.where(moves[:, None], near, far)
    uv = np.repeat(at[:, None], frames, axis=1)
    uv[..., 0] -= np.arange(frames) * step * focal / moved
    hidden = masks[np.arange(frames), uv[..., 1].astype(int), np.maximum(uv[..., 0], 0).astype(int)] & ~moves[:, None]
    tracks = Tracks(uv, ~hidden & (uv[..., 0] >= 0), np.zeros(len(at), np.int32))
    video = Video("thing", ArrayFrames(images), (120, 160), np.arange(frames) / 30)
    config = MotionMaskConfig(
        baselines=(2, 5),
        background_baselines=(2, 5),
        depth_edge_px=7,
        smoothing_px=6,
        grow_px=0,
        color_reach_px=0,
        interpolated_threshold=1.0,
    )
    found = {
        is_interpolated: np.stack(
            list(
                motion_masks(
                    video,
                    ArrayFrames(depths),
                    tracks,
                    np.array([focal, focal, 79.5, 59.5]),
                    config,
                    known_moving=moves,
                    world_T_cam=poses,
                    is_interpolated=is_interpolated,
                ).labels
            )
        )
        for is_interpolated in (False, True)
    }
    assert overlap(found[False], masks) < 0.4
    assert overlap(found[True], masks) > 0.7
    assert (found[True] > 0)[~masks].mean() < 0.005


def test_nothing_is_masked_in_a_static_scene(static_scene: Simulation) -> None:
    result = masks_of(static_scene)
    labels = np.stack(list(result.labels))
    assert (labels > 0).mean() < 0.01
    assert result.warnings == []
    assert result.tracks.moving.mean() < 0.12  # 2 % of their observations are displaced on purpose


def test_a_camera_at_rest(moving_config: SyntheticSceneConfig) -> None:
    scene = simulate(moving_config.model_copy(update={"path": "static", "num_frames": 8}))
    result = masks_of(scene)
    labels = np.stack(list(result.labels))
    assert overlap(labels, scene.masks) > 0.75
    assert (labels > 0)[scene.masks == 0].mean() < 0.04
    step = np.linalg.norm(np.diff(result.cameras.world_T_cam[:, :3, 3], axis=0), axis=1)
    assert step.max() < 0.02


def test_missing_depth_costs_little_and_no_depth_is_one_error(
    moving_scene: Simulation, moving_result: MotionMasks
) -> None:
    depths = np.stack(list(moving_scene.sequence.depths))
    holes = depths.copy()
    holes[4], holes[:, 90:, :60] = np.nan, np.nan  # a frame without depth, and a corner that no frame has
    labels = np.stack(list(masks_of(moving_scene, holes).labels))
    whole = overlap(np.stack(list(moving_result.labels)), moving_scene.masks)
    assert overlap(labels, moving_scene.masks) > whole - 0.1
    assert (labels > 0)[moving_scene.masks == 0].mean() < 0.03
    assert overlap(labels[4:5], moving_scene.masks[4:5]) > 0.6
    with pytest.raises(InputError, match=r"none of \d+ tracks has depth"):
        masks_of(moving_scene, np.full_like(depths, np.nan))


def test_what_fills_most_of_the_image_is_the_world(moving_config: SyntheticSceneConfig) -> None:
    # The room moves, too, as one piece: nobody could tell that from a moving camera.
    scene = simulate(moving_config.model_copy(update={"objects": "all_dynamic", "num_frames": 10}))
    result = masks_of(scene)
    room = int(np.bincount(scene.masks.ravel()).argmax())
    labels = np.stack(list(result.labels))
    things = (scene.masks != room) & (scene.masks != 0)
    assert overlap(labels, things) > 0.7
    assert (labels > 0)[~things].mean() < 0.05


def test_a_warning_when_everything_moves_its_own_way(static_scene: Simulation, rng: np.random.Generator) -> None:
    tracks = static_scene.sequence.tracks
    assert tracks is not None
    wander = rng.normal(0, 3, tracks.uv.shape).cumsum(axis=1)
    wandering = np.clip(tracks.uv + wander, 0, (159, 119)).astype(np.float32)
    result = masks_of(static_scene, tracks=Tracks(wandering, tracks.visible, tracks.query_frame))
    assert len(result.warnings) == 1
    assert "most of the image seems to move" in result.warnings[0]


def test_input_that_does_not_fit_and_a_stop_are_clear(static_scene: Simulation) -> None:
    sequence, video = static_scene.sequence, video_of(static_scene)
    assert sequence.tracks is not None
    config = MotionMaskConfig()
    short = ArrayFrames(np.stack(list(sequence.depths))[:5])
    with pytest.raises(InputError, match="5 depth maps, but 8 images"):
        motion_masks(video, short, sequence.tracks, sequence.intrinsics, config)
    for limit in (1, 12):
        asked: list[int] = []

        def stop(asked: list[int] = asked, limit: int = limit) -> bool:
            asked.append(1)
            return len(asked) > limit

        with pytest.raises(Cancelled):
            motion_masks(video, sequence.depths, sequence.tracks, sequence.intrinsics, config, None, stop)


def real_masks(root: Path, name: str, step: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return found masks, true masks and the trajectory error of the cameras the masks were made with."""
    folder = root / name
    if not (folder / "c2w.npy").is_file():
        pytest.skip(f"{folder} is not there")
    sequence = read_sequence(folder)
    frames = range(0, sequence.num_frames, step)
    images, depths, truth = (
        np.stack([source[f] for f in frames]) for source in (sequence.images, sequence.depths, sequence.masks)
    )
    video = Video(name, ArrayFrames(images), sequence.image_size, sequence.timestamps[list(frames)])
    tracking = Config().tracking.model_copy(update={"query_interval": max(3, 10 // step)})
    tracks = track_grid(video.images, tracking)
    baselines = tuple(sorted({max(1, b // step) for b in MotionMaskConfig().baselines}))
    config = MotionMaskConfig(baselines=baselines, first_guess_step=max(1, 5 // step))
    result = motion_masks(video, ArrayFrames(depths), tracks, sequence.intrinsics, config)
    true_poses = sequence.ground_truth.world_T_cam
    assert true_poses is not None
    true_poses = true_poses[list(frames)]
    aligned = align_trajectories(result.cameras.world_T_cam, true_poses).apply(result.cameras.world_T_cam[:, :3, 3])
    error = float(np.sqrt(((aligned - true_poses[:, :3, 3]) ** 2).sum(axis=1).mean()))
    return np.stack(list(result.labels)), truth, error


@pytest.mark.data
def test_the_dog_in_the_kitchen(data_root: Path) -> None:
    labels, truth, error = real_masks(data_root, "kitchen_dog", 3)
    assert overlap(labels, truth) > 0.75
    assert error < 0.0065


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("name", "least_overlap", "most_area"), [("kitchen_dog", 0.8, 0.2), ("kitchen", 0, 0.01)])
def test_every_frame_of_the_kitchen(data_root: Path, name: str, least_overlap: float, most_area: float) -> None:
    labels, truth, error = real_masks(data_root, name, 1)
    if truth.any():
        assert overlap(labels, truth) > least_overlap
    assert (labels > 0).mean() < most_area
    assert error < 0.0055
