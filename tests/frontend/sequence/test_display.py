"""Mirrored video and pixels that are not square: frames are what a player shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from video_samples import ROTATIONS, SIZE, rotate, set_matrix, set_pixel_aspect, table_first, write_video

from uni4d_fg.frontend.sequence.display import mirroring_matrix
from uni4d_fg.frontend.sequence.video import VideoFrames

HEIGHT, WIDTH = SIZE
MIRRORED = {
    "left-right": ((-1, 0, 0, 1), lambda x, y: (WIDTH - 1 - x, y)),
    "upside down": ((1, 0, 0, -1), lambda x, y: (x, HEIGHT - 1 - y)),
    "transposed": ((0, 1, 1, 0), lambda x, y: (y, x)),
    "transposed the other way": ((0, -1, -1, 0), lambda x, y: (HEIGHT - 1 - y, WIDTH - 1 - x)),
}


def picture() -> np.ndarray:
    """A bright spot about (8, 8), a gray one about (52, 8)."""
    image = np.zeros((*SIZE, 3), np.uint8)
    image[4:13, 4:13] = 250
    image[4:13, 48:57] = 120
    return image


@pytest.mark.parametrize("name", MIRRORED)
def test_display_matrices_that_mirror(tmp_path: Path, name: str) -> None:
    matrix, shown = MIRRORED[name]
    frames = VideoFrames(set_matrix(write_video(tmp_path / "clip.mp4", [picture()] * 4), matrix))
    assert mirroring_matrix(frames.path) == matrix
    for index in (0, 3, 1):  # the file is opened again in between
        image = frames[index]
        assert image.shape[:2] == frames.size
        for (x, y), value in (((8, 8), 250), ((52, 8), 120), ((30, 40), 0)):
            column, row = shown(x, y)
            assert abs(int(image[row, column, 0]) - value) < 20


@pytest.mark.parametrize("degrees", ROTATIONS)
def test_rotations_are_left_to_the_decoder(tmp_path: Path, degrees: int) -> None:
    assert mirroring_matrix(rotate(write_video(tmp_path / "clip.mp4", [picture()] * 2), degrees)) is None


@pytest.mark.parametrize(
    ("aspect", "degrees", "size"),
    [(1.5, 0, (48, 96)), (0.75, 0, (64, 64)), (1.5, 90, (96, 48)), (0.75, 270, (64, 64)), (1.0, 90, (64, 48))],
)
def test_pixels_become_square(tmp_path: Path, aspect: float, degrees: int, size: tuple[int, int]) -> None:
    path = rotate(set_pixel_aspect(write_video(tmp_path / "clip.mp4", [picture()] * 3), aspect), degrees)
    frames = VideoFrames(path)
    assert frames.size == frames[0].shape[:2] == size
    rows, columns = np.nonzero(frames[1][:, :, 0] > 185)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    stretched = (9 * max(aspect, 1.0), 9 / min(aspect, 1.0))  # of the spot, as stored
    assert (width, height) == pytest.approx(stretched if degrees % 180 == 0 else stretched[::-1], abs=1.5)


def test_a_mirrored_file_with_its_table_first(tmp_path: Path) -> None:
    path = table_first(set_matrix(write_video(tmp_path / "clip.mp4", [picture()] * 3), (-1, 0, 0, 1)))
    assert VideoFrames(path)[2][8, WIDTH - 1 - 8, 0] > 200


@pytest.mark.parametrize(
    "data", [b"", b"\0\0\0\x10ftypisom", b"\0\0\0\1moov" + b"\xff" * 40, b"\0\0\0\x10moov\0\0\0\x08trak"]
)
def test_damaged_files_have_no_matrix(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(data)
    assert mirroring_matrix(path) is None
    assert mirroring_matrix(tmp_path / "absent.mp4") is None
