"""Lazy frame sources: values, sizes, damaged files."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sequence_samples import cut_file, write_image

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence import frames
from uni4d_fg.frontend.sequence.decode import clean_depth, read_depth, read_image, read_mask
from uni4d_fg.frontend.sequence.frames import DepthFolder, ImageFolder, MaskFolder, NpyDepth, no_masks
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.sequence.video import VideoFrames


def test_color_image_is_rgb(tmp_path: Path) -> None:
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[..., 2] = 200  # OpenCV writes BGR: this is red
    write_image(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0, 0], [200, 0, 0])


def test_gray_alpha_and_16_bit_images(tmp_path: Path) -> None:
    gray = np.array([[0, 100, 255]], np.uint8)
    write_image(tmp_path / "gray.png", gray)
    np.testing.assert_array_equal(read_image(tmp_path / "gray.png")[0, :, 1], [0, 100, 255])
    alpha = np.full((2, 2, 4), (1, 2, 3, 9), np.uint8)
    write_image(tmp_path / "alpha.png", alpha)
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png")[1, 1], [3, 2, 1])
    deep = np.array([[0, 257 * 100, 65535]], np.uint16)
    write_image(tmp_path / "deep.png", deep)
    image = read_image(tmp_path / "deep.png")
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image[0, :, 0], [0, 100, 255])


def test_files_are_decoded_once_as_far_as_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (5, 4, 6, 3), dtype=np.uint8)
    paths = tuple(tmp_path / f"{frame}.png" for frame in range(5))
    for path, image in zip(paths, pixels, strict=True):
        write_image(path, image)
    decoded: list[str] = []

    def counted(path: Path) -> np.ndarray:
        decoded.append(path.name)
        return read_image(path)

    monkeypatch.setattr(frames, "read_image", counted)
    monkeypatch.setattr(frames, "KEPT_BYTES", 3 * pixels[0].nbytes)
    folder = ImageFolder(paths, size=(4, 6))
    for _ in range(3):
        for frame in range(5):
            np.testing.assert_array_equal(folder[frame], pixels[frame, :, :, ::-1])
            assert not folder[frame].flags.writeable
    assert decoded[:5] == [path.name for path in paths]
    assert "0.png" not in decoded[5:], "what was asked for first is kept"
    assert folder._kept_bytes <= 3 * pixels[0].nbytes
    write_image(paths[0], pixels[1])
    os.utime(paths[0], ns=(1, 1))
    np.testing.assert_array_equal(folder[0], pixels[1, :, :, ::-1])
    again = pickle.loads(pickle.dumps(folder))
    assert not again._kept
    np.testing.assert_array_equal(again[4], folder[4])


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("keep", [0.0, 0.05, 0.5, 0.99])
def test_truncated_image_names_the_file(tmp_path: Path, suffix: str, keep: float) -> None:
    path = tmp_path / f"frame{suffix}"
    write_image(path, np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8))
    cut_file(path, keep)
    with pytest.raises(InputError, match="frame") as raised:
        read_image(path)
    assert "replace the file" in str(raised.value)


def test_text_is_not_an_image(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("not an image")
    for read in (read_image, read_depth, read_mask):
        with pytest.raises(InputError, match=r"a\.png: cannot be decoded as an image"):
            read(tmp_path / "a.png")
    with pytest.raises(InputError, match="no such file; an image file is expected"):
        read_image(tmp_path / "absent.png")


def test_image_folder_checks_sizes_and_indices(tmp_path: Path) -> None:
    for name, size in (("0", (4, 6)), ("1", (4, 6)), ("2", (6, 4))):
        write_image(tmp_path / f"{name}.png", np.full((*size, 3), int(name), np.uint8))
    frames = ImageFolder(tuple(tmp_path / f"{i}.png" for i in range(3)))
    assert isinstance(frames, FrameSource)
    assert (len(frames), frames.size) == (3, (4, 6))
    assert frames[np.int64(1)][0, 0, 0] == 1
    with pytest.raises(InputError, match=r"2\.png: is 4 x 6 px, but the first image is 6 x 4 px"):
        frames[-1]
    with pytest.raises(IndexError):
        frames[3]
    with pytest.raises(InputError):
        list(frames)


special = st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf, 1e-30, 1e300, 2.5])


@given(depth=hnp.arrays(np.float64, (3, 4), elements=st.one_of(special, st.floats(-10, 10))))
def test_clean_depth(depth: np.ndarray) -> None:
    before = depth.copy()
    cleaned = clean_depth(depth)
    assert cleaned.dtype == np.float32
    np.testing.assert_array_equal(depth, before)
    with np.errstate(over="ignore"):
        as_float = depth.astype(np.float32)
    usable = np.isfinite(as_float) & (as_float > 0)
    np.testing.assert_array_equal(np.isfinite(cleaned), usable)
    np.testing.assert_array_equal(cleaned[usable], as_float[usable])


def test_depth_png_units_and_missing(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.array([[0, 1500, 65535, 256]], np.uint16))
    expected = np.array([[np.nan, 1.5, np.nan, 0.256]], np.float32)
    np.testing.assert_array_equal(read_depth(tmp_path / "a.png"), expected)
    kitti = read_depth(tmp_path / "a.png", 256.0)
    assert kitti[0, 3] == 1.0
    frames = DepthFolder((tmp_path / "a.png",), (1, 4), 5000.0)
    assert frames[0][0, 1] == np.float32(0.3)


def test_pictures_of_depth_are_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "gray.png", np.zeros((2, 2), np.uint8))
    write_image(tmp_path / "jet.png", np.zeros((2, 2, 3), np.uint8))
    for name in ("gray.png", "jet.png"):
        with pytest.raises(InputError, match="save depth as 16-bit PNG in millimeters"):
            read_depth(tmp_path / name)
    np.save(tmp_path / "a.npy", np.zeros((2, 2), np.int32))
    with pytest.raises(InputError, match="int32"):
        read_depth(tmp_path / "a.npy")


@pytest.mark.parametrize("shape", [(3, 4, 5), (3, 1, 4, 5)])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_npy_depth(tmp_path: Path, shape: tuple[int, ...], dtype: type) -> None:
    depth = np.arange(60, dtype=dtype).reshape(shape)
    np.save(tmp_path / "depth.npy", depth)
    frames = NpyDepth(tmp_path / "depth.npy", (4, 5))
    assert len(frames) == 3
    assert np.isnan(frames[0][0, 0])
    np.testing.assert_array_equal(frames[2], depth.reshape(3, 4, 5)[2].astype(np.float32))
    with pytest.raises(InputError, match="is 5 x 4 px, but the first image is 4 x 5 px"):
        NpyDepth(tmp_path / "depth.npy", (5, 4))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((3, 2, 4, 5)), r"\(T, 1, H, W\)"),
        (np.zeros((4, 5)), r"\(T, H, W\)"),
        (np.zeros((3, 4, 5), np.uint16), "unknown unit"),
        (np.array([{"a": 1}], dtype=object), "Python objects"),
    ],
)
def test_npy_depth_refuses(tmp_path: Path, array: np.ndarray, message: str) -> None:
    np.save(tmp_path / "depth.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match=message):
        NpyDepth(tmp_path / "depth.npy")


def test_npy_depth_cut_after_opening(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.ones((3, 4, 5)))
    frames = NpyDepth(tmp_path / "depth.npy")
    cut_file(tmp_path / "depth.npy")
    with pytest.raises(InputError, match="cut short"):
        frames[0]


def test_mask_encodings(tmp_path: Path) -> None:
    write_image(tmp_path / "one.png", np.array([[0, 3]], np.uint8))
    write_image(tmp_path / "deep.png", np.array([[0, 300]], np.uint16))
    write_image(tmp_path / "rgb.png", np.array([[[0, 0, 0], [3, 2, 1]]], np.uint8))  # B, G, R
    np.save(tmp_path / "ids.npy", np.array([[0, 9]], np.int64))
    assert [int(read_mask(tmp_path / n)[0, 1]) for n in ("one.png", "deep.png", "rgb.png", "ids.npy")] == [
        3,
        300,
        1 + 256 * 2 + 65536 * 3,
        9,
    ]
    np.save(tmp_path / "negative.npy", np.array([[-1, 9]]))
    with pytest.raises(InputError, match="ids from -1 to 9"):
        read_mask(tmp_path / "negative.npy")
    np.save(tmp_path / "float.npy", np.array([[0.5, 9]]))
    with pytest.raises(InputError, match="integer ids"):
        read_mask(tmp_path / "float.npy")
    frames = MaskFolder((tmp_path / "one.png",), (2, 2))
    with pytest.raises(InputError, match=r"one\.png: is 2 x 1 px"):
        frames[0]


def test_no_masks_are_read_only_and_shared() -> None:
    frames = no_masks((2, 3), 1000)
    assert (len(frames), frames[999].shape, frames[0].dtype) == (1000, (2, 3), np.int32)
    assert np.shares_memory(frames[0], frames[5])
    with pytest.raises(ValueError, match="read-only"):
        frames[0][0, 0] = 1


@settings(max_examples=10, deadline=None)
@given(order=st.lists(st.integers(-9, 8), min_size=1, max_size=12))
def test_video_frames_in_any_order(tmp_path_factory: pytest.TempPathFactory, order: list[int]) -> None:
    path = tmp_path_factory.mktemp("video") / "video.mp4"
    make_video(path, 9)
    frames = VideoFrames(path)
    assert (len(frames), frames.size, frames.frame_rate) == (9, (48, 64), 12.5)
    for frame in order:
        assert abs(float(frames[frame].mean()) - 20 * (frame % 9)) < 8


def make_video(path: Path, length: int) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 12.5, (64, 48))
    for i in range(length):
        writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
    writer.release()


def test_video_returns_copies_and_keeps_few(tmp_path: Path) -> None:
    make_video(tmp_path / "video.mp4", 8)
    frames = VideoFrames(tmp_path / "video.mp4")
    frames[2][:] = 255
    assert frames[2].mean() < 60
    assert len(list(frames)) == 8
    assert len(frames._cache) <= 4
    with pytest.raises(IndexError):
        frames[8]


def test_broken_video(tmp_path: Path) -> None:
    (tmp_path / "video.mp4").write_bytes(b"no video" * 50)
    with pytest.raises(InputError, match=r"video\.mp4: cannot be opened as a video; re-encode"):
        VideoFrames(tmp_path / "video.mp4")
