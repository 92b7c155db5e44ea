"""Part of the frames, in a smaller size: images, cues and truth stay together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sequence_samples import FRAMES, HEIGHT, TRACKS, WIDTH, sample_sequence

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Video
from uni4d_fg.frontend.sequence.resize import (
    fitting_size,
    resize_image,
    resize_nearest,
    resize_tracks,
    resize_video,
    scale_intrinsics,
)
from uni4d_fg.frontend.sequence.selection import FrameSelection, select_frames
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.camera import project


def sample_video(frames: int = FRAMES, seed: int = 0) -> Video:
    sequence = sample_sequence(seed, frames)
    names = {field.name for field in dataclasses.fields(Video)}
    return Video(**{name: value for name, value in vars(sequence).items() if name in names})


@given(
    num_frames=st.integers(0, 40),
    start=st.integers(0, 45),
    length=st.integers(1, 45) | st.none(),
    stride=st.integers(1, 9),
)
def test_indices_are_those_of_a_slice(num_frames: int, start: int, length: int | None, stride: int) -> None:
    stop = None if length is None else start + length
    found = FrameSelection(start, stop, stride).indices(num_frames)
    assert found.tolist() == list(range(num_frames))[start:stop:stride]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"start": -1}, "start is -1"),
        ({"start": 5, "stop": 5}, r"stop \(5\) does not lie behind start \(5\)"),
        ({"start": 5, "stop": 2}, r"stop \(2\) does not lie behind start \(5\)"),
        ({"stride": 0}, "stride is 0"),
        ({"max_size": 8}, "a largest size of 8 px; give 16 px or more"),
    ],
)
def test_impossible_selections(values: dict[str, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        FrameSelection(**values)


@pytest.mark.parametrize(
    "selection", [FrameSelection(3), FrameSelection(9), FrameSelection(0, 1), FrameSelection(1, 9, 4)]
)
def test_too_few_frames_left(selection: FrameSelection) -> None:
    with pytest.raises(InputError, match=r"the selection leaves [01] of 4 frames; choose"):
        select_frames(sample_video(), selection)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 99), start=st.integers(0, 6), stop=st.integers(9, 30) | st.none(), stride=st.integers(1, 5))
def test_everything_follows_the_frames(seed: int, start: int, stop: int | None, stride: int) -> None:
    video = sample_video(12, seed)
    kept = list(range(start, min(stop or 12, 12), stride))
    if len(kept) < 2:
        return
    part = select_frames(video, FrameSelection(start, stop, stride))
    truth, whole = part.ground_truth, video.ground_truth
    for name, pair in {
        "images": (part.images, video.images),
        "depths": (part.depths, video.depths),
        "masks": (part.masks, video.masks),
        "true depths": (truth.depths, whole.depths),
    }.items():
        assert len(pair[0]) == len(kept)
        for new, old in enumerate(kept):
            np.testing.assert_array_equal(pair[0][new], pair[1][old], err_msg=name)
    np.testing.assert_array_equal(part.timestamps, video.timestamps[kept])
    np.testing.assert_array_equal(part.initial_world_T_cam, video.initial_world_T_cam[kept])
    np.testing.assert_array_equal(truth.world_T_cam, whole.world_T_cam[kept])
    np.testing.assert_array_equal(part.intrinsics, video.intrinsics)
    assert part.frame_names == tuple(video.frame_names[frame] for frame in kept)
    assert part.num_frames == len(kept)

    seen = video.tracks.visible[:, kept].any(axis=1)
    assert part.tracks.num_tracks == seen.sum()
    np.testing.assert_array_equal(part.tracks.uv, video.tracks.uv[seen][:, kept])
    np.testing.assert_array_equal(part.tracks.confidence, video.tracks.confidence[seen][:, kept])
    np.testing.assert_array_equal(truth.track_points, whole.track_points[seen][:, kept])
    distance = np.abs(np.array(kept)[None] - video.tracks.query_frame[seen][:, None])
    rows = np.arange(len(distance))
    np.testing.assert_array_equal(distance[rows, part.tracks.query_frame], distance.min(axis=1))


def test_all_frames_are_left_alone() -> None:
    video = sample_video()
    assert select_frames(video, FrameSelection(stop=100)) is video
    assert select_frames(video, FrameSelection(max_size=WIDTH)) is video


@given(st.integers(1, 5000), st.integers(1, 5000), st.integers(16, 3000))
def test_fitting_size(height: int, width: int, limit: int) -> None:
    new = fitting_size((height, width), limit)
    assert max(new) == min(limit, max(height, width))
    assert min(new) >= 1
    for old, side in zip((height, width), new, strict=True):
        assert side == 1 or abs(side - old * max(new) / max(height, width)) <= 0.5


@settings(deadline=None)
@given(
    new_size=st.tuples(st.integers(16, 479), st.integers(16, 639)),
    point=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.5, 5)),
)
def test_a_point_in_space_is_found_at_the_same_place_of_the_image(
    new_size: tuple[int, int], point: tuple[float, float, float]
) -> None:
    intrinsics, size = np.array([500.0, 510.0, 320.0, 236.0]), (480, 640)
    before = project(intrinsics, np.array(point))
    after = project(scale_intrinsics(intrinsics, size, new_size), np.array(point))
    # As a fraction of the image, which reaches from -0.5 to W - 0.5.
    np.testing.assert_allclose((after + 0.5) / new_size[::-1], (before + 0.5) / size[::-1], atol=1e-9)
    tracks = Tracks(before.astype(np.float32).reshape(1, 1, 2), np.ones((1, 1), bool), np.zeros(1, np.int32))
    np.testing.assert_allclose(resize_tracks(tracks, size, new_size).uv[0, 0], after, rtol=1e-5, atol=1e-4)
    assert intrinsics.tolist() == [500.0, 510.0, 320.0, 236.0]


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_images_and_maps_keep_their_place(factor: int) -> None:
    """A ramp has at every pixel of the small image the value that the large one has there."""
    rows, columns = np.mgrid[0 : 12 * factor, 0 : 20 * factor]
    ramp = columns / factor * 8 + 20
    small = resize_image(np.repeat(np.rint(ramp).astype(np.uint8)[..., None], 3, axis=2), (12, 20))
    center = (np.arange(20) + 0.5) * factor - 0.5
    np.testing.assert_allclose(small[5, :, 1], center / factor * 8 + 20, atol=1.01)
    labels = (rows * 1000 + columns).astype(np.int32)
    taken = resize_nearest(labels, (12, 20))
    assert taken.dtype == np.int32
    assert np.abs(taken[0] % 1000 - center).max() <= 0.5
    assert np.abs(taken[:, 0] // 1000 - ((np.arange(12) + 0.5) * factor - 0.5)).max() <= 0.5


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(1, 30), st.integers(1, 30))
def test_nearest_takes_what_is_nearest(height: int, width: int, new_height: int, new_width: int) -> None:
    depth = np.random.default_rng(0).random((height, width)).astype(np.float32)
    depth[::3] = np.nan
    taken = resize_nearest(depth, (new_height, new_width))
    rows = [
        min(range(height), key=lambda r: abs((r + 0.5) / height - (i + 0.5) / new_height)) for i in range(new_height)
    ]
    for i, row in enumerate(rows):
        offset = abs((row + 0.5) / height - (i + 0.5) / new_height)
        candidates = [
            depth[r] for r in range(height) if abs(abs((r + 0.5) / height - (i + 0.5) / new_height) - offset) < 1e-12
        ]
        assert np.isin(taken[i][~np.isnan(taken[i])], np.concatenate(candidates)).all()


def test_everything_follows_the_size() -> None:
    video = sample_video()
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), np.int32)
    masks[:, :6] = 7
    video = dataclasses.replace(video, masks=ArrayFrames(masks))
    small = resize_video(video, 8)
    assert small.image_size == (6, 8)
    assert small.images[1].shape == (6, 8, 3)
    np.testing.assert_allclose(small.images[1][2, 3], video.images[1][4:6, 6:8].mean(axis=(0, 1)), atol=0.51)
    assert small.depths[1].shape == small.ground_truth.depths[1].shape == (6, 8)
    np.testing.assert_array_equal(small.depths[1], resize_nearest(video.depths[1], (6, 8)))
    assert np.unique(small.masks[2][:3]).tolist() == [7]
    assert np.unique(small.masks[2][3:]).tolist() == [0]
    np.testing.assert_allclose(small.intrinsics, [10, 10.25, 3.5, 2.5])
    np.testing.assert_allclose(small.ground_truth.intrinsics, [10.5, 10.5, 3.25, 2.25])
    np.testing.assert_allclose(video.intrinsics, [20, 20.5, 7.5, 5.5])
    np.testing.assert_allclose(small.tracks.uv, (video.tracks.uv + 0.5) / 2 - 0.5, atol=1e-6)
    np.testing.assert_array_equal(small.ground_truth.track_points, video.ground_truth.track_points)
    assert small.tracks.num_tracks == TRACKS


def test_a_video_without_cues() -> None:
    bare = Video("a", sample_video().images, (HEIGHT, WIDTH), np.arange(FRAMES, dtype=float))
    part = select_frames(bare, FrameSelection(1, stride=2, max_size=16))
    assert (part.num_frames, part.image_size, part.frame_names) == (2, (HEIGHT, WIDTH), ())
    assert part.depths is part.masks is part.tracks is part.intrinsics is None
    assert part.ground_truth == GroundTruth()
