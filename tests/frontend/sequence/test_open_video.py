"""What may be opened: sequences, folders of images, video files; and what is said of other things."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequence_samples import FRAMES, HEIGHT, WIDTH, native_folder, sample_sequence, uni4d_folder, write_image
from video_samples import SIZE, gray_frames, set_durations, write_video

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.assemble import as_sequence
from uni4d_fg.frontend.sequence.decode import read_image
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.read import read_sequence
from uni4d_fg.frontend.sequence.selection import FrameSelection
from uni4d_fg.frontend.sequence.validate import validate_sequence


@pytest.mark.parametrize("folder", [native_folder, uni4d_folder])
def test_sequence_folders_bring_their_cues(tmp_path: Path, folder: object) -> None:
    root = folder(tmp_path)
    video, sequence = open_video(root), read_sequence(root)
    again = as_sequence(video)
    assert video.name == sequence.name == "sample"
    np.testing.assert_array_equal(video.intrinsics, sequence.intrinsics)
    np.testing.assert_array_equal(again.depths[2], sequence.depths[2])
    np.testing.assert_array_equal(video.masks[1], sequence.masks[1])
    assert video.tracks.num_tracks == sequence.tracks.num_tracks
    part = open_video(root, FrameSelection(start=1, stride=2))
    np.testing.assert_array_equal(part.images[1], sequence.images[3])
    np.testing.assert_array_equal(part.ground_truth.world_T_cam, sequence.ground_truth.world_T_cam[1::2])


@pytest.mark.parametrize("folder", [native_folder, uni4d_folder])
def test_no_cue_is_needed(tmp_path: Path, folder: object) -> None:
    root = folder(tmp_path)
    for path in list(root.iterdir()):
        if path.name != "rgb":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    video = open_video(root)
    assert (video.num_frames, video.image_size) == (FRAMES, (HEIGHT, WIDTH))
    assert video.depths is video.masks is video.tracks is video.intrinsics is None
    with pytest.raises(InputError, match="has no depth"):
        as_sequence(video)
    with pytest.raises(InputError, match=r"neither mine/ nor mine\.npy is there"):
        open_video(root, depth="mine")


def test_folder_of_images(tmp_path: Path) -> None:
    root = tmp_path / "holiday"
    for name, level in (("b.JPG", 90), ("a.png", 30), ("c.jpeg", 150)):
        write_image(root / name, np.full((9, 15, 3), level, np.uint8))
    (root / ".hidden.png").write_bytes(b"")
    (root / "notes.txt").write_text("not an image")
    video = open_video(root)
    assert (video.name, video.num_frames, video.image_size) == ("holiday", 3, (9, 15))
    assert video.frame_names == ("a", "b", "c")
    assert [round(float(image.mean()), -1) for image in video.images] == [30, 90, 150]
    np.testing.assert_array_equal(video.timestamps, [0, 1, 2])
    np.save(root / "depth_cue.npy", np.ones((3, 9, 15), np.float32))
    assert open_video(root).depths is not None
    assert read_sequence(root).num_frames == 3


def test_video_file(tmp_path: Path) -> None:
    path = write_video(tmp_path / "my.clip.mov", gray_frames(9))
    video = open_video(path)
    assert (video.name, video.root, video.num_frames, video.image_size) == ("my.clip", path, 9, SIZE)
    assert video.intrinsics is video.depths is None
    part = open_video(str(path), FrameSelection(2, 7, 2, max_size=32))
    assert (part.num_frames, part.image_size) == (3, (24, 32))
    assert part.frame_names == ("00002", "00004", "00006")
    np.testing.assert_allclose(part.timestamps, np.array([2, 4, 6]) / 12.5)
    assert [round(float(image.mean()) / 20) for image in part.images] == [2, 4, 6]
    report = validate_sequence(path)
    assert report.ok
    assert [f.item for f in report.of("warning")] == ["depth", "intrinsics"]


def test_video_in_a_folder_with_cues_of_all_its_frames(tmp_path: Path) -> None:
    root = tmp_path / "clip"
    root.mkdir()
    write_video(root / "video.webm", gray_frames(9), "VP80")
    np.save(root / "depth_cue.npy", np.arange(1, 10, dtype=np.float32)[:, None, None] * np.ones(SIZE, np.float32))
    for i in range(9):
        write_image(root / "masks" / f"{i}.png", np.full(SIZE, i, np.uint8))
    part = open_video(root, FrameSelection(3, 8, 2))
    assert [float(depth[0, 0]) for depth in part.depths] == [4, 6, 8]
    assert [int(mask[0, 0]) for mask in part.masks] == [3, 5, 7]
    assert [round(float(image.mean()) / 20) for image in part.images] == [3, 5, 7]


def test_variable_frame_rate_is_kept_and_said(tmp_path: Path) -> None:
    path = set_durations(write_video(tmp_path / "clip.mp4", gray_frames(6)), [1, 3, 2, 1, 4, 1])
    np.testing.assert_allclose(open_video(path).timestamps, np.array([0, 1, 4, 6, 7, 11]) * 0.04, atol=2e-3)
    said = [f.message for f in validate_sequence(path).of("info") if f.item == "images"]
    assert len(said) == 1
    assert "variable frame rate, frames 0.04 to 0.16 s apart" in said[0]


def test_only_the_frames_before_stop_are_needed(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", gray_frames(12), "MJPG")
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"00dc", 0, data.index(b"idx1"))])
    with pytest.raises(InputError, match="is cut short"):
        open_video(path)
    assert open_video(path, FrameSelection(stop=3)).num_frames == 3


def one_image(folder: Path) -> Path:
    write_image(folder / "a.png", np.zeros((4, 4), np.uint8))
    return folder / "a.png"


def other_images(folder: Path) -> Path:
    for name in ("0.tif", "1.TIF", "2.webp", "notes.txt"):
        (folder / name).write_bytes(b"x")
    return folder


def animation(folder: Path) -> Path:
    (folder / "clip.gif").write_bytes(b"GIF89a")
    return folder / "clip.gif"


WRONG = {
    "absent": (lambda root: root / "absent", "no such folder or file"),
    "one image": (one_image, "is one image"),
    "one frame": (lambda root: write_video(root / "clip.mp4", gray_frames(1)), r"has 1 frame\(s\); give at least 2"),
    "empty folder": (lambda root: root, "there is no rgb/ and no video, nor are there images"),
    "other images": (
        other_images,
        r"nor are there images that are read \(\.png, \.jpg, \.jpeg\): it holds \.tif, \.webp; convert them to \.png",
    ),
    "animation": (animation, r"is a \.gif image, which is not read; convert it to a video such as clip\.mp4"),
    "one image in a folder": (lambda root: one_image(root).parent, r"has 1 frame\(s\)"),
    "phone pictures": (
        lambda root: [(root / "rgb").mkdir(), (root / "rgb" / "IMG_1.HEIC").write_bytes(b"x")] and root,
        r"has no \.png, \.jpg, \.jpeg file \(it holds IMG_1\.HEIC\)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_other_things(tmp_path: Path, kind: str) -> None:
    make, message = WRONG[kind]
    path = make(tmp_path)
    with pytest.raises(InputError, match=message) as raised:
        open_video(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not validate_sequence(path).ok


def test_cues_cannot_be_chosen_inside_a_file(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", gray_frames(3))
    with pytest.raises(InputError, match=r"no masks can be chosen by name; put it into a folder as video\.mp4"):
        open_video(path, masks="deva")
    with pytest.raises(InputError, match="is a file, and Uni4D's layout is asked for; give the folder"):
        open_video(path, layout="uni4d")
    with pytest.raises(InputError, match=r"is a file, and the K\.npy of Uni4D's layout is asked for"):
        open_video(path, known_intrinsics=True)
    with pytest.raises(InputError, match="a video file brings no depth; put it into a folder"):
        read_sequence(path)


def test_mixed_sizes(tmp_path: Path) -> None:
    for i, size in enumerate([(9, 15), (9, 15), (15, 9)]):
        write_image(tmp_path / f"{i}.png", np.zeros((*size, 3), np.uint8))
    video = open_video(tmp_path)
    with pytest.raises(InputError, match=r"2\.png: is 9 x 15 px, but the first image is 15 x 9 px; bring all frames"):
        list(video.images)
    errors = validate_sequence(tmp_path).of("error")
    assert [f.item for f in errors] == ["images"]


@pytest.mark.parametrize("channels", [1, 3])
def test_dark_16_bit_images(tmp_path: Path, channels: int) -> None:
    for i in range(3):
        pixels = np.full((9, 15, channels), 900, np.uint16)
        write_image(tmp_path / f"{i}.png", pixels)
    with pytest.raises(InputError, match=r"0\.png: is a 16-bit image whose brightest value is 900 of 65535"):
        open_video(tmp_path)
    assert len(validate_sequence(tmp_path).of("error")) == 1
    write_image(tmp_path / "0.png", np.full((9, 15, channels), 60000, np.uint16))
    assert [int(image[0, 0, 0]) for image in open_video(tmp_path).images] == [233, 4, 4]


def tagged(pixels: np.ndarray, orientation: int) -> bytes:
    """A JPEG file with an EXIF orientation."""
    data = cv2.imencode(".jpg", pixels)[1].tobytes()
    entry = struct.pack("<HHHII", 1, 0x112, 3, 1, orientation)
    segment = b"Exif\0\0II*\0" + struct.pack("<I", 8) + entry + struct.pack("<I", 0)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:]


@pytest.mark.parametrize("gray", [False, True])
@pytest.mark.parametrize(
    ("orientation", "column", "row"),
    [
        (1, 5.5, 4.5), (2, 57.5, 4.5), (3, 57.5, 42.5), (4, 5.5, 42.5),
        (5, 4.5, 5.5), (6, 42.5, 5.5), (7, 42.5, 57.5), (8, 4.5, 57.5),
    ],
)  # fmt: skip
def test_exif_orientation(tmp_path: Path, orientation: int, column: float, row: float, gray: bool) -> None:
    stored = np.zeros(SIZE if gray else (*SIZE, 3), np.uint8)
    stored[:10, :12] = 250
    (tmp_path / "a.jpg").write_bytes(tagged(stored, orientation))
    image = read_image(tmp_path / "a.jpg")
    assert image.shape == ((*SIZE, 3) if orientation <= 4 else (*SIZE[::-1], 3))
    y, x = np.nonzero(image[..., 0] > 128)
    np.testing.assert_allclose((x.mean(), y.mean()), (column, row), atol=0.6)


def test_cues_of_images_as_they_are_stored(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"{i}.jpg").write_bytes(tagged(np.full((*SIZE, 3), 90, np.uint8), 6))
    assert open_video(tmp_path).image_size == SIZE[::-1]
    np.save(tmp_path / "depth_cue.npy", np.ones((3, *SIZE), np.float32))
    with pytest.raises(InputError, match="images are turned upright as their files say: make cues from upright images"):
        open_video(tmp_path)


def test_sequences_keep_their_arrays_when_a_part_is_read(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    list(open_video(root, FrameSelection(1, max_size=16)).images)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before
    np.testing.assert_array_equal(open_video(root).intrinsics, sample_sequence().intrinsics)
