import numpy as np
import pytest
from pydantic import ValidationError

from uni4d_fg.config.synthetic import MAX_OBJECTS_PER_KIND, PathKind
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.synthetic.camera_path import camera_path
from uni4d_fg.frontend.synthetic.furniture import ROOM_SIZE_M
from uni4d_fg.frontend.synthetic.mesh import Mesh, box, capsule, sphere
from uni4d_fg.frontend.synthetic.scene import make_scene
from uni4d_fg.frontend.synthetic.texture import noise_volume, solid_noise

TIMES = np.arange(60) / 15.0


def enclosed_volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6.0)


@pytest.mark.parametrize(
    ("mesh", "volume"),
    [
        (box((0.5, 0.4, 0.3)), 0.06),
        (sphere(0.3, 96), 4.0 / 3.0 * np.pi * 0.3**3),
        (capsule(0.15, 0.8, 96), np.pi * 0.15**2 * 0.5 + 4.0 / 3.0 * np.pi * 0.15**3),
    ],
)
def test_primitives_are_closed_and_wound_outwards(mesh: Mesh, volume: float) -> None:
    assert enclosed_volume(mesh) == pytest.approx(volume, rel=5e-3)


@pytest.mark.parametrize("kind", ["handheld", "static", "rotation", "forward"])
def test_camera_poses_are_rigid_upright_and_inside_the_room(kind: PathKind) -> None:
    pose = camera_path(kind, TIMES, 0.42)
    rotation = pose[:, :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (60, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    assert (np.abs(pose[:, :3, 3]) < 0.5 * np.asarray(ROOM_SIZE_M) - 0.1).all()
    assert (rotation[:, 1, 1] > 0.9).all(), "the image's y axis points down"
    assert (rotation[:, 2, 2] > 0.8).all(), "the camera looks at the back wall"


def test_the_handheld_path_is_smooth_and_as_long_as_its_speed_says() -> None:
    pose = camera_path("handheld", TIMES, 0.42)
    step = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=-1)
    assert step[:29].sum() == pytest.approx(0.42 * 29 / 15, rel=0.1)
    assert step.max() < 0.042
    turn = np.swapaxes(pose[:-1, :3, :3], 1, 2) @ pose[1:, :3, :3]
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert 0.001 < angle.mean() < angle.max() < np.radians(2.0)


def test_degenerate_paths_are_exactly_degenerate() -> None:
    static, turning, forward = (camera_path(k, TIMES, 0.42) for k in ("static", "rotation", "forward"))
    assert np.ptp(static, axis=0).max() == 0.0
    assert np.ptp(turning[:, :3, 3], axis=0).max() == 0.0
    assert np.abs(turning[30, :3, :3] - turning[0, :3, :3]).max() > 0.1
    np.testing.assert_allclose(forward[:, :3, :3], np.tile(forward[0, :3, :3], (60, 1, 1)), atol=1e-12)
    moved = (forward[:, :3, 3] - forward[0, :3, 3]) @ forward[0, :3, :3]
    assert np.abs(moved[:, :2]).max() < 1e-12
    assert moved[:, 2].max() > 0.5


def test_movers_stay_in_the_room_and_in_front_of_the_camera() -> None:
    scene = make_scene("both", MAX_OBJECTS_PER_KIND)
    mover = np.repeat([o.instance > 0 for o in scene.objects], [len(o.mesh.vertices) for o in scene.objects])
    assert set(np.unique(scene.triangle_instance)) == {0, 1, 2, 3, 4, 5, 6}
    pose = camera_path("handheld", TIMES, 0.42)
    for time, camera in zip(TIMES, pose, strict=True):
        vertices = scene.vertices(time)[mover]
        assert (np.abs(vertices) < 0.5 * np.asarray(ROOM_SIZE_M)).all()
        assert ((vertices - camera[:3, 3]) @ camera[:3, 2]).min() > 1.0


def test_too_many_objects_are_refused() -> None:
    with pytest.raises(ValueError, match="objects_per_kind"):
        make_scene("both", MAX_OBJECTS_PER_KIND + 1)


def test_noise_is_normalized_periodic_and_detailed() -> None:
    volume = noise_volume()
    assert abs(float(volume.mean())) < 1e-4
    assert float(volume.std()) == pytest.approx(1.0, abs=1e-3)
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (500, 3))
    np.testing.assert_allclose(solid_noise(points), solid_noise(points + np.array([2.56, -2.56, 5.12])), atol=1e-4)
    near, far = points + np.array([0.002, 0.0, 0.0]), points + np.array([0.1, 0.0, 0.0])
    assert np.abs(solid_noise(points) - solid_noise(near)).mean() < 0.15
    assert np.abs(solid_noise(points) - solid_noise(far)).mean() > 0.6


@pytest.mark.parametrize(
    "fields",
    [
        {"num_frames": 0},
        {"path": "orbit"},
        {"objects": "many"},
        {"margin_px": 130.0},
        {"noise": {"outlier_min_px": 30}},
        {"color": 1},
    ],
)
def test_impossible_configurations_are_refused(fields: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        SyntheticSceneConfig.model_validate(fields)
