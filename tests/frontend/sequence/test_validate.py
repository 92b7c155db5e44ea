"""Validation lists everything at once, never raises, and says what to do."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sequence_samples import FRAMES, HEIGHT, TRACKS, WIDTH, cut_file, native_folder, rewrite_npz, write_image

from uni4d_fg.config.cues import InputConfig
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.sequence.selection import FrameSelection
from uni4d_fg.frontend.sequence.validate import validate_sequence


def said(root: Path, severity: str) -> list[tuple[str, str]]:
    return [(f.item, f.message) for f in validate_sequence(root).findings if f.severity == severity]


def test_sound_sequence(tmp_path: Path) -> None:
    report = validate_sequence(native_folder(tmp_path, frames=4))
    assert report.ok
    assert report.findings == ()
    items = {item.name: item for item in report.items}
    assert list(items) == [
        "images", "depth", "masks", "intrinsics", "tracks", "timestamps", "initial poses", "true poses",
        "true depth", "true intrinsics", "true track points", "true object poses",
    ]  # fmt: skip
    assert items["images"].shape == (HEIGHT, WIDTH, 3)
    assert (items["depth"].count, items["depth"].shape) == (FRAMES, (HEIGHT, WIDTH))
    low, high = items["depth"].range or (0, 0)
    assert 0.5 <= low < 0.6
    assert 3.9 < high <= 4.0
    assert items["masks"].range == (0, 7)
    assert (items["tracks"].count, items["tracks"].shape) == (TRACKS, (TRACKS, FRAMES, 2))
    assert items["intrinsics"].count == 1
    assert json.loads(json.dumps(report.to_dict()))["items"][0] == {
        "name": "images",
        "count": 4,
        "shape": [HEIGHT, WIDTH, 3],
        "dtype": "uint8",
        "range": [0.0, 255.0],
    }


def test_everything_is_listed_at_once(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    cut_file(root / "rgb" / "frame_0000.png")
    cut_file(root / "depth_cue" / "frame_0004.png")
    write_image(root / "masks" / "frame_0002.png", np.zeros((3, 3), np.uint8))
    np.save(root / "K.npy", np.zeros((2, 2)))
    np.save(root / "c2w.npy", np.zeros((FRAMES, 4, 4)))
    (root / "timestamps.txt").write_text("0\n0\n0\n0\n")
    rewrite_npz(root / "tracks.npz", uv=np.full((TRACKS, FRAMES, 2), np.nan), query_frame=np.full(TRACKS, 99))
    (root / "depth_gt" / "frame_0000.png").unlink()
    errors = said(root, "error")
    assert [item for item, _ in errors] == [
        "images", "depth", "masks", "intrinsics", "tracks", "tracks", "timestamps", "true poses", "true depth",
    ]  # fmt: skip
    messages = dict(errors)
    assert "frame_0000.png: is cut short" in messages["images"]
    assert "frame_0004.png: is cut short" in messages["depth"]
    assert "is 3 x 3 px, but the first image is 16 x 12 px" in messages["masks"]
    assert "query_frame has values that are not frames 0 to 3" in messages["tracks"]
    assert "3 files for 4 images (without one: frame_0000)" in messages["true depth"]


def test_depth_that_is_missing_or_in_the_wrong_unit(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    write_image(root / "depth_cue" / "frame_0002.png", np.zeros((HEIGHT, WIDTH), np.uint16))
    assert said(root, "warning") == [
        ("depth", f"{root / 'depth_cue'}: all depth is missing in frame(s) 1"),
    ]
    np.save(root / "depth.npy", np.full((FRAMES, HEIGHT, WIDTH), 1500.0))
    outside = f"{root / 'depth.npy'}: the median depth is outside 0.05 to 200 m in frame(s) 0, 1, 2, 3"
    assert [m for _, m in said_of(root, "depth", "error")] == [outside]
    used = np.full((FRAMES, HEIGHT, WIDTH), 1500.0)
    used[:, 0, 0] = 70.0  # within the limits of what is used: it can be reconstructed, as badly as that may be
    np.save(root / "depth.npy", used)
    assert [m for _, m in said_of(root, "depth", "warning")] == [outside]
    np.save(root / "depth.npy", np.full((FRAMES, HEIGHT, WIDTH), -np.inf))
    assert [m for _, m in said_of(root, "depth", "error")] == [f"{root / 'depth.npy'}: all depth is missing"]
    sparse = np.zeros((FRAMES, HEIGHT, WIDTH), np.float32)
    sparse[:, :3] = 1
    np.save(root / "depth.npy", sparse)
    assert [m for _, m in said_of(root, "depth", "warning")] == [f"{root / 'depth.npy'}: 75 % of the depth is missing"]


def test_what_is_noted_of_the_depth(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    shutil.rmtree(root / "depth_cue")
    np.save(root / "depth.npy", np.full((FRAMES, HEIGHT, WIDTH), 0.01, np.float32))
    limits = InputConfig(min_depth_m=0.001)
    (odd,) = validate_sequence(root, limits=limits).of("warning")
    assert "the median depth is outside 0.05 to 200 m" in odd.message
    note = root / "depth_cue.json"
    note.write_text('{"metric": false}')
    report = validate_sequence(root, limits=limits)
    assert not report.of("warning")
    assert f"{note}: depth is in a unit of its own" in [f.message for f in report.of("info")]
    note.write_text('{"metric": false, "focal_sigma": -1}')
    (error,) = validate_sequence(root, limits=limits).of("error")
    assert (error.item, "has -1 for the standard deviation" in error.message) == ("depth", True)


def said_of(root: Path, depth: str, severity: str) -> list[tuple[str, str]]:
    report = validate_sequence(root, depth=depth)
    return [(f.item, f.message) for f in report.findings if f.severity == severity]


def test_limits_of_depth_are_those_of_the_configuration(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    np.save(root / "depth.npy", np.full((FRAMES, HEIGHT, WIDTH), 1500.0))
    assert validate_sequence(root, depth="depth", limits=InputConfig(max_depth_m=2000.0)).ok
    (error,) = validate_sequence(root, limits=InputConfig(max_depth_m=0.4)).of("error")
    assert (error.item, "lies outside 0.05 to 0.4 m in every frame" in error.message) == ("depth", True)


def test_frames_that_are_not_used_are_not_read(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    for folder in ("rgb", "depth_cue", "masks"):
        cut_file(root / folder / "frame_0006.png")
    write_image(root / "masks" / "frame_0002.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    rewrite_npz(root / "tracks.npz", visible=np.eye(TRACKS, FRAMES, dtype=bool))
    assert not validate_sequence(root).ok
    report = validate_sequence(root, selection=FrameSelection(stop=3, stride=2))
    assert report.findings == ()
    assert {item.name: item.count for item in report.items}["masks"] == 2
    with_full = validate_sequence(root, selection=FrameSelection(stop=3))
    assert [f.message for f in with_full.findings] == [f"{root / 'masks'}: no pixel is static in frame(s) 1"]
    (few,) = validate_sequence(root, selection=FrameSelection(start=1, stop=2)).of("error")[:1]
    assert "the selection leaves 1 of 4 frames" in few.message


def test_the_first_frame_is_always_read(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    cut_file(root / "depth_cue" / "frame_0000.png")
    selection = FrameSelection(start=1)
    (error,) = validate_sequence(root, selection=selection).of("error")
    with pytest.raises(InputError, match=r"depth_cue/frame_0000\.png: is cut short"):
        open_video(root, selection)
    assert "frame_0000.png: is cut short" in error.message


def test_intrinsics_that_are_replaced_are_not_read(tmp_path: Path) -> None:
    root, given = native_folder(tmp_path / "room"), tmp_path / "cameras.txt"
    (root / "K.npy").write_bytes(b"broken")
    given.write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 20 20 8 6\n")
    assert [f.item for f in validate_sequence(root).of("error")] == ["intrinsics"]
    assert validate_sequence(root, intrinsics=given).findings == ()
    given.write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 20 20 80 6\n")
    (error,) = validate_sequence(root, intrinsics=given).of("error")
    assert "cameras.txt: principal point (79.5, 5.5) lies outside" in error.message
    (error,) = validate_sequence(root, intrinsics=tmp_path / "nosuch.npy").of("error")
    assert "nosuch.npy" in error.message


def test_masks(tmp_path: Path) -> None:
    root = native_folder(tmp_path, ids=(0,))
    assert said(root, "info") == [("masks", f"{root / 'masks'}: all masks are empty: a static video")]
    write_image(root / "masks" / "frame_0002.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert said(root, "warning") == [("masks", f"{root / 'masks'}: no pixel is static in frame(s) 1")]
    for path in sorted((root / "masks").iterdir()):
        write_image(path, np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert said(root, "error") == [("masks", f"{root / 'masks'}: no pixel is static in frame(s) 0, 1, 2, 3")]


def rename_all(folder: Path, names: list[str]) -> None:
    for path, name in zip(sorted(folder.iterdir()), names, strict=True):
        path.rename(folder / f"{name}.new")
    for name in names:
        (folder / f"{name}.new").rename(folder / f"{name}.png")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["8", "9", "10", "11"], "11 comes before 8"),
        ([f"{i:03d}" for i in (0, 1, 2, 3, 4, 5, 9, 10)], "missing between 005 and 009"),
        (["a", "b", "c", "d"], None),
        (["1341.17", "1341.21", "1341.9", "1342.1"], None),
        ([f"{i:03d}" for i in (0, 3, 6, 9)], None),
    ],
)
def test_frame_numbers(tmp_path: Path, names: list[str], message: str | None) -> None:
    root = native_folder(tmp_path, frames=len(names))
    for folder in ("rgb", "depth_cue", "masks", "depth_gt"):
        rename_all(root / folder, sorted(names))
    warnings = [m for item, m in said(root, "warning") if item == "images"]
    assert len(warnings) == (message is not None)
    assert message is None or message in warnings[0]


def test_cues_named_after_other_frames(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    (root / "masks" / "frame_0000.png").rename(root / "masks" / "frame_0008.png")
    assert said(root, "warning") == [
        (
            "masks",
            "files belong to images in the order of their names, in which frame_0002 goes with frame_0000",
        )
    ]
    rename_all(root / "masks", ["1", "3", "5", "7"])
    assert said(root, "warning") == []


def test_intrinsics(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    np.save(root / "K.npy", np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]]))
    # A run refuses them, too.
    assert "principal point (320.0, 240.0) lies outside the image of 16 x 12 px" in said(root, "error")[0][1]
    with pytest.raises(InputError, match=r"K.npy: principal point \(320.0, 240.0\) lies outside"):
        read_sequence(root)
    np.save(root / "K.npy", np.array([[585.0, 0, 7.5], [0, 585, 5.5], [0, 0, 1]]))
    assert said(root, "warning")[0][1].endswith("K.npy: focal length 585.0 px is unusual for an image 16 px wide")
    read_sequence(root)
    (root / "K.npy").unlink()
    assert said(root, "warning") == [("intrinsics", "there is no K.npy: a focal length of 16 px is guessed")]


def test_tracks_never_visible(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    rewrite_npz(root / "tracks.npz", visible=np.zeros((TRACKS, FRAMES), bool))
    assert said(root, "warning") == [("tracks", f"{root / 'tracks.npz'}: no track is visible anywhere")]
    visible = np.ones((TRACKS, FRAMES), bool)
    visible[:, 2] = False
    rewrite_npz(root / "tracks.npz", visible=visible, uv=np.full((TRACKS, FRAMES, 2), 3.0))
    assert said(root, "warning") == [("tracks", f"{root / 'tracks.npz'}: no track is visible in frame(s) 2")]


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (lambda uv: uv / (WIDTH, HEIGHT), "100 % of the visible observations lie within the first pixel"),
        (lambda uv: 2 * uv / (WIDTH, HEIGHT) - 1, "100 % of the visible observations lie within the first pixel"),
        (lambda uv: 2 * uv, "75 % of the visible observations lie outside the image of 16 x 12 px"),
        (lambda uv: uv[..., ::-1], "25 % of the visible observations lie outside the image of 16 x 12 px"),
    ],
)
def test_tracks_in_other_coordinates(tmp_path: Path, place: Callable[[np.ndarray], np.ndarray], words: str) -> None:
    root = native_folder(tmp_path)
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 1, 2)
    uv = np.repeat(grid, FRAMES, axis=1).astype(np.float32)
    (root / "ground_truth.npz").unlink()
    whole = {"visible": np.ones(uv.shape[:2], bool), "query_frame": np.zeros(len(uv), int)}
    np.savez(root / "tracks.npz", uv=uv, **whole)
    assert validate_sequence(root).findings == ()
    np.savez(root / "tracks.npz", uv=place(uv).astype(np.float32), **whole)
    (found,) = said(root, "error")
    assert found[0] == "tracks"
    assert words in found[1]
    with pytest.raises(InputError, match=words):
        read_sequence(root)


def test_many_broken_files_are_summed_up(tmp_path: Path) -> None:
    root = native_folder(tmp_path, frames=30)
    for path in (root / "rgb").iterdir():
        path.write_bytes(b"")
    report = validate_sequence(root)
    errors = [f for f in report.of("error") if f.item == "images"]
    assert len(errors) == 21
    assert "10 more frames" in errors[-1].message


@pytest.mark.parametrize("frames", [1, 2])
def test_short_videos(tmp_path: Path, frames: int) -> None:
    root = native_folder(tmp_path, frames=frames)
    assert validate_sequence(root).ok == (frames == 2)


def test_nothing_there(tmp_path: Path) -> None:
    for root in (tmp_path / "absent", tmp_path):
        report = validate_sequence(root)
        assert not report.ok
        assert report.layout is None
        assert len(report.findings) == 1


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_damage_is_reported_and_agrees_with_reading(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    root = native_folder(tmp_path_factory.mktemp("fuzz"))
    paths = sorted(p for p in root.rglob("*") if p.is_file())
    whole = [path.read_bytes() for path in paths]
    for path in data.draw(st.lists(st.sampled_from(paths), min_size=1, max_size=3, unique=True)):
        content = bytearray(path.read_bytes())
        kind = data.draw(st.sampled_from(["remove", "cut", "flip", "swap"]))
        if kind == "remove":
            path.unlink()
        elif kind == "cut":
            path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
        elif kind == "flip":
            content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
            path.write_bytes(content)
        else:
            path.write_bytes(data.draw(st.sampled_from(whole)))
    report = validate_sequence(root, "native")
    try:
        sequence = read_sequence(root, "native")
        for source in (sequence.images, sequence.depths, sequence.masks):
            list(source)
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017 - reading may succeed too
        assert not report.ok


@pytest.mark.data
def test_real_sequences() -> None:
    folder = os.environ.get("UNI4D_FG_DATA")
    if not folder:
        pytest.skip("UNI4D_FG_DATA is not set: no real sequences to read")
    for name, ids in (("kitchen", (0, 0)), ("kitchen_dog", (0, 1))):
        report = validate_sequence(Path(folder) / name)
        assert report.ok, report.findings
        assert report.of("warning") == ()
        items = {item.name: item for item in report.items}
        assert items["masks"].range == ids
        assert items["images"].count == items["true poses"].count == 60
        sequence = read_sequence(Path(folder) / name)
        np.testing.assert_array_equal(sequence.intrinsics, [585, 585, 320, 240])
        assert sequence.image_size == (480, 640)
        assert sequence.ground_truth.depths is not None
        ratio = sequence.depths[0] / sequence.ground_truth.depths[0]
        assert 0.8 < float(np.nanmedian(ratio)) < 1.2
