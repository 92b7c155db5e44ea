from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.tracks.lucas_kanade import query_grid, track_grid

HEIGHT, WIDTH = 120, 160
COARSE = TrackingConfig(
    grid_columns=14, grid_rows=11, query_interval=4, margin_px=10, max_drift_px=2.0, reseed_spacing=None
)

Motion = Callable[[FloatArray, int], FloatArray]
"""Position (N, 2) in frame 0 and a frame -> position (N, 2) in that frame."""


def texture(seed: int) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """A smooth random function of the plane with exact values at any position, gray levels around 128."""
    rng = np.random.default_rng(seed)
    waves = 40
    wavelength = rng.uniform(9, 50, waves)
    angle = rng.uniform(0, 2 * np.pi, waves)
    phase = rng.uniform(0, 2 * np.pi, waves)
    kx, ky = 2 * np.pi * np.cos(angle) / wavelength, 2 * np.pi * np.sin(angle) / wavelength

    def value(x: FloatArray, y: FloatArray) -> FloatArray:
        total = np.zeros(x.shape)
        for i in range(waves):
            total += np.sin(kx[i] * x + ky[i] * y + phase[i])
        return np.clip(128 + 14 * total, 0, 255)

    return value


def gray_levels(image: FloatArray) -> ImageArray:
    return np.repeat(np.rint(image).astype(np.uint8)[..., None], 3, axis=-1)


def pixel_grid() -> FloatArray:
    return np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2).astype(float)


def video(inverse: Motion, frames: int, seed: int = 0) -> ImageArray:
    """Images of a textured plane; ``inverse`` leads from a frame back to frame 0."""
    plane = texture(seed)
    images = []
    for t in range(frames):
        source = inverse(pixel_grid(), t)
        images.append(gray_levels(plane(source[:, 0], source[:, 1]).reshape(HEIGHT, WIDTH)))
    return np.stack(images)


def shift(velocity: tuple[float, float]) -> tuple[Motion, Motion]:
    v = np.asarray(velocity)
    return (lambda p, t: p + t * v), (lambda p, t: p - t * v)


def errors(tracks_uv: npt.NDArray[np.float32], query_frame: npt.NDArray[np.int32], to: Motion, back: Motion):
    """Distance (K, T) from the true position, by the position in the query frame."""
    result = np.full(tracks_uv.shape[:2], np.nan)
    for k, q in enumerate(query_frame):
        first = back(tracks_uv[k, q][None].astype(float), int(q))
        for t in range(tracks_uv.shape[1]):
            result[k, t] = np.linalg.norm(to(first, t)[0] - tracks_uv[k, t])
    return result


@settings(max_examples=8, deadline=None)
@given(st.floats(-3, 3), st.floats(-3, 3), st.integers(0, 1000))
def test_sub_pixel_shift(dx: float, dy: float, seed: int) -> None:
    to, back = shift((dx, dy))
    tracks = track_grid(ArrayFrames(video(back, 9, seed)), COARSE)
    error = errors(tracks.uv, tracks.query_frame, to, back)[tracks.visible]
    assert tracks.visible.mean() > 0.5
    assert np.median(error) < 0.1
    assert np.quantile(error, 0.95) < 0.3


def test_rotation_and_zoom() -> None:
    center = np.array([80.0, 60.0])

    def similarity(p: FloatArray, t: int) -> FloatArray:
        angle, scale = np.radians(1.0) * t, 1.01**t
        rotation = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return (p - center) @ rotation.T + center

    tracks = track_grid(ArrayFrames(video(lambda p, t: similarity(p, -t), 9)), COARSE)
    error = errors(tracks.uv, tracks.query_frame, similarity, lambda p, t: similarity(p, -t))
    assert tracks.visible.mean() > 0.8
    steps = np.abs(np.arange(9) - tracks.query_frame[:, None])
    assert np.median(error[tracks.visible & (steps == 1)]) < 0.1
    # A window that only translates errs the same way in every step of a rotation, so the error adds up.
    assert np.median(error[tracks.visible & (steps == 8)]) < 0.6


def test_tracks_start_on_the_grid_and_go_both_ways() -> None:
    _, back = shift((0.7, -0.4))
    tracks = track_grid(ArrayFrames(video(back, 9)), COARSE)
    grid = {tuple(p) for p in query_grid((HEIGHT, WIDTH), COARSE).tolist()}
    assert set(np.unique(tracks.query_frame)) == {0, 4, 8}
    rows = np.arange(tracks.num_tracks)
    assert tracks.visible[rows, tracks.query_frame].all()
    assert {tuple(p) for p in tracks.uv[rows, tracks.query_frame].tolist()} <= grid
    from_the_middle = tracks.query_frame == 4
    assert tracks.visible[from_the_middle][:, 0].mean() > 0.8
    assert tracks.visible[from_the_middle][:, 8].mean() > 0.8
    assert np.isnan(tracks.uv[~tracks.visible]).all()
    assert tracks.uv.dtype == np.float32


def test_visibility_has_no_gap() -> None:
    _, back = shift((4.0, 1.0))
    visible = track_grid(ArrayFrames(video(back, 12)), COARSE).visible.astype(int)
    starts = (np.diff(visible, axis=1, prepend=0) == 1).sum(axis=1)
    assert (starts == 1).all()


def test_points_that_leave_the_image_are_lost() -> None:
    _, back = shift((6.0, 0.0))
    config = COARSE.model_copy(update={"border_px": 5.0})
    tracks = track_grid(ArrayFrames(video(back, 10)), config)
    seen = tracks.uv[tracks.visible]
    assert seen[:, 0].max() <= WIDTH - 1 - 5
    assert seen.min() >= 5
    would_leave = (tracks.query_frame == 0) & (tracks.uv[:, 0, 0] > WIDTH - 40)
    assert would_leave.any()
    assert not tracks.visible[would_leave, 9].any()


def occlusion_video(frames: int) -> tuple[ImageArray, Callable[[int], tuple[float, float]]]:
    """A textured block of 44 px that crosses a background at rest; returns its left and right edge."""
    images = video(lambda p, t: p, frames)
    plane = texture(99)
    x, y = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))

    def edges(t: int) -> tuple[float, float]:
        return 8.0 * t - 30, 8.0 * t + 14

    for t in range(frames):
        left, right = edges(t)
        inside = (x >= left) & (x <= right)
        block = gray_levels(plane(x - left, y))
        images[t][inside] = block[inside]
    return images, edges


def test_occluded_points_are_not_visible() -> None:
    frames = 14
    images, edges = occlusion_video(frames)
    config = COARSE.model_copy(update={"query_interval": frames})
    tracks = track_grid(ArrayFrames(images), config)
    start = tracks.uv[:, 0]
    background = start[:, 0] > edges(0)[1] + 12
    covered = np.zeros(tracks.visible.shape, bool)
    for t in range(frames):
        left, right = edges(t)
        covered[:, t] = background & (start[:, 0] > left + 8) & (start[:, 0] < right - 8)
    assert covered.sum() > 200
    assert tracks.visible[covered].mean() < 0.02
    at_rest = tracks.visible & background[:, None]
    moved = np.linalg.norm(tracks.uv - start[:, None], axis=-1)[at_rest]
    assert (moved < 0.5).mean() > 0.9


def test_drift_check_loses_points_whose_appearance_is_replaced() -> None:
    first, last = video(lambda p, t: p, 1, seed=1)[0], video(lambda p, t: p, 1, seed=2)[0]
    frames = 30
    fade = np.linspace(0, 1, frames)[:, None, None, None]
    images = np.rint((1 - fade) * first + fade * last).astype(np.uint8)
    config = COARSE.model_copy(update={"query_interval": frames})
    unchecked = track_grid(ArrayFrames(images), config.model_copy(update={"max_drift_px": None}))
    checked = track_grid(ArrayFrames(images), config)
    assert unchecked.visible[:, -1].sum() > 20
    assert checked.num_tracks == 0 or checked.visible[:, -1].sum() == 0


def test_no_texture_gives_no_tracks() -> None:
    tracks = track_grid(ArrayFrames(np.full((5, HEIGHT, WIDTH, 3), 90, np.uint8)), COARSE)
    assert tracks.num_tracks == 0
    assert tracks.num_frames == 5


@pytest.mark.parametrize("frames", [1, 2])
def test_videos_shorter_than_the_least_number_of_observations(frames: int) -> None:
    tracks = track_grid(ArrayFrames(video(lambda p, t: p, frames)), COARSE)
    assert tracks.visible.all()
    assert tracks.num_tracks == 14 * 11


def test_too_short_tracks_are_left_out() -> None:
    images = video(lambda p, t: p, 6)
    images[4:] = 255 - images[4:]  # every track breaks between frames 3 and 4
    config = COARSE.model_copy(update={"query_interval": 10, "min_observations": 5})
    assert track_grid(ArrayFrames(images), config).num_tracks == 0
    kept = track_grid(ArrayFrames(images), config.model_copy(update={"min_observations": 4}))
    assert kept.num_tracks > 100
    assert (kept.visible.sum(axis=1) == 4).all()


def test_gray_and_color_images_give_the_same_tracks() -> None:
    _, back = shift((1.3, 0.2))
    images = video(back, 5)
    color, gray = track_grid(ArrayFrames(images), COARSE), track_grid(ArrayFrames(images[..., 0]), COARSE)
    np.testing.assert_array_equal(color.uv, gray.uv)


@pytest.mark.parametrize("size", [(2, 2), (8, 12), (24, 20)])
def test_tiny_images(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    images = np.repeat(rng.integers(0, 255, (1, *size, 3), dtype=np.uint8), 3, axis=0)
    tracks = track_grid(ArrayFrames(images), TrackingConfig(grid_columns=4, grid_rows=3))
    seen = tracks.uv[tracks.visible]
    assert (seen >= 0).all()
    assert (seen <= (size[1] - 1, size[0] - 1)).all()


class CountingFrames:
    def __init__(self, array: ImageArray) -> None:
        self.array = array
        self.reads = np.zeros(len(array), int)

    def __len__(self) -> int:
        return len(self.array)

    def __getitem__(self, frame: int) -> ImageArray:
        self.reads[frame] += 1
        return self.array[frame]

    def __iter__(self) -> Iterator[ImageArray]:
        return (self[t] for t in range(len(self)))


def test_images_are_decoded_once_per_sweep() -> None:
    frames = CountingFrames(video(lambda p, t: p, 8))
    track_grid(frames, COARSE)
    assert frames.reads[0] == 3  # once more for the size
    assert (frames.reads[1:] == 2).all()


def test_progress_counts_every_step() -> None:
    seen: list[tuple[int, int]] = []
    track_grid(ArrayFrames(video(lambda p, t: p, 6)), COARSE, progress=lambda *step: seen.append(step))
    assert seen == [(i, 10) for i in range(1, 11)]


def test_cancellation() -> None:
    frames = CountingFrames(video(lambda p, t: p, 6))
    with pytest.raises(Cancelled, match="step 2 of 10"):
        track_grid(frames, COARSE, should_stop=lambda: bool(frames.reads[2]))
    assert not frames.reads[3:].any()


def test_bad_images() -> None:
    images = video(lambda p, t: p, 3)
    with pytest.raises(InputError, match="no images"):
        track_grid(ArrayFrames(images[:0]), COARSE)
    with pytest.raises(InputError, match="uint8"):
        track_grid(ArrayFrames(images.astype(np.float32)), COARSE)
    ragged = CountingFrames(images)
    ragged.array = [images[0], images[1], images[2][:-1]]  # type: ignore[assignment]
    with pytest.raises(InputError, match="image 2"):
        track_grid(ragged, COARSE)


@pytest.mark.data
def test_real_video(data_root: Path) -> None:
    folder = data_root / "kitchen"
    paths = sorted((folder / "rgb").iterdir())[:24]
    images = np.stack([cv2.cvtColor(cv2.imread(str(p)), cv2.COLOR_BGR2RGB) for p in paths])
    poses = np.load(folder / "c2w.npy")
    config = TrackingConfig(grid_columns=30, grid_rows=30)
    tracks = track_grid(ArrayFrames(images), config)
    assert tracks.num_tracks > 0.6 * 3 * 900
    assert tracks.visible.sum(axis=1).mean() > 10

    # Lifted with the sensor's depth in the query frame, a point of the static scene projects to its track.
    focal, center = 525.0, np.array([319.5, 239.5])
    misses = []
    for q in (0, 10, 20):
        depth = cv2.imread(str(folder / "depth_gt" / f"{paths[q].stem}.png"), cv2.IMREAD_UNCHANGED) / 1000.0
        mine = np.flatnonzero(tracks.query_frame == q)
        u, v = np.rint(tracks.uv[mine, q]).astype(int).T
        z = depth[v, u]
        ray = np.c_[(tracks.uv[mine, q] - center) / focal, np.ones(len(mine))]
        world = (ray * z[:, None]) @ poses[q, :3, :3].T + poses[q, :3, 3]
        for t in range(max(q - 10, 0), min(q + 10, len(paths))):
            use = (z > 0.3) & tracks.visible[mine, t]
            camera = (world[use] - poses[t, :3, 3]) @ poses[t, :3, :3]
            uv = camera[:, :2] / camera[:, 2:] * focal + center
            misses.append(np.linalg.norm(uv - tracks.uv[mine[use], t], axis=1))
    assert np.median(np.concatenate(misses)) < 1.2
