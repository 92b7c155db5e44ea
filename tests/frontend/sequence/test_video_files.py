"""Video files: order, rotation flags, frame times, reading backwards, damage."""

from __future__ import annotations

import wave
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from video_samples import SIZE, gray_frames, rotate, set_durations, table_first, write_video

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence import video
from uni4d_fg.frontend.sequence.containers import missing_bytes
from uni4d_fg.frontend.sequence.video import VideoFrames

CONTAINERS = [("mp4v", ".mp4"), ("mp4v", ".mov"), ("FFV1", ".mkv"), ("MJPG", ".avi"), ("VP80", ".webm")]


def moving_frames(length: int) -> list[np.ndarray]:
    noise = np.random.default_rng(0).integers(0, 256, (SIZE[0], SIZE[1] + length, 3), dtype=np.uint8)
    wide = cv2.GaussianBlur(noise, (0, 0), 2)
    return [wide[:, i : i + SIZE[1]] for i in range(length)]


@pytest.mark.parametrize(("codec", "suffix"), CONTAINERS)
def test_containers(tmp_path: Path, codec: str, suffix: str) -> None:
    frames = VideoFrames(write_video(tmp_path / f"clip{suffix}", gray_frames(9), codec))
    assert (len(frames), frames.size, frames.frame_rate) == (9, SIZE, 12.5)
    np.testing.assert_allclose(frames.times, np.arange(9) / 12.5, atol=1e-9)
    for number, image in enumerate(frames):
        assert abs(float(image.mean()) - 20 * number) < 8


@pytest.mark.parametrize(
    ("degrees", "column", "row"), [(0, 5.5, 4.5), (90, 42.5, 5.5), (180, 57.5, 42.5), (270, 4.5, 57.5)]
)
def test_rotation_flag(tmp_path: Path, degrees: int, column: float, row: float) -> None:
    """A red patch at the top left of the stored picture is where a viewer shows it."""
    stored = np.zeros((*SIZE, 3), np.uint8)
    stored[:10, :12] = (250, 0, 0)
    frames = VideoFrames(rotate(write_video(tmp_path / "clip.mp4", [stored] * 4), degrees))
    assert frames.size == (SIZE if degrees % 180 == 0 else SIZE[::-1])
    for image in (frames[2], frames[0]):  # the second after starting again
        assert image.shape == (*frames.size, 3)
        y, x = np.nonzero(image[..., 0] > 128)
        np.testing.assert_allclose((x.mean(), y.mean()), (column, row), atol=0.6)


@settings(max_examples=15, deadline=None)
@given(parts=st.lists(st.integers(1, 6), min_size=3, max_size=12))
def test_variable_frame_rate(tmp_path_factory: pytest.TempPathFactory, parts: list[int]) -> None:
    path = tmp_path_factory.mktemp("vfr") / "clip.mp4"
    set_durations(write_video(path, gray_frames(len(parts))), parts)
    frames = VideoFrames(path)
    expected = np.cumsum([0, *parts[:-1]]) * len(parts) / sum(parts) / 12.5
    assert frames.times is not None
    np.testing.assert_allclose(frames.times, expected, atol=2e-3)
    assert (np.diff(frames.times) > 0).all()


def test_times_that_do_not_increase_are_not_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "clip.mp4", gray_frames(5))

    class Stuck:
        def __init__(self, capture: cv2.VideoCapture) -> None:
            self.capture = capture

        def __getattr__(self, name: str) -> object:
            return getattr(self.capture, name)

        def get(self, what: int) -> float:
            return 40.0 if what == cv2.CAP_PROP_POS_MSEC else self.capture.get(what)

    opened = video._quiet_capture
    monkeypatch.setattr(video, "_quiet_capture", lambda path: Stuck(opened(path)))
    frames = VideoFrames(path)
    assert frames.times is None
    assert len(frames) == 5
    assert [round(float(frames[i].mean()) / 20) for i in (4, 3, 0)] == [4, 3, 0]


@pytest.mark.parametrize(("codec", "suffix"), CONTAINERS)
@pytest.mark.parametrize("known_times", [True, False])
def test_backwards_is_the_same_as_forwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str, suffix: str, known_times: bool
) -> None:
    path = write_video(tmp_path / f"clip{suffix}", moving_frames(70), codec)
    forwards = list(VideoFrames(path))
    monkeypatch.setattr(video, "_CACHED_BYTES", 9 * forwards[0].nbytes)
    frames = VideoFrames(path)
    if not known_times:
        frames.times = None
    decoded = 0
    advance = frames._advance_to

    def counted(frame: int) -> np.ndarray | None:
        nonlocal decoded
        decoded += frame + 1 - frames._next
        return advance(frame)

    monkeypatch.setattr(frames, "_advance_to", counted)
    for number in range(69, -1, -1):
        np.testing.assert_array_equal(frames[number], forwards[number])
        assert len(frames._cache) <= 9
    # One by one from the first frame it would be 70 * 71 / 2 = 2485; by blocks of 9, an eighth of that.
    assert decoded < (320 if known_times else 420)


def test_stop_ends_the_look_through(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", gray_frames(9))
    frames = VideoFrames(path, stop=4)
    assert len(frames) == 4
    assert frames.times is not None
    assert len(frames.times) == 4
    assert len(VideoFrames(path, stop=40)) == 9


def test_odd_sizes(tmp_path: Path) -> None:
    pictures = [np.full((47, 63, 3), 20 * i, np.uint8) for i in range(5)]
    frames = VideoFrames(write_video(tmp_path / "clip.avi", pictures, "MJPG", cv2.CAP_OPENCV_MJPEG))
    assert frames.size == (47, 63)
    assert abs(float(frames[3].mean()) - 60) < 4


@pytest.mark.parametrize(("codec", "suffix"), CONTAINERS)
@pytest.mark.parametrize("keep", [0.3, 0.6, 0.97])
def test_cut_short(tmp_path: Path, codec: str, suffix: str, keep: float) -> None:
    path = write_video(tmp_path / f"clip{suffix}", moving_frames(30), codec)
    whole = path.read_bytes()
    assert missing_bytes(path) == 0
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(InputError, match=rf"clip\{suffix}: is cut short: \d+ bytes are missing at its end; copy it"):
        VideoFrames(path)


@pytest.mark.parametrize(("codec", "suffix"), CONTAINERS[:3])
def test_damage_in_the_middle(tmp_path: Path, codec: str, suffix: str) -> None:
    """The decoder stops there as at an end: the frames before must not pass for the whole video."""
    path = write_video(tmp_path / f"clip{suffix}", moving_frames(30), codec)
    stored = bytearray(path.read_bytes())
    middle, length = len(stored) // 2, len(stored) // 50
    stored[middle : middle + length] = np.random.default_rng(0).bytes(length)
    path.write_bytes(stored)
    with pytest.raises(InputError, match=r"cannot be decoded, though others follow; .* before \d+$") as raised:
        VideoFrames(path)
    stop = int(str(raised.value).rsplit(" ", 1)[1])
    assert 10 <= stop < 30
    assert len(VideoFrames(path, stop=stop)) == stop


def test_beginning_of_a_video_that_is_cut_short(tmp_path: Path) -> None:
    path = table_first(write_video(tmp_path / "clip.mp4", moving_frames(30)))
    whole = path.read_bytes()
    assert len(VideoFrames(path)) == 30
    path.write_bytes(whole[: len(whole) // 2])
    assert missing_bytes(path) == len(whole) - len(whole) // 2
    with pytest.raises(InputError, match=r"copy it again, or select frames before \d+$") as raised:
        VideoFrames(path)
    stop = int(str(raised.value).rsplit(" ", 1)[1])
    assert 3 <= stop < 25
    frames = VideoFrames(path, stop=stop)
    assert len(list(frames)) == stop


@pytest.mark.parametrize("data", [b"\xea\x75\xb6\xc9\x91\x40\x4d\x61" + bytes(256), b"\0\0\0"])
def test_bytes_behind_the_last_box(tmp_path: Path, data: bytes) -> None:
    """Not of the video, and no sign that something is missing."""
    path = write_video(tmp_path / "clip.mp4", moving_frames(9))
    path.write_bytes(path.read_bytes() + data)
    assert missing_bytes(path) == 0
    assert len(VideoFrames(path)) == 9


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=80), start=st.sampled_from([b"", b"\0\0\0\x18ftyp", b"RIFF", b"\x1a\x45\xdf\xa3\x81"]))
def test_any_bytes_have_an_end(tmp_path_factory: pytest.TempPathFactory, data: bytes, start: bytes) -> None:
    path = tmp_path_factory.mktemp("bytes") / "clip"
    path.write_bytes(start + data)
    assert missing_bytes(path) >= 0


def silence(path: Path) -> None:
    with wave.open(str(path), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(16000))


NOT_VIDEOS = {
    "text": lambda path: path.write_text("hello\n" * 100),
    "zeros": lambda path: path.write_bytes(bytes(5000)),
    "noise": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "subtitles": lambda path: path.write_text("1\n00:00:00,000 --> 00:00:01,000\nhello\n"),
    "sound only": silence,
}


@pytest.mark.parametrize("kind", NOT_VIDEOS)
@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi", ""])
def test_not_a_video(tmp_path: Path, kind: str, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"clip{suffix}"
    NOT_VIDEOS[kind](path)
    with pytest.raises(InputError, match=r"cannot be opened as a video; re-encode the video, or extract its frames"):
        VideoFrames(path)
    assert "Traceback" not in capfd.readouterr().err


def test_no_frames(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty\.mp4: is empty"):
        VideoFrames(tmp_path / "empty.mp4")
    for suffix, codec, message in ((".avi", "MJPG", "holds no frame"), (".mp4", "mp4v", "cannot be opened as a video")):
        path = write_video(tmp_path / f"none{suffix}", [], codec)
        assert path.stat().st_size > 100
        with pytest.raises(InputError, match=rf"none\{suffix}: {message}"):
            VideoFrames(path)
    with pytest.raises(InputError, match="no such file; a video file"):
        VideoFrames(tmp_path / "absent.mp4")


def test_video_that_disappears(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", gray_frames(9))
    frames = VideoFrames(path)
    assert frames[8].mean() > 100
    path.unlink()
    with pytest.raises(InputError, match="no such file; a video file"):
        frames[1]
