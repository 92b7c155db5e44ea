"""A zoom, found with the cameras, on synthetic scenes: every frame's focal length comes out, and none where none is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from lens_runs import calibrated, config, labelled
from warping import warp_sequence
from zooming import ramp, zoom_sequence

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.sequence.frames import no_masks
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel, Tracks
from uni4d_fg.frontend.tracks.cache import load_or_track
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.export.run import export_run
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.residuals import reprojection_residuals
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.lens.calibration import calibrate_lens
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.fit import LensFit

pytest.importorskip("open3d")

FRAMES = 12


def scene(**more: object) -> Sequence:
    small = {"num_frames": FRAMES, "grid_columns": 16, "grid_rows": 12, "query_interval": 4, "objects": "rigid"}
    return make_synthetic_sequence(SyntheticSceneConfig(**(small | {"render_images": False} | more)))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Sequence]]:
    """A scene, and the same seen by a camera that zooms from 1 to 1.6."""
    plain = scene()
    out = {}
    for name, sequence in (("plain", plain), ("zoomed", zoom_sequence(plain, ramp(FRAMES)))):
        folder = tmp_path_factory.mktemp(name)
        reconstruct(sequence, folder, config())
        out[name] = folder, sequence
    return out


def test_every_frame_gets_its_focal_length(runs: dict[str, tuple[Path, Sequence]]) -> None:
    result = load_reconstruction(RunFolder(runs["zoomed"][0]).reconstruction)
    assert result.zoom is not None
    np.testing.assert_allclose(result.frame_intrinsics[:, 0], 300.0 * ramp(FRAMES), rtol=0.03)
    assert result.zoom.max() == 1.0
    assert load_reconstruction(RunFolder(runs["plain"][0]).reconstruction).zoom is None


def test_the_path_is_nearly_as_good_as_without_zoom(runs: dict[str, tuple[Path, Sequence]]) -> None:
    errors = {name: evaluate_run(*run).to_dict()["trajectory"]["ate_m"] for name, run in runs.items()}
    # What is left of zoom against motion along the view; taken for a camera that does not zoom it is 15 times as much.
    assert errors["zoomed"] < 3.5 * errors["plain"]


def test_the_summary_says_so(runs: dict[str, tuple[Path, Sequence]]) -> None:
    folder, sequence = runs["zoomed"]
    stage = json.loads(RunFolder(folder).summary.read_text())["stages"]["lens"]
    assert any(fact.startswith("the camera zooms: fx from ") for fact in stage["facts"])
    assert len(stage["zoom"]["focal_px"]) == FRAMES
    again = reconstruct(sequence, folder, config(), resume=True)
    assert all(again.stages[name]["resumed"] for name in ("lens", "bundle_adjustment", "nonrigid", "fusion"))


def test_residuals_and_exports_have_a_camera_per_frame(runs: dict[str, tuple[Path, Sequence]], tmp_path: Path) -> None:
    folder, sequence = runs["zoomed"]
    result = load_reconstruction(RunFolder(folder).reconstruction)
    residuals = reprojection_residuals(result, load_labels(RunFolder(folder).labels))
    assert np.median(residuals.norm[~residuals.is_dynamic]) < 1.0
    export_run(Run(folder, lambda: sequence), ["colmap", "nerfstudio"], tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    focal = [model.cameras[model.images[number + 1].camera_id].focal_length_x for number in range(FRAMES)]
    np.testing.assert_allclose(focal, result.frame_intrinsics[:, 0], rtol=1e-12)
    assert model.compute_mean_reprojection_error() < 1.2
    frames = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())["frames"]
    np.testing.assert_allclose([f["fl_x"] for f in frames], result.frame_intrinsics[:, 0])


def test_a_zoom_of_which_the_first_undamped_step_says_nothing() -> None:
    """The step is refused, and the damped one in its place gains 0.01 % of the energy."""
    ratio = ramp(24, 0.6)
    plain = scene(seed=11, num_frames=24, grid_columns=20, grid_rows=15)
    found = calibrated(zoom_sequence(plain, ratio / ratio.min()))
    assert found.zoom is not None
    assert found.zoom.zoom is not None
    np.testing.assert_allclose(found.intrinsics[0] * found.zoom.zoom, 300.0 * ratio / ratio.min(), rtol=0.01)


def test_a_zoom_that_distortion_seems_to_explain_is_compared_with_the_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever two steps say of distortion: the zoom explains all tracks together better than the lens found."""
    ratio = ramp(FRAMES)
    monkeypatch.setattr(LensFit, "probe", lambda fit, scene: 0.9)
    found = calibrated(zoom_sequence(scene(), ratio))
    assert found.zoom is not None
    assert found.zoom.zoom is not None
    assert found.lens.is_pinhole
    np.testing.assert_allclose(found.intrinsics[0] * found.zoom.zoom, 300.0 * ratio, rtol=0.03)
    assert found.candidates
    assert "better than the lens does" in found.zoom.notes[1]


@pytest.mark.slow
def test_a_lens_is_no_zoom_however_loudly_tracks_ask_for_one() -> None:
    plain = scene(num_frames=20)
    assert plain.ground_truth.intrinsics is not None
    lens = Lens("SIMPLE_RADIAL", (-0.2,))
    bent, loud = warp_sequence(plain, plain.ground_truth.intrinsics, lens), "camera.min_zoom_evidence=0"
    found = calibrated(bent, loud, "camera.sound_depth_sigma=0")  # without what the depth cue says of a lens
    assert found.zoom is not None
    assert found.zoom.zoom is None
    assert found.lens.parameters[0] == pytest.approx(-0.2, abs=0.02)
    beside_cue = calibrated(bent, loud)
    assert beside_cue.zoom is None
    assert beside_cue.lens.parameters[0] == pytest.approx(-0.2, abs=0.02)


@pytest.mark.parametrize("more", [{"seed": 2}, {"path": "forward"}])
def test_a_camera_that_does_not_zoom(more: dict[str, object]) -> None:
    sequence = scene(**more)
    found = calibrated(sequence)
    assert found.zoom is not None
    assert found.zoom.zoom is None
    assert found.zoom.notes[0].startswith("a focal length per frame would lower the reprojection energy by ")
    np.testing.assert_array_equal(found.intrinsics, sequence.intrinsics)


@pytest.mark.parametrize("built_in", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_moves_without_a_mask_is_no_zoom(built_in: bool) -> None:
    """Two things cover 17 % of 8 tiny frames: a focal length per frame explains them at the cost of what stands."""
    tiny = {"num_frames": 8, "height": 120, "width": 160, "focal": 150.0, "margin_px": 3.0, "query_interval": 6}
    sequence = scene(**tiny, objects="both", render_images=built_in)
    sequence = replace(sequence, masks=no_masks(sequence.image_size, sequence.num_frames))
    settings = config()
    tracks = load_or_track(sequence, settings.tracking, None) if built_in else sequence.tracks
    assert tracks is not None
    given = label_tracks(tracks, sequence, settings.labels, settings.input)
    found = calibrate_lens(given, sequence.image_size, sequence.intrinsics, settings)
    assert found.zoom is not None
    assert found.zoom.evidence > 10 * settings.camera.min_zoom_evidence
    assert found.zoom.zoom is None
    assert any("something may move that no mask covers" in warning for warning in found.zoom.warnings)
    assert found.lens.is_pinhole
    forced = calibrate_lens(given, sequence.image_size, sequence.intrinsics, config("camera.zoom=on"))
    assert forced.zoom is not None
    assert forced.zoom.zoom is not None


def test_zoom_that_is_asked_for_or_ruled_out() -> None:
    sequence = scene(seed=1)
    forced = calibrated(sequence, "camera.zoom=on", "camera.model=pinhole")
    assert forced.zoom is not None
    assert forced.zoom.zoom is not None
    np.testing.assert_allclose(forced.zoom.zoom, 1.0, atol=0.03)
    assert calibrated(sequence, "camera.zoom=off").zoom is None
    with pytest.raises(ConfigError, match="zoom 'on' goes with model 'auto' or 'pinhole', not with 'radial'"):
        config("camera.zoom=on", "camera.model=radial")


def test_unzoomed_tracks_are_those_of_one_focal_length() -> None:
    sequence = scene()
    ratio = ramp(FRAMES)
    real, zoomed = labelled(sequence), labelled(zoom_sequence(sequence, ratio))
    longest = sequence.intrinsics * [1.6, 1.6, 1.0, 1.0]
    ideal = CameraModel(longest, zoom=ratio / ratio.max()).ideal_labelled(zoomed)
    seen = zoomed.tracks.visible
    expected = longest[2:] + 1.6 * (real.tracks.uv[: len(seen)] - longest[2:])
    if len(real.label) == len(zoomed.label):
        np.testing.assert_allclose(ideal.tracks.uv[seen], expected[seen], atol=1e-3)
    weight = np.where(zoomed.weight > 0, (ratio / 1.6) ** 2, 0.0)
    np.testing.assert_allclose(ideal.weight, weight * zoomed.weight, rtol=1e-5)


def test_a_wall_seen_frontally_leaves_zoom_and_motion_open() -> None:
    """A wall that grows: the camera zooms or comes nearer, and a cue without scale does not tell."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1.2, 1.2, (150, 2)), np.full((150, 1), 4.0)], axis=1)
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 2, 3] = np.linspace(0.0, 0.8, 10)
    K = np.array([300.0, 300.0, 159.5, 119.5])
    x = world_to_camera(poses[None], points[:, None])
    uv = (project(K, x) + rng.normal(0.0, 0.3, (150, 10, 2))).astype(np.float32)
    visible = ((uv >= 0) & (uv <= [319, 239])).all(axis=2)
    uv[~visible] = np.nan
    depth = np.where(visible, x[..., 2] * np.exp(rng.normal(0.0, 0.15, (1, 10))), np.nan).astype(np.float32)
    tracks = Tracks(uv, visible, np.zeros(150, np.int32))
    given = LabelledTracks(
        tracks,
        np.full(150, int(TrackLabel.STATIC), np.int32),
        np.zeros(150, np.int32),
        visible.astype(np.float32),
        depth,
    )
    found = calibrate_lens(given, (240, 320), K, config())
    assert found.zoom is not None
    assert any("zoom and motion along the view can hardly be told apart" in w for w in found.zoom.warnings)
    plain = calibrated(scene(seed=1)).zoom
    assert plain is not None
    assert not plain.warnings


@pytest.mark.slow
def test_a_zoom_on_the_way_straight_forward_is_doubted() -> None:
    forward = make_synthetic_sequence(SyntheticSceneConfig(path="forward", render_images=False))
    for sequence, doubted in ((forward, True), (scene(), False)):
        found = calibrated(zoom_sequence(sequence, ramp(sequence.num_frames))).zoom
        assert found is not None
        assert found.zoom is not None
        assert any("hardly determine its focal length" in warning for warning in found.warnings) == doubted
