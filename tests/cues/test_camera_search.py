"""Lens and zoom from tracks alone, and the camera that they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cues.camera_scenes import FRAMES, path_error, ramp, structure, through
from cues.start_scenes import GUESS, SIZE, K, forward, sideways, tracked

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.cues.pixel_grid import PixelGrid
from uni4d_fg.cues.start_doubts import start_doubts
from uni4d_fg.cues.structure import camera_search, search, zoom_search
from uni4d_fg.cues.structure.camera_fit import Fitted
from uni4d_fg.cues.structure.camera_search import FoundCamera, is_lens
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.motion import structure_from_motion
from uni4d_fg.cues.structure.rivals import Rival
from uni4d_fg.cues.track_motion import QuadraticGrid, SharedError
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry.camera import project, unproject, world_to_camera
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.geometry.se3 import inverse, so3_exp
from uni4d_fg.progress import SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.sharpness import sharp_frames


@pytest.mark.parametrize(
    "k1", [pytest.param(-0.25, marks=pytest.mark.slow), -0.12, pytest.param(0.1, marks=pytest.mark.slow)]
)
def test_a_lens_is_found_from_tracks_alone(k1: float) -> None:
    scene = through(tracked(sideways(FRAMES), points=1500), CameraModel(K, Lens("SIMPLE_RADIAL", (k1,))))
    found = structure(scene)
    assert found.camera.lens.parameters[0] == pytest.approx(k1, abs=0.02)
    assert found.camera.zoom is None
    np.testing.assert_allclose(found.intrinsics[:2], K[:2], rtol=0.02)
    np.testing.assert_array_equal(found.intrinsics, found.camera.intrinsics)
    assert path_error(found, scene) < 0.004
    pinhole = structure(scene, "camera.model=pinhole")
    assert pinhole.camera.is_plain
    assert path_error(pinhole, scene) > 1.4 * path_error(found, scene)


@pytest.mark.parametrize(("path", "moving"), [(sideways, 0), (sideways, 150), (forward, 0)])
def test_a_pinhole_that_does_not_zoom_is_left_one(path, moving: int) -> None:  # type: ignore[no-untyped-def]
    scene = tracked(path(FRAMES), points=1500, moving=moving)
    assert structure(scene).camera.is_plain


@pytest.mark.parametrize(("zoom", "count"), [(1.0, 0), pytest.param(1.6, 1, marks=pytest.mark.slow)])
def test_cameras_are_grown_anew_only_where_those_at_hand_may_hide_a_zoom(
    zoom: float, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = list[int]()
    trial = search.Search.trial

    def counted(self: search.Search, *arguments: Any) -> GrowingScene | None:
        calls.append(1)
        return trial(self, *arguments)

    monkeypatch.setattr(search.Search, "trial", counted)
    monkeypatch.setattr(camera_search, "asks_for_zoom", lambda *_: True)
    found = structure(through(tracked(sideways(FRAMES), points=1500), CameraModel(K, zoom=ramp(zoom))))
    assert len(calls) == count
    assert (found.camera.zoom is not None) is (zoom > 1.0)
    if found.camera.zoom is not None:
        np.testing.assert_allclose(found.intrinsics[0] * found.camera.zoom, K[0] * ramp(zoom), rtol=0.03)


def test_a_search_that_fails_leaves_the_pinhole(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise SolverError("no")

    monkeypatch.setattr(search, "find_camera", fail)
    assert structure(tracked(sideways(FRAMES))).camera.is_plain


@pytest.mark.parametrize(
    ("k1", "gain", "is_one"),
    [(0.02, 0.005, False), (0.02, 0.02, True), (-0.12, 0.001, True), (-0.12, -0.001, False), (0.001, 0.5, False)],
)
def test_a_weak_lens_must_gain_more_than_errors_of_a_tracker(k1: float, gain: float, is_one: bool) -> None:
    """Pixels move by 2.3 px at most through k1 = 0.02, and by 18 px, a twentieth of the width, through -0.12."""
    camera = CameraModel(K, Lens("SIMPLE_RADIAL", (k1,)))
    assert is_lens(camera, SIZE, gain, load_config("default", [])) is is_one


@pytest.mark.parametrize(("k1", "is_one"), [(-0.2, True), (0.15, True), (0.2, False), (-1.6, False)])
def test_no_lens_moves_pixels_far_outward(k1: float, is_one: bool) -> None:
    """Through 0.15 they move by 4.4 % of the width at most, through 0.2 by 5.6 %."""
    camera = CameraModel(K, Lens("SIMPLE_RADIAL", (k1,)))
    assert is_lens(camera, SIZE, 0.5, load_config("default", [])) is is_one


def test_distortion_that_no_lens_has_is_not_taken_and_told() -> None:
    lens = Lens("SIMPLE_RADIAL", (0.3,))
    found = structure(through(tracked(sideways(FRAMES), points=1500), CameraModel(K, lens)))
    assert found.camera.lens.is_pinhole
    assert found.denied_px == pytest.approx(lens.displacement(K, SIZE), rel=0.2)
    (doubt,) = (line for line in start_doubts(found) if "no lens has" in line)
    assert f"by up to {found.denied_px:.0f} px" in doubt
    plain = structure(tracked(sideways(FRAMES)))
    assert plain.denied_px == 0.0
    assert not any("no lens has" in line for line in start_doubts(plain))


def test_a_lens_that_parts_of_a_video_contradict_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_search, "halves_agree_on_lens", lambda *_: False)
    lens = Lens("SIMPLE_RADIAL", (-0.2,))
    found = structure(through(tracked(sideways(FRAMES), points=1500), CameraModel(K, lens)))
    assert found.camera.lens.is_pinhole
    assert found.denied_px == pytest.approx(lens.displacement(K, SIZE), rel=0.2)


@pytest.mark.slow
def test_a_zoom_that_explains_less_with_each_round_is_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds go on from the tracks that agree with the one before, which may be ever fewer."""
    fit, ends = zoom_search.fit_zoom, list[float]()

    def spoiled(start: Fitted, config: Config, options: dict[str, float], *, settled: bool = False) -> Fitted:
        found = fit(start, config, options, settled=settled)
        assert found.camera.zoom is not None
        if start.evidence in ends:
            found = replace(found, camera=replace(found.camera, zoom=found.camera.zoom**1.2))
        if options.get("max_iterations") == zoom_search._STEPS:
            ends.append(found.evidence)
        return found

    monkeypatch.setattr(zoom_search, "fit_zoom", spoiled)
    scene = through(tracked(sideways(FRAMES), points=1500), CameraModel(K, zoom=ramp(1.6)))
    found = structure(scene)
    assert len(ends) > 1
    assert found.camera.zoom is not None
    np.testing.assert_allclose(found.intrinsics[0] * found.camera.zoom, K[0] * ramp(1.6), rtol=0.03)


@pytest.mark.parametrize(
    ("path", "gain", "is_told"),
    [(sideways, 0.005, True), (forward, 0.01, False), pytest.param(forward, 0.03, True, marks=pytest.mark.slow)],
)
def test_a_lens_is_not_believed_where_the_focal_length_is_open_unless_it_explains_much(
    path: Callable[[int], np.ndarray], gain: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens = CameraModel(K, Lens("SIMPLE_RADIAL", (-0.12,)))
    monkeypatch.setattr(search, "find_camera", lambda *_: FoundCamera(lens, gain))
    scene = through(tracked(path(FRAMES), points=1500), lens)
    found = structure(scene)
    assert found.focal.is_wide is (path is forward)
    assert found.camera.lens.is_pinhole is not is_told
    if path is forward:  # either way the run says that the other camera may be the right one
        plain = structure(scene, "camera.model=pinhole", "camera.zoom=off")
        bent = structure_from_motion(
            lens.ideal_observations(scene.observations), FRAMES, SIZE, GUESS, load_config("default", []),
            SilentReporter(), lambda: False,
        )  # fmt: skip
        assert bent is not None
        for focal in (plain.intrinsics[:2].mean(), bent.intrinsics[:2].mean()):
            assert 0.97 * found.focal.low <= focal <= 1.03 * found.focal.high


@pytest.mark.parametrize(
    ("focal", "sharpness", "is_open", "is_told"),
    [(140.0, 0.2, True, False), (500.0, 0.2, True, False), (140.0, 0.15, True, True), (140.0, 0.2, False, True),
     (200.0, 0.208, True, True), (200.0, 0.24, True, False)],
)  # fmt: skip
def test_a_lens_that_halves_an_open_focal_length_must_make_the_sharpest_errors_smaller(
    focal: float, sharpness: float, is_open: bool, is_told: bool
) -> None:
    lens = FoundCamera(CameraModel(K, Lens("SIMPLE_RADIAL", (-0.12,))), 0.04)
    plain, grown = (
        SimpleNamespace(sharpness=sharp, scene=SimpleNamespace(mean_focal=length))
        for length, sharp in ((260.0, 0.2), (focal, sharpness))
    )
    asked = search.Search(
        FRAMES, SIZE, K, load_config("default", []), SilentReporter(), lambda: False, is_pan=False
    )  # fmt: skip
    assert not asked.is_weak(lens.camera)
    assert asked.tells_lens(plain, grown, lens, is_open) is is_told  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_lens_that_explains_much_is_found_where_the_focal_length_is_open() -> None:
    lens = CameraModel(K, Lens("SIMPLE_RADIAL", (-0.15,)))
    scene = through(tracked(forward(FRAMES), points=1500, noise_px=0.1), lens)
    found = structure(scene)
    assert found.camera.lens.padded[0] == pytest.approx(-0.15, abs=0.02)
    assert found.focal.low <= K[0] <= found.focal.high
    assert found.intrinsics[0] == pytest.approx(K[0], rel=0.03)
    assert path_error(found, scene) < 0.001


@pytest.mark.parametrize(
    ("apart", "k1", "is_told"),
    [(1.1, -0.02, False), pytest.param(1.04, -0.02, True, marks=pytest.mark.slow), (1.1, -0.12, True)],
)
def test_a_weak_lens_is_not_believed_where_starts_end_at_other_focal_lengths(
    apart: float, k1: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens = CameraModel(K, Lens("SIMPLE_RADIAL", (k1,)))
    monkeypatch.setattr(search, "find_camera", lambda *_: FoundCamera(lens, 0.02))
    monkeypatch.setattr(search, "rivals_of", lambda *_: [Rival(2, 9, apart * K[0], 0.1, 0.2, 0.01)])
    scene = through(tracked(sideways(FRAMES)), lens)
    found = structure(scene)
    assert found.camera.lens.is_pinhole is not is_told
    plain = structure(scene, "camera.model=pinhole", "camera.zoom=off")
    if k1 == -0.02:  # the run says that a pinhole, with its focal length, would do nearly as well
        assert found.focal.low <= plain.intrinsics[:2].mean() <= found.focal.high


@pytest.mark.slow
def test_frames_that_are_blurred_do_not_tell_a_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found in them errs outward, as through a lens; told that they are blurred, the search leaves them out."""
    monkeypatch.setattr(camera_search, "halves_agree_on_lens", lambda *_: True)  # half of the tracks would tell as well
    scene = tracked(sideways(FRAMES), noise_px=0.1)
    seen, blurred = scene.observations, np.arange(FRAMES) % 5 > 2
    bent = CameraModel(K, Lens("SIMPLE_RADIAL", (-0.04,))).real(seen.uv, seen.frame)
    uv = np.where(blurred[seen.frame, None], bent, seen.uv)
    scene = replace(scene, observations=replace(seen, uv=uv))
    lens = [
        structure_from_motion(
            scene.observations, FRAMES, SIZE, GUESS, load_config("default", []), SilentReporter(), lambda: False,
            any_camera=True, blur_px=blur,
        )
        for blur in (None, np.where(blurred, np.float32(9.0), np.float32(0.0)))
    ]  # fmt: skip
    told, left_out = (None if found is None else found.camera.lens.model for found in lens)
    assert (told, left_out) == ("SIMPLE_RADIAL", "PINHOLE")


def test_sharp_frames() -> None:
    blur = np.array([0.0, 2.0, 9.0, 0.0], np.float32)
    np.testing.assert_array_equal(sharp_frames(blur, 4), [True, True, False, True])
    np.testing.assert_array_equal(sharp_frames(blur + np.float32(7.0), 4), [True] * 4)  # too few are left
    np.testing.assert_array_equal(sharp_frames(None, 4), [True] * 4)


def test_a_camera_that_is_known_is_not_looked_for() -> None:
    lens = Lens("SIMPLE_RADIAL", (-0.2,))
    scene = through(tracked(sideways(FRAMES)), CameraModel(K, lens))
    found = structure_from_motion(
        scene.observations, FRAMES, SIZE, K, load_config("default", ["input.intrinsics=fixed"]), SilentReporter(),
        lambda: False, camera=CameraModel(K, lens),
    )  # fmt: skip
    assert found is not None
    assert found.camera.lens == lens
    np.testing.assert_array_equal(found.intrinsics, K)
    assert path_error(found, scene) < 0.004


@pytest.mark.parametrize(
    "camera", [CameraModel(K), CameraModel(K, Lens("SIMPLE_RADIAL", (-0.2,))), CameraModel(K, zoom=ramp(1.6))]
)
def test_pixels_of_a_static_scene_in_another_frame(camera: CameraModel) -> None:
    """Against each pixel's ray through the camera, moved and projected, at half the size."""
    height, width = 120, 160
    scale = np.array([0.5, 0.5])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = so3_exp(np.array([0.02, -0.05, 0.03])), [0.2, -0.1, 0.15]
    z = np.full((height, width), 2.5, np.float32)
    z[40:80, 50:90] = 1.5
    static = PixelGrid.of(camera, (height, width), SIZE).predict(z, pose, 3, 11)
    rows, columns = np.mgrid[0:height, 0:width]
    small = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    full = (small + 0.5) / scale - 0.5
    source, target = np.full(len(full), 3), np.full(len(full), 11)
    point = unproject(K, camera.ideal(full, source), z.reshape(-1).astype(np.float64))
    there = camera.real(np.asarray(project(K, world_to_camera(inverse(pose), point))), target)
    expected = (there + 0.5) * scale - 0.5
    found = np.stack([np.broadcast_to(static.u, z.shape), np.broadcast_to(static.v, z.shape)], axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_what_tracks_share_is_moved_to_the_pixels_of_a_zoom(rng: np.random.Generator) -> None:
    size, scale = (120, 160), np.array([0.5, 0.5])
    error = SharedError(rng.normal(0, 1, (6, 2)), SIZE)
    plain = PixelGrid.of(CameraModel(K), size, SIZE).displacement(error, 0, 1)
    fast = QuadraticGrid.of(size, scale, SIZE).displacement(error)
    np.testing.assert_allclose(plain, fast, atol=1e-4)
    camera = CameraModel(K, zoom=ramp(1.6))
    found = PixelGrid.of(camera, size, SIZE).displacement(error, 3, 11)
    row, column = 30, 110
    ideal = camera.ideal(np.array([[(column + 0.5) / 0.5 - 0.5, (row + 0.5) / 0.5 - 0.5]]), np.array([3]))[0]
    expected = np.array(error.at(ideal[0], ideal[1])) * 0.5 * ramp(1.6)[11]
    np.testing.assert_allclose([found[0][row, column], found[1][row, column]], expected, rtol=1e-5)


@pytest.mark.slow
def test_a_long_video_is_judged_on_part_of_its_frames() -> None:
    frames = 260
    plain = tracked(sideways(frames), points=900, life=130)
    zoom = 1.6 ** np.linspace(-1.0, 0.0, frames)
    scene = through(plain, CameraModel(K, zoom=zoom))
    found = structure_from_motion(
        scene.observations, frames, SIZE, GUESS, load_config("default", []), SilentReporter(), lambda: False,
        any_camera=True,
    )  # fmt: skip
    assert found is not None
    assert found.camera.zoom is not None
    np.testing.assert_allclose(found.intrinsics[0] * found.camera.zoom, K[0] * zoom, rtol=0.04)
    assert path_error(found, scene) < 0.004
