"""What is written beside cues that were found from the camera's motion, and read again."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from sequence_samples import sample_sequence

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.assemble import as_video
from uni4d_fg.frontend.sequence.native import read_native
from uni4d_fg.frontend.sequence.selection import FrameSelection, select_frames
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.geometry.lens import PINHOLE, Lens


@pytest.mark.parametrize("parallax", [True, False])
def test_depth_from_motion_says_so_in_the_folder(tmp_path: Path, parallax: bool) -> None:
    folder = tmp_path / "sequence"
    write_native(dataclasses.replace(sample_sequence(), depth_is_metric=False, depth_parallax=parallax), folder)
    assert read_native(folder).depth_parallax is parallax
    note = folder / "depth_cue.json"
    for text in ('{"metric": false, "from_motion": true}', '{"metric": false, "from_motion": {"parallax": 1}}'):
        note.write_text(text)
        with pytest.raises(InputError, match=r"depth_cue\.json: does not say whether the motion showed parallax"):
            read_native(folder)
    note.write_text('{"metric": false}')
    assert read_native(folder).depth_parallax is None


def test_masks_from_motion_are_said_to_be_so_in_the_folder(tmp_path: Path) -> None:
    sample = sample_sequence()
    for found in (True, False):
        write_native(dataclasses.replace(sample, masks_from_motion=found), tmp_path / str(found))
        assert read_native(tmp_path / str(found)).masks_from_motion is found
    assert not (tmp_path / "False" / "depth_cue.json").exists()
    (tmp_path / "True" / "depth_cue.json").write_text('{"metric": true, "masks_from_motion": 1}')
    with pytest.raises(InputError, match="has 1 for whether masks were found from motion"):
        read_native(tmp_path / "True")


@pytest.mark.parametrize("parallax", [True, None])
@pytest.mark.parametrize("sigma", [0.0, 0.0123, None])
def test_how_well_motion_tells_the_focal_length_is_in_the_folder(
    tmp_path: Path, parallax: bool | None, sigma: float | None
) -> None:
    folder = tmp_path / "sequence"
    sample = dataclasses.replace(sample_sequence(), depth_is_metric=False, depth_parallax=parallax, focal_sigma=sigma)
    write_native(sample, folder)
    assert read_native(folder).focal_sigma == sigma
    for wrong in ("true", "-0.1", '"0.1"', "1e999"):
        (folder / "depth_cue.json").write_text(f'{{"metric": false, "focal_sigma": {wrong}}}')
        with pytest.raises(InputError, match="the standard deviation of the log focal length"):
            read_native(folder)


def test_the_camera_that_motion_told_is_in_the_folder(tmp_path: Path) -> None:
    sample = sample_sequence()
    zoom = np.linspace(0.5, 1.0, sample.num_frames)
    for name, changes in (
        ("lens", {"lens": Lens("RADIAL", (-0.1, 0.02))}), ("zoom", {"zoom": zoom}), ("plain", {}),
    ):  # fmt: skip
        write_native(dataclasses.replace(sample, **changes), tmp_path / name)
        again = read_native(tmp_path / name)
        assert again.lens == changes.get("lens", PINHOLE)
        np.testing.assert_array_equal(again.zoom, changes.get("zoom"))
        assert (tmp_path / name / "depth_cue.json").exists() == (name != "plain")
    few = select_frames(as_video(read_native(tmp_path / "zoom")), FrameSelection(stop=2))
    np.testing.assert_array_equal(few.zoom, zoom[:2])
    note = tmp_path / "lens" / "depth_cue.json"
    for wrong, said in (
        ('{"model": "RADIAL", "parameters": [0.1], "zoom": null}', "does not say what the camera is"),
        ('{"model": "WIDE", "parameters": []}', "does not say what the camera is"),
        ('["RADIAL"]', "does not say what the camera is"),
        ('{"model": "PINHOLE", "parameters": [], "zoom": [1.0]}', "has a zoom that is not"),
        (f'{{"model": "PINHOLE", "parameters": [], "zoom": {[2.0] * sample.num_frames}}}', "has a zoom that is not"),
    ):
        note.write_text(f'{{"metric": true, "camera": {wrong}}}')
        with pytest.raises(InputError, match=said):
            read_native(tmp_path / "lens")
