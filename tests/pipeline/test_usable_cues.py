"""Cues from which no camera can be found are refused in one sentence, before anything else is done."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import TINY, depth_of, make_config, make_scene, masks_of, with_depth, with_masks

from uni4d_fg.arrays import FloatArray
from uni4d_fg.cues.plan import CuePlan
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.assemble import as_sequence, as_video
from uni4d_fg.frontend.sequence.calibration import guess_intrinsics
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.pipeline import lens, reconstruct
from uni4d_fg.pipeline.stream import stream_sequence
from uni4d_fg.pipeline.usable_cues import check_given_cues
from uni4d_fg.pipeline.warnings import found_focal_warnings
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.lens.calibration import LensCalibration
from uni4d_fg.slam.lens.zoom import ZoomCalibration

FREE = make_config().input
FIXED = make_config("input.intrinsics=fixed").input


def scene() -> Sequence:
    return make_scene(TINY)


def true_intrinsics() -> FloatArray:
    truth = scene().ground_truth.intrinsics
    assert truth is not None
    return truth


def in_millimeters(sequence: Sequence) -> Sequence:
    return with_depth(sequence, 1000.0 * depth_of(sequence))


def without_depth(sequence: Sequence) -> Sequence:
    return with_depth(sequence, np.full_like(depth_of(sequence), np.nan))


def in_other_units(sequence: Sequence) -> Sequence:
    return dataclasses.replace(sequence, intrinsics=np.array([4.2, 4.2, 39.5, 29.5]))


def of_other_images(sequence: Sequence) -> Sequence:
    return dataclasses.replace(sequence, intrinsics=sequence.intrinsics * 4.0)


def normalized(sequence: Sequence) -> Sequence:
    assert sequence.tracks is not None
    uv = sequence.tracks.uv / np.float32(sequence.image_size[::-1])
    return dataclasses.replace(sequence, tracks=dataclasses.replace(sequence.tracks, uv=uv))


def all_moving(sequence: Sequence) -> Sequence:
    return with_masks(sequence, np.ones_like(masks_of(sequence)))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (in_millimeters, r"outside 0.05 to 80 m in every frame \(its median is \d+.*check the unit"),
        (without_depth, "missing everywhere"),
        (all_moving, "mark every pixel of every frame as moving"),
        (in_other_units, "focal length 4.2 px is that of no camera with images of 80 x 60 px"),
        (of_other_images, "lies outside the image of 80 x 60 px"),
        (normalized, "lie within the first pixel, as normalized ones do; give pixels"),
    ],
)
def test_they_are_refused_before_a_folder_is_made(
    tmp_path: Path, spoil: Callable[[Sequence], Sequence], said: str
) -> None:
    for run in (reconstruct, stream_sequence):
        with pytest.raises(InputError, match=said):
            run(spoil(scene()), tmp_path / "run", make_config())
    assert not (tmp_path / "run").exists()


def test_one_frame_of_use_is_enough() -> None:
    depth, masks = depth_of(scene()), np.ones_like(masks_of(scene()))
    depth[:-1] = np.nan
    masks[:-1] = 1
    masks[-1, 0, 0] = 0
    check_given_cues(with_depth(with_masks(scene(), masks), depth), FREE)


def test_cues_that_are_not_used_may_be_of_no_use() -> None:
    video = as_video(all_moving(in_millimeters(scene())))
    check_given_cues(video, FREE, CuePlan(depth="card", depth_model="any", masks="motion"))
    with pytest.raises(InputError, match="mark every pixel"):
        check_given_cues(video, FREE, CuePlan(depth="card", depth_model="any"))
    # Cameras that are given need neither.
    check_given_cues(all_moving(without_depth(scene())), make_config("input.poses=fixed").input)


def test_intrinsics_that_are_to_be_kept_must_be_given() -> None:
    bare = dataclasses.replace(as_video(scene()), intrinsics=None)
    guessed = as_sequence(bare)
    assert guessed.intrinsics_are_guessed
    assert guessed.given_intrinsics is None
    np.testing.assert_array_equal(guessed.intrinsics, guess_intrinsics(bare.image_size))
    assert as_video(guessed).intrinsics is None
    for video in (bare, guessed):
        check_given_cues(video, FREE)
        with pytest.raises(InputError, match=r"brings no intrinsics, and input.intrinsics is 'fixed'.*--intrinsics"):
            check_given_cues(video, FIXED)
    # A network may tell them, and depth from motion without parallax keeps whatever it was made with.
    check_given_cues(bare, FIXED, CuePlan(depth="card", depth_model="any"))
    check_given_cues(dataclasses.replace(guessed, depth_parallax=False), FIXED)
    check_given_cues(scene(), FIXED)


def test_a_guess_is_not_called_given(tmp_path: Path) -> None:
    guessed = as_sequence(dataclasses.replace(as_video(scene()), intrinsics=None))
    started = f"no intrinsics were given: the focal length started from a guess, {guessed.intrinsics[0]:.0f} px"
    batch = reconstruct(guessed, tmp_path / "batch", make_config())
    assert started in batch.stages["bundle_adjustment"]["facts"]
    stream = stream_sequence(guessed, tmp_path / "stream", make_config())
    assert [fact.startswith(started) for fact in stream.facts] == [True]
    far = dataclasses.replace(scene(), intrinsics=scene().intrinsics * [1.5, 1.5, 1.0, 1.0])
    given = reconstruct(far, tmp_path / "far", make_config())
    assert not any("from a guess" in fact for fact in given.stages["bundle_adjustment"]["facts"])
    assert any(
        "focal lengths moved by" in text and f"{far.intrinsics[0]:.0f} px given" in text for text in given.warnings
    )
    assert not any("focal lengths moved" in text for text in [*batch.warnings, *stream.doubts])


def test_odd_intrinsics_are_warned_of(tmp_path: Path) -> None:
    far = dataclasses.replace(scene(), intrinsics=np.array([1000.0, 1000.0, 39.5, 29.5]))
    said = "the given intrinsics are odd: focal length 1000.0 px is unusual for an image 80 px wide; check that"
    for run in (reconstruct, stream_sequence):
        run(far, tmp_path / run.__name__, make_config("input.intrinsics=fixed"))
        warnings = json.loads(RunFolder(tmp_path / run.__name__).summary.read_text())["warnings"]
        assert [said in text for text in warnings].count(True) == 1
    # What camera motion told is doubted where it does.
    assert found_focal_warnings(dataclasses.replace(far, focal_sigma=0.1), far.intrinsics[:2], (0.4, 3.0)) == []


def moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: LensCalibration, given: FloatArray) -> list[str]:
    monkeypatch.setattr(lens, "calibrate_with_shutter", lambda *_: found)
    config = make_config("camera.rolling_shutter=off", "camera_init.max_depth_spread=null")
    summary = reconstruct(dataclasses.replace(scene(), intrinsics=given), tmp_path, config)
    return [text for text in summary.warnings if "focal lengths moved" in text]


def test_focal_lengths_that_moved_are_those_of_the_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = true_intrinsics() * [1.5, 1.5, 1.0, 1.0]
    half_way = true_intrinsics() * [1.25, 1.25, 1.0, 1.0]
    (text,) = moved(tmp_path, monkeypatch, LensCalibration(Lens("SIMPLE_RADIAL", (-1e-6,)), half_way), given)
    result = load_reconstruction(RunFolder(tmp_path).reconstruction).intrinsics
    assert abs(result[0] / half_way[0] - 1.0) > 0.1
    assert f"{result[:2].mean():.0f} px was found, and {given[0]:.0f} px given" in text


def test_focal_lengths_that_a_zoom_moved_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ratio = np.linspace(0.9, 1.0, scene().num_frames)
    zoom = ZoomCalibration(ratio, true_intrinsics(), 6.0, 0.0, ("the camera zooms",))
    found = LensCalibration(PINHOLE, zoom.intrinsics, zoom=zoom)
    longest = zoom.intrinsics[0]
    (text,) = moved(tmp_path / "far", monkeypatch, found, zoom.intrinsics * [1.5, 1.5, 1.0, 1.0])
    assert f"moved by 33 % from the given ones: {0.9 * longest:.0f} to {longest:.0f} px was found" in text
    assert moved(tmp_path / "near", monkeypatch, found, zoom.intrinsics * [0.95, 0.95, 1.0, 1.0]) == []


@pytest.mark.parametrize("guessed", [False, True])
def test_a_focal_length_that_no_camera_has_is_said(guessed: bool) -> None:
    sequence = dataclasses.replace(scene(), intrinsics_are_guessed=guessed)
    assert found_focal_warnings(sequence, sequence.intrinsics[:2], (0.4, 3.0)) == []
    text = found_focal_warnings(sequence, np.array([10.5, 10.6]), (0.4, 3.0))[-1]
    assert "the focal length found (11 px, 0.13 of the longer image side) is unusual" in text
    assert text.endswith("give K.npy if it is known" if guessed else "if those that were given are right")
    # Given ones that stayed are warned of as given.
    long = dataclasses.replace(sequence, intrinsics=np.array([400.0, 400.0, 39.5, 29.5]), intrinsics_are_guessed=False)
    assert found_focal_warnings(long, long.intrinsics[:2], (0.4, 3.0)) == []
