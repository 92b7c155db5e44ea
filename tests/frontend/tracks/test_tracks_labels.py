from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.config.cues import InputConfig, LabelConfig
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel, Tracks
from uni4d_fg.frontend.tracks.labels import label_tracks, static_frames_needed

HEIGHT, WIDTH = 60, 100
# One row of every mask: static up to column 39, instance 1 up to 69, instance 4 from 70 on.
STATIC, STATIC_BAND, BAND_1, ON_1, ON_4 = 20.0, 37.0, 41.0, 55.0, 90.0
UNSEEN = None
CONFIG = LabelConfig(band_static_px=5, band_dynamic_px=3)


def masks(frames: int) -> np.ndarray:
    mask = np.zeros((frames, HEIGHT, WIDTH), np.int32)
    mask[:, :, 40:70] = 1
    mask[:, :, 70:] = 4
    return mask


def sequence(frames: int, mask: np.ndarray | None = None, depth: np.ndarray | None = None) -> Sequence:
    return Sequence(
        name="hand-made",
        images=ArrayFrames(np.zeros((frames, HEIGHT, WIDTH, 3), np.uint8)),
        depths=ArrayFrames(np.full((frames, HEIGHT, WIDTH), 2.0, np.float32) if depth is None else depth),
        masks=ArrayFrames(masks(frames) if mask is None else mask),
        intrinsics=np.array([80.0, 80.0, 49.5, 29.5]),
        image_size=(HEIGHT, WIDTH),
        timestamps=np.arange(float(frames)),
    )


def at_columns(*columns_of_each: list[float | None]) -> Tracks:
    """Tracks in row 30 whose column in every frame is given; None where not visible."""
    uv = np.full((len(columns_of_each), len(columns_of_each[0]), 2), np.nan, np.float32)
    for k, columns in enumerate(columns_of_each):
        for t, column in enumerate(columns):
            if column is not None:
                uv[k, t] = column, 30.0
    visible = np.isfinite(uv[..., 0])
    return Tracks(uv, visible, np.zeros(len(uv), np.int32))


def label(tracks: Tracks, config: LabelConfig = CONFIG, mask: np.ndarray | None = None) -> LabelledTracks:
    return label_tracks(tracks, sequence(tracks.num_frames, mask), config, InputConfig())


@pytest.mark.parametrize(
    ("columns", "expected", "instance", "weight"),
    [
        ([STATIC] * 6, TrackLabel.STATIC, 0, [1] * 6),
        ([STATIC] * 5 + [UNSEEN], TrackLabel.STATIC, 0, [1] * 5 + [0]),
        ([STATIC] * 4 + [UNSEEN] * 2, TrackLabel.SHORT_STATIC, 0, [1] * 4 + [0] * 2),
        ([STATIC] * 5 + [STATIC_BAND], TrackLabel.STATIC, 0, [1] * 5 + [0]),
        ([STATIC] * 4 + [STATIC_BAND] * 2, TrackLabel.SHORT_STATIC, 0, [1] * 4 + [0] * 2),
        # What lies in the band does not vote, whichever side of the border it is on.
        ([STATIC] * 5 + [BAND_1], TrackLabel.STATIC, 0, [1] * 5 + [0]),
        ([ON_1] * 6, TrackLabel.DYNAMIC, 1, [1] * 6),
        ([ON_4] * 6, TrackLabel.DYNAMIC, 4, [1] * 6),
        ([UNSEEN] * 5 + [ON_4], TrackLabel.DYNAMIC, 4, [0] * 5 + [1]),
        ([ON_1] * 3 + [BAND_1, STATIC_BAND, 70.0], TrackLabel.DYNAMIC, 1, [1] * 3 + [0] * 3),
        ([STATIC] * 5 + [ON_1], TrackLabel.REJECTED, 0, [0] * 6),
        ([ON_1] * 5 + [ON_4], TrackLabel.REJECTED, 0, [0] * 6),
        ([UNSEEN] * 6, TrackLabel.REJECTED, 0, [0] * 6),
        ([BAND_1] * 6, TrackLabel.REJECTED, 0, [0] * 6),
        ([STATIC_BAND] * 6, TrackLabel.REJECTED, 0, [0] * 6),
    ],
)
def test_every_rule(columns: list[float | None], expected: TrackLabel, instance: int, weight: list[float]) -> None:
    config = CONFIG.model_copy(update={"min_static_frames": 5, "min_static_fraction": 1.0})
    labelled = label(at_columns(columns), config)
    assert labelled.label.tolist() == [expected]
    assert labelled.instance.tolist() == [instance]
    assert labelled.weight.tolist() == [weight]


def test_band_weight_holds_for_kept_tracks_only() -> None:
    tracks = at_columns(
        [STATIC] * 5 + [STATIC_BAND],
        [ON_1] * 5 + [BAND_1],
        [STATIC, ON_1] * 2 + [BAND_1, UNSEEN],
        [BAND_1] * 6,
    )
    labelled = label(tracks, CONFIG.model_copy(update={"band_weight": 0.25}))
    assert labelled.weight[0].tolist() == [1] * 5 + [0.25]
    assert labelled.weight[1].tolist() == [1] * 5 + [0.25]
    assert not labelled.weight[2:].any()
    assert labelled.weight.dtype == np.float32


def test_off_label_votes_up_to_the_allowed_share_are_dropped() -> None:
    config = CONFIG.model_copy(update={"max_off_label_fraction": 0.2})
    tracks = at_columns(
        [STATIC] * 8 + [ON_1] * 2,
        [STATIC] * 7 + [ON_1] * 3,
        [ON_4] * 8 + [ON_1, STATIC],
        [ON_1] * 2 + [STATIC] * 4 + [UNSEEN] * 4,
    )
    labelled = label(tracks, config)
    assert labelled.label.tolist() == [
        TrackLabel.STATIC,
        TrackLabel.REJECTED,
        TrackLabel.DYNAMIC,
        TrackLabel.REJECTED,
    ]
    assert labelled.instance.tolist() == [0, 0, 4, 0]
    assert labelled.weight[0].tolist() == [1] * 8 + [0] * 2
    assert labelled.weight[2].tolist() == [1] * 8 + [0] * 2
    # Static votes alone decide whether a static track is long enough.
    short = label(at_columns([STATIC] * 4 + [ON_1] + [UNSEEN] * 5), config)
    assert short.label.tolist() == [TrackLabel.SHORT_STATIC]


@pytest.mark.parametrize(
    ("frames", "needed"), [(1, 1), (2, 2), (3, 2), (4, 2), (5, 3), (8, 4), (10, 5), (60, 5), (1000, 5)]
)
def test_static_frames_needed(frames: int, needed: int) -> None:
    assert static_frames_needed(frames, LabelConfig()) == needed
    static = label(at_columns([STATIC] * needed + [UNSEEN] * (frames - needed)))
    assert static.label.tolist() == [TrackLabel.STATIC]
    if needed > 1:
        short = label(at_columns([STATIC] * (needed - 1) + [UNSEEN] * (frames - needed + 1)))
        assert short.label.tolist() == [TrackLabel.SHORT_STATIC]


def test_a_plain_share_of_the_frames_can_be_asked_for() -> None:
    config = LabelConfig(min_static_frames=10**6, min_static_fraction=0.2)
    assert static_frames_needed(65, config) == 13
    assert static_frames_needed(1000, config) == 200


def test_video_without_any_static_pixel() -> None:
    mask = np.full((5, HEIGHT, WIDTH), 3, np.int32)
    labelled = label(at_columns([STATIC] * 5, [UNSEEN] * 5), mask=mask)
    assert labelled.label.tolist() == [TrackLabel.DYNAMIC, TrackLabel.REJECTED]
    assert labelled.instance.tolist() == [3, 0]


def test_video_without_any_instance() -> None:
    mask = np.zeros((5, HEIGHT, WIDTH), np.int32)
    labelled = label(at_columns([STATIC] * 5, [UNSEEN] * 5), mask=mask)
    assert labelled.counts() == {"static": 1, "dynamic": 0, "short_static": 0, "rejected": 1}


def test_no_tracks() -> None:
    tracks = Tracks(np.zeros((0, 5, 2), np.float32), np.zeros((0, 5), bool), np.zeros(0, np.int32))
    labelled = label(tracks)
    assert labelled.weight.shape == labelled.depth.shape == (0, 5)


def test_observations_outside_the_image_are_not_visible() -> None:
    uv = np.full((1, 8, 2), 20.0, np.float32)
    uv[0, :, 0] = [-0.6, -0.5, 0, 5, 10, WIDTH - 0.51, WIDTH - 0.5, 1e6]
    uv[0, 4, 1] = HEIGHT
    tracks = Tracks(uv, np.ones((1, 8), bool), np.zeros(1, np.int32))
    labelled = label(tracks, mask=np.zeros((8, HEIGHT, WIDTH), np.int32))
    inside = [False, True, True, True, False, True, False, False]
    assert labelled.tracks.visible[0].tolist() == inside
    assert labelled.weight[0].tolist() == [float(x) for x in inside]
    np.testing.assert_array_equal(np.isnan(labelled.tracks.uv[0, :, 0]), ~np.array(inside))
    np.testing.assert_array_equal(np.isfinite(labelled.depth[0]), inside)
    assert tracks.visible.all()  # the argument is left as it was


def test_positions_of_invisible_observations_are_ignored() -> None:
    uv = np.full((1, 6, 2), 20.0, np.float32)
    uv[0, 5] = ON_1, 30
    visible = np.array([[True] * 5 + [False]])
    labelled = label(Tracks(uv, visible, np.zeros(1, np.int32)))
    assert labelled.label.tolist() == [TrackLabel.STATIC]
    assert np.isnan(labelled.depth[0, 5])


def test_depth_is_that_of_each_frame() -> None:
    depth = np.full((6, HEIGHT, WIDTH), 2.0, np.float32)
    depth *= np.arange(1, 7, dtype=np.float32)[:, None, None]
    depth[2, 30, 20] = np.nan
    depth[4] = 81.0
    tracks = at_columns([20.0] * 5 + [UNSEEN])
    labelled = label_tracks(tracks, sequence(6, depth=depth), CONFIG, InputConfig())
    np.testing.assert_array_equal(labelled.depth, np.float32([[2, 4, np.nan, 8, np.nan, np.nan]]))
    near = label_tracks(tracks, sequence(6, depth=depth), CONFIG, InputConfig(min_depth_m=3, max_depth_m=5))
    np.testing.assert_array_equal(np.isfinite(near.depth[0]), [False, True, False, False, False, False])


def test_mismatched_inputs() -> None:
    tracks = at_columns([STATIC] * 5)
    with pytest.raises(InputError, match="cover 5 frames, the sequence has 6"):
        label_tracks(tracks, sequence(6), CONFIG, InputConfig())
    with pytest.raises(InputError, match="masks cover 4"):
        label_tracks(tracks, sequence(5, mask=masks(4)), CONFIG, InputConfig())
    with pytest.raises(InputError, match="mask of frame 0"):
        label_tracks(tracks, sequence(5, mask=masks(5)[:, :-1]), CONFIG, InputConfig())
    with pytest.raises(InputError, match="depth of frame 0"):
        label_tracks(tracks, sequence(5, depth=np.ones((5, 3, 3), np.float32)), CONFIG, InputConfig())


COLUMN = st.sampled_from([UNSEEN, STATIC, STATIC_BAND, BAND_1, ON_1, ON_4])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.lists(COLUMN, min_size=7, max_size=7), min_size=1, max_size=5), st.floats(0, 0.49))
def test_against_the_rules_in_words(columns: list[list[float | None]], off_label: float) -> None:
    config = CONFIG.model_copy(update={"max_off_label_fraction": off_label, "band_weight": 0.5})
    labelled = label(at_columns(*columns), config)
    meaning = {STATIC: 0, ON_1: 1, ON_4: 4}
    for k, row in enumerate(columns):
        votes = [meaning[c] for c in row if c in meaning]
        winner = max(set(votes), key=votes.count) if votes else None
        if winner is None or len(votes) - votes.count(winner) > off_label * len(votes):
            assert labelled.label[k] == TrackLabel.REJECTED
            assert not labelled.weight[k].any()
            continue
        if winner == 0:
            enough = votes.count(0) >= static_frames_needed(7, config)
            assert labelled.label[k] == (TrackLabel.STATIC if enough else TrackLabel.SHORT_STATIC)
        else:
            assert labelled.label[k] == TrackLabel.DYNAMIC
        assert labelled.instance[k] == winner
        for t, column in enumerate(row):
            in_band = column in (STATIC_BAND, BAND_1)
            expected = 0.5 if in_band else float(column in meaning and meaning[column] == winner)
            assert labelled.weight[k, t] == expected
