"""Depth from camera motion alone on real frames; needs the real sequences."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.cues.geometric_depth import depth_from_motion
from uni4d_fg.frontend.sequence.model import ArrayFrames, Video
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory

STRIDE = 3


def test_kitchen_from_frames_alone(data_root: Path) -> None:
    """Every third frame at half size, with no depth, no masks and a focal length guessed 22 % too long."""
    paths = sorted((data_root / "kitchen" / "rgb").iterdir())[::STRIDE]
    frames = np.stack(
        [cv2.cvtColor(cv2.resize(cv2.imread(str(path)), (320, 240)), cv2.COLOR_BGR2RGB) for path in paths]
    )
    images = ArrayFrames(frames)
    config = load_config("default", ["tracking.grid_columns=24", "tracking.grid_rows=20", "tracking.query_interval=5"])
    tracks = track_grid(images, config.tracking)
    video = Video("kitchen", images, (240, 320), np.arange(len(frames), dtype=float))
    guess = np.array([320.0, 320.0, 159.5, 119.5])
    found = depth_from_motion(video, tracks, np.ones(tracks.num_tracks, dtype=bool), guess, config)
    assert found.has_parallax
    # The color camera's is about 525 px at full size.
    np.testing.assert_allclose(found.intrinsics[:2], 262.5, rtol=0.1)
    truth = np.load(data_root / "kitchen" / "c2w.npy")[::STRIDE]
    metrics = evaluate_trajectory(found.world_T_cam, truth)
    assert metrics.ate_m < 0.010
    assert metrics.rpe_rotation_deg is not None
    assert metrics.rpe_rotation_deg < 0.25
    # Depth against the sensor, which is not registered to the color camera, after one scale.
    depth = np.stack(list(found.depths))
    maps = sorted((data_root / "kitchen" / "depth_gt").iterdir())[::STRIDE]
    sensor = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2] for path in maps]) / 1000.0
    known = sensor > 0
    scale = np.median(sensor[known] / depth[known])
    assert np.median(np.abs(depth * scale - sensor)[known] / sensor[known]) < 0.09
