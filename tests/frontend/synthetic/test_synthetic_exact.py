import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from uni4d_fg.frontend.synthetic import CueNoise, Simulation, SyntheticSceneConfig, make_synthetic_sequence, simulate
from uni4d_fg.frontend.synthetic.raycast import RayCaster
from uni4d_fg.frontend.synthetic.render import pixel_grid
from uni4d_fg.frontend.synthetic.scene import make_scene
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera

CONFIG = SyntheticSceneConfig(num_frames=6, grid_columns=24, grid_rows=18, query_interval=3, noise=CueNoise.none())


@pytest.fixture(scope="module")
def exact() -> Simulation:
    return simulate(CONFIG)


def test_the_sequence_is_complete(exact: Simulation) -> None:
    sequence = exact.sequence
    assert sequence.num_frames == 6
    assert sequence.image_size == (240, 320)
    assert sequence.images[0].shape == (240, 320, 3)
    assert sequence.images[0].dtype == np.uint8
    assert sequence.depths[0].dtype == np.float32
    assert sequence.masks[0].dtype == np.int32
    assert np.all(np.diff(sequence.timestamps) > 0)
    assert sequence.tracks is not None
    assert sequence.tracks.num_tracks == 2 * 24 * 18
    assert set(sequence.tracks.query_frame.tolist()) == {0, 3}
    truth = sequence.ground_truth
    assert truth.track_points is not None
    assert truth.track_points.shape == (2 * 24 * 18, 6, 3)
    assert truth.world_T_cam is not None
    assert not np.allclose(truth.world_T_cam[0], np.eye(4), atol=0.1)


def test_without_noise_the_cues_are_the_truth(exact: Simulation) -> None:
    sequence = exact.sequence
    assert sequence.ground_truth.depths is not None
    assert sequence.tracks is not None
    for t in range(sequence.num_frames):
        np.testing.assert_array_equal(sequence.depths[t], sequence.ground_truth.depths[t])
        np.testing.assert_array_equal(sequence.masks[t], exact.masks[t])
    np.testing.assert_array_equal(sequence.intrinsics, sequence.ground_truth.intrinsics)
    np.testing.assert_array_equal(sequence.tracks.visible, exact.tracks.visible)
    seen = exact.tracks.visible
    np.testing.assert_array_equal(sequence.tracks.uv[seen], exact.tracks.uv[seen].astype(np.float32))
    assert np.isnan(sequence.tracks.uv[~seen]).all()
    np.testing.assert_array_equal(exact.depth_log_scale, 0.0)


def test_depth_lifts_static_pixels_onto_the_same_surface_in_every_frame(exact: Simulation) -> None:
    """Depth of frame 0, carried along the true poses, lies on the static mesh that frame 5 sees."""
    sequence = exact.sequence
    truth = sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.depths is not None
    assert truth.intrinsics is not None
    uv = pixel_grid(240, 320)[::7]
    static = exact.masks[0].ravel()[::7] == 0
    depth = np.asarray(truth.depths[0], dtype=np.float64).ravel()[::7]
    world = camera_to_world(truth.world_T_cam[0], unproject(truth.intrinsics, uv, depth))[static]

    scene = make_scene("none")
    caster = RayCaster(scene.vertices(0.0), scene.triangles)
    in_frame = world_to_camera(truth.world_T_cam[5], world)
    projected = project(truth.intrinsics, in_frame)
    center = truth.world_T_cam[5][:3, 3]
    hits = caster.cast(center, world - center)
    surface = center + hits.distance[:, None] * (world - center)
    gap = np.linalg.norm(surface - world, axis=-1)
    unoccluded = hits.distance > 1 - 1e-3
    assert unoccluded.mean() > 0.9
    assert gap[unoccluded].max() < 1e-4

    # On planes inverse depth is linear in the pixel, so there the depth map of frame 5 can be interpolated.
    inverse = 1.0 / np.asarray(truth.depths[5], dtype=np.float64)
    rendered = 1.0 / map_coordinates(inverse, projected.T[::-1], order=1, mode="nearest")
    bend = cv2.dilate(np.abs(cv2.Laplacian(inverse, cv2.CV_64F)), np.ones((3, 3)))
    planar = map_coordinates(bend, projected.T[::-1], order=0) < 5e-6
    masked = map_coordinates(exact.masks[5], projected.T[::-1], order=0) > 0
    inside = ((projected >= 1) & (projected <= [318, 238])).all(axis=-1)
    compared = inside & planar & unoccluded & ~masked
    assert compared.sum() > 2000
    assert np.abs(rendered - in_frame[:, 2])[compared].max() < 1e-4


def test_track_pixels_are_the_projections_of_track_points(exact: Simulation) -> None:
    truth = exact.sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.track_points is not None
    assert truth.intrinsics is not None
    projected = project(truth.intrinsics, world_to_camera(truth.world_T_cam[None], truth.track_points))
    seen = np.isfinite(exact.tracks.uv[..., 0])
    assert seen.mean() > 0.99
    assert np.abs(projected - exact.tracks.uv)[seen].max() < 1e-5


def test_tracks_start_on_their_grid(exact: Simulation) -> None:
    tracks = exact.tracks
    u, v = np.meshgrid(np.linspace(6, 313, 24), np.linspace(6, 233, 18))
    grid = np.stack((u.ravel(), v.ravel()), axis=-1)
    start = tracks.uv[np.arange(len(tracks.uv)), tracks.query_frame]
    assert np.abs(start - np.concatenate((grid, grid))).max() < 1e-2
    assert tracks.visible[np.arange(len(tracks.uv)), tracks.query_frame].all()


def test_visible_tracks_lie_on_the_rendered_surface_and_hidden_ones_behind_it(exact: Simulation) -> None:
    truth = exact.sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.depths is not None
    tracks = exact.tracks
    hidden_in_view = 0
    for t in range(6):
        z = world_to_camera(truth.world_T_cam[t], tracks.points[:, t])[:, 2]
        uv = tracks.uv[:, t]
        inside = ((uv >= 0) & (uv <= [319, 239])).all(axis=-1)
        assert not tracks.visible[~inside, t].any()
        u0, v0 = np.clip(np.floor(np.nan_to_num(uv)).astype(int), 0, [318, 238]).T
        around = np.stack([np.asarray(truth.depths[t])[v0 + dv, u0 + du] for dv in (0, 1) for du in (0, 1)])
        seen = tracks.visible[:, t]
        # The four pixels around a visible point bracket its depth; a point in front of them all is impossible.
        bracketed = (z >= around.min(axis=0) - 0.01) & (z <= around.max(axis=0) + 0.01)
        assert bracketed[seen].mean() > 0.995
        hidden = inside & ~seen
        hidden_in_view += int(hidden.sum())
        assert (z > around.min(axis=0) - 0.01)[hidden].all()
        behind_all = z > around.max(axis=0) * 1.01
        assert not behind_all[seen].any()
        assert seen[inside & ~behind_all & (around.max(axis=0) - around.min(axis=0) < 0.02)].mean() > 0.98
    assert hidden_in_view > 20


def test_masks_agree_with_the_instances_of_visible_tracks(exact: Simulation) -> None:
    tracks = exact.tracks
    assert set(np.unique(tracks.instance)) == {0, 1, 2}
    for t in range(6):
        seen = tracks.visible[:, t]
        u, v = np.round(tracks.uv[seen, t]).astype(int).T
        assert (exact.masks[t][v, u] == tracks.instance[seen]).mean() > 0.98
        interior = cv2.erode((exact.masks[t] > 0).astype(np.uint8), np.ones((3, 3)))[v, u] > 0
        assert (tracks.instance[seen][interior] > 0).all()


def test_static_tracks_rest_rigid_ones_keep_distances_and_deforming_ones_do_not(exact: Simulation) -> None:
    points, instance = exact.tracks.points, exact.tracks.instance
    assert np.ptp(points[instance == 0], axis=1).max() == 0.0

    def largest_change_of_distance(which: int) -> tuple[float, float]:
        mine = points[instance == which]
        distance = np.linalg.norm(mine[:, None] - mine[None], axis=-1)
        return float(np.ptp(distance, axis=-1).max()), float(np.linalg.norm(np.ptp(mine, axis=1), axis=-1).min())

    change, traveled = largest_change_of_distance(1)
    assert change < 1e-12
    assert traveled > 0.03
    change, traveled = largest_change_of_distance(2)
    assert change > 0.04
    assert traveled > 0.03


def test_true_object_poses_carry_the_tracks_of_rigid_instances_and_turn(exact: Simulation) -> None:
    truth, tracks = exact.sequence.ground_truth, exact.tracks
    assert truth.rigid_instance is not None
    assert truth.world_T_object is not None
    assert truth.rigid_instance.tolist() == [1]
    assert truth.world_T_object.shape == (1, 6, 4, 4)
    points, poses = tracks.points[tracks.instance == 1], truth.world_T_object[0]
    in_object = world_to_camera(np.broadcast_to(poses, (len(points), 6, 4, 4)), points)
    assert len(points) > 50
    np.testing.assert_allclose(in_object, np.broadcast_to(in_object[:, :1], in_object.shape), atol=1e-12)
    turn = poses[0, :3, :3].T @ poses[5, :3, :3]
    assert np.degrees(np.arccos(0.5 * (np.trace(turn) - 1.0))) > 5.0
    assert np.linalg.norm(poses[5, :3, 3] - poses[0, :3, 3]) > 0.05


def test_a_room_that_moves_has_one_true_pose_and_a_scene_at_rest_none() -> None:
    times = np.arange(3) / 15
    ids, poses = make_scene("all_dynamic").rigid_poses(times)
    assert ids.tolist() == [1, 3]
    assert poses.shape == (2, 3, 4, 4)
    ids, poses = make_scene("none").rigid_poses(times)
    assert (ids.shape, poses.shape) == ((0,), (0, 3, 4, 4))


def test_lucas_kanade_follows_the_exact_tracks(exact: Simulation) -> None:
    first, second = (cv2.cvtColor(exact.sequence.images[t], cv2.COLOR_RGB2GRAY) for t in (3, 4))
    tracks = exact.tracks
    both = tracks.visible[:, 3] & tracks.visible[:, 4]
    start = tracks.uv[both, 3].astype(np.float32)
    end, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, winSize=(21, 21), maxLevel=3)
    error = np.linalg.norm(end - tracks.uv[both, 4], axis=-1)
    assert found.mean() > 0.95
    for which in (0, 1, 2):
        mine = tracks.instance[both] == which
        assert np.median(error[mine]) < 0.3
        assert np.median(np.linalg.norm(tracks.uv[both, 4] - start, axis=-1)[mine]) > 0.3


def test_images_are_textured_and_brightness_is_nearly_constant(exact: Simulation) -> None:
    images = np.stack([exact.sequence.images[t] for t in range(6)]).astype(np.float64)
    gray = images.mean(axis=-1)
    assert 15 < np.abs(np.diff(gray, axis=2)).mean() + np.abs(np.diff(gray, axis=1)).mean() < 80
    assert (gray > 250).mean() < 0.01
    tracks = exact.tracks
    kept = tracks.visible.all(axis=1)
    u, v = np.moveaxis(tracks.uv[kept], -1, 0)
    value = np.stack([map_coordinates(gray[t], [v[:, t], u[:, t]], order=1) for t in range(6)], axis=1)
    assert np.median(np.ptp(value, axis=1)) < 12


def test_the_same_configuration_gives_the_same_arrays() -> None:
    config = SyntheticSceneConfig(num_frames=3, height=60, width=80, focal=75.0, query_interval=2)
    a, b = make_synthetic_sequence(config), make_synthetic_sequence(config)
    other = make_synthetic_sequence(config.model_copy(update={"seed": 1}))
    assert a.tracks is not None
    assert b.tracks is not None
    assert other.tracks is not None
    for t in range(3):
        np.testing.assert_array_equal(a.images[t], b.images[t])
        np.testing.assert_array_equal(a.depths[t], b.depths[t])
        np.testing.assert_array_equal(a.masks[t], b.masks[t])
        np.testing.assert_array_equal(a.images[t], other.images[t])
        assert not np.array_equal(a.depths[t], other.depths[t])
    np.testing.assert_array_equal(a.tracks.uv, b.tracks.uv)
    assert not np.array_equal(a.tracks.uv, other.tracks.uv, equal_nan=True)


@pytest.mark.parametrize(
    ("objects", "ids"),
    [("none", {0}), ("rigid", {0, 1}), ("deforming", {0, 2}), ("both", {0, 1, 2}), ("all_dynamic", {1, 2, 3})],
)
def test_the_choice_of_objects_decides_the_instances(objects: str, ids: set[int]) -> None:
    config = SyntheticSceneConfig.model_validate(
        {"num_frames": 2, "height": 60, "width": 80, "focal": 75.0, "objects": objects, "render_images": False}
    )
    simulation = simulate(config)
    assert set(np.unique(simulation.masks)) == ids
    assert set(np.unique(simulation.tracks.instance)) == ids
    moves = np.linalg.norm(np.diff(simulation.tracks.points, axis=1)[:, 0], axis=-1) > 1e-3
    dynamic = simulation.tracks.instance > 0
    assert not moves[~dynamic].any()
    assert (~moves[dynamic]).sum() <= 0.01 * dynamic.sum()
    assert (simulation.sequence.images[1] == 128).all()


def test_big_problems_are_cheap_without_images() -> None:
    config = SyntheticSceneConfig(
        num_frames=20, height=120, width=160, focal=150.0, grid_columns=50, grid_rows=35, render_images=False
    )
    sequence = make_synthetic_sequence(config)
    assert sequence.tracks is not None
    assert sequence.tracks.visible.shape == (3500, 20)
    assert sequence.tracks.visible.mean() > 0.5
