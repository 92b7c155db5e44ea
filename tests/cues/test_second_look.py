"""What the second look at a video, at its background, sees that the first one does not."""

from __future__ import annotations

import numpy as np

from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.background_comparison import BackgroundComparison
from uni4d_fg.cues.frame_comparison import ComparedVideo
from uni4d_fg.cues.moving_detections import detections, first_look, second_look
from uni4d_fg.cues.neighbor_comparison import NeighborComparison
from uni4d_fg.cues.packed_mask import PackedMask
from uni4d_fg.cues.track_motion import TrackMotion
from uni4d_fg.frontend.sequence.model import ArrayFrames, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.scene import Cameras

FRAMES, SIZE, SIDE, STEP = 60, (120, 160), 40, 1
CONFIG = MotionMaskConfig(
    working_size_px=160, smoothing_px=6, background_smoothing_px=3, depth_edge_px=5, grow_px=0,
    background_baselines=(4, 12, 48),
)  # fmt: skip


def plain_square() -> tuple[ComparedVideo, np.ndarray]:
    """A square without texture before a wall that has little, seen by a camera that stands.

    Within the baselines of the first look it moves by less than its side: but for its tracks it looks as if it stood.
    """
    rng = np.random.default_rng(0)
    wall = 120 + rng.normal(0, 2, (*SIZE, 1)) * np.ones(3)
    images, masks = np.empty((FRAMES, *SIZE, 3), np.uint8), np.zeros((FRAMES, *SIZE), bool)
    for frame in range(FRAMES):
        left = 20 + STEP * frame
        masks[frame, 40 : 40 + SIDE, left : left + SIDE] = True
        noise = rng.normal(0, 1, (*SIZE, 3))
        images[frame] = np.clip(np.where(masks[frame][..., None], (60, 60, 140), wall) + noise, 0, 255)
    column, row = np.meshgrid(np.arange(22.0, 60, 6), np.arange(42.0, 80, 6))
    uv = np.repeat(np.stack([column, row], axis=-1).reshape(-1, 1, 2), FRAMES, axis=1)
    uv[..., 0] += STEP * np.arange(FRAMES)
    tracks = Tracks(uv.astype(np.float32), np.ones(uv.shape[:2], bool), np.zeros(len(uv), np.int32))
    moving = np.ones(len(uv), bool)
    camera = CameraModel(np.array([150.0, 150.0, 79.5, 59.5]))
    cameras = Cameras(np.tile(np.eye(4), (FRAMES, 1, 1)), camera.intrinsics, np.zeros(FRAMES))
    video = Video("square", ArrayFrames(images), SIZE, np.arange(FRAMES) / 30)
    depths = ArrayFrames(np.full((FRAMES, *SIZE), 2.0, np.float32))
    motion = TrackMotion(moving, ~moving, np.full(len(uv), 9.0))
    return ComparedVideo(video, depths, tracks, motion, cameras, camera, False), masks


def never() -> bool:
    return False


def test_a_plain_thing_differs_from_the_background_where_it_looks_as_if_it_stood() -> None:
    given, masks = plain_square()
    first = list(first_look(given, CONFIG, never))
    frame = 8  # 48 frames later it is elsewhere
    inside = np.s_[50:70, 20 + STEP * frame + 16 : 20 + STEP * frame + SIDE - 16]
    beside = np.s_[50:70, 130:150]
    neighbors = NeighborComparison(given, CONFIG.model_copy(update={"track_weight": 0.0}))
    of_neighbors = list(neighbors.of_frames(neighbors.evidence, never))[frame].log_odds
    background = BackgroundComparison(given, CONFIG.model_copy(update={"background_track_weight": 0.0}), first)
    of_background = list(background.of_frames(background.evidence, never))[frame].log_odds
    assert of_neighbors[inside].mean() < 1
    assert of_background[inside].mean() > 3
    # Flat as it is, the wall is seen to be what it is elsewhere in time; its neighbors could not tell.
    assert abs(of_neighbors[beside].mean()) < 0.3
    assert of_background[beside].mean() < -2
    second = list(second_look(given, CONFIG, first, never))
    found = [moving.masks.any(axis=0) for moving in detections(given, CONFIG, second)]
    overlaps = [(a & b).sum() / (a | b).sum() for a, b in zip(found, masks, strict=True)]
    assert np.mean(overlaps) > 0.9
    assert min(overlaps) > 0.75


def test_where_no_frame_shows_the_background_the_first_look_has_its_say() -> None:
    given, _ = plain_square()
    half = np.zeros(SIZE, bool)
    half[:, :80] = True
    everywhere = [PackedMask.of(half)] * FRAMES
    config = CONFIG.model_copy(update={"background_track_weight": 0.0, "background_margin_px": 0})
    comparison = BackgroundComparison(given, config, everywhere)
    evidence, weight = list(comparison.of_frames(comparison.evidence, never))[15]
    np.testing.assert_allclose(evidence[:, :75], config.threshold + 0.75)
    np.testing.assert_allclose(weight[:, :75], 0.3)
    assert evidence[10:30, 90:150].mean() < -2
    np.testing.assert_allclose(weight[10:30, 90:150], 1.0)
