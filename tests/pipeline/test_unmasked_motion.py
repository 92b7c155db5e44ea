"""Something moves and no mask says so: the run warns; with masks, or with nothing that moves, it does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import make_config, make_scene, with_masks

from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel, Tracks
from uni4d_fg.geometry.camera import project
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.dropped_tracks import dropped_tracks
from uni4d_fg.pipeline.warnings import unmasked_motion_warnings

pytest.importorskip("open3d")

SCENE = {
    "num_frames": 12, "height": 120, "width": 160, "focal": 150.0, "margin_px": 3.0,
    "grid_columns": 16, "grid_rows": 12, "query_interval": 6,
}  # fmt: skip
SAID = "of the static tracks lie together and fit no static world"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("objects", "masked", "warns"), [("both", False, True), ("both", True, False), ("none", False, False)]
)
def test_a_run_without_masks(objects: str, masked: bool, warns: bool, tmp_path: Path) -> None:
    scene = make_scene(SCENE, objects=objects)
    if not masked:
        scene = with_masks(scene, np.zeros((12, 120, 160), np.int32))
    summary = reconstruct(scene, tmp_path, make_config())
    assert any(SAID in warning for warning in summary.warnings) == warns


def tracks(uv: np.ndarray, label: TrackLabel) -> LabelledTracks:
    count = len(uv)
    seen = Tracks(np.repeat(uv[:, None], 3, axis=1), np.ones((count, 3), bool), np.zeros(count, np.int32))
    labels = np.full(count, int(label), np.int32)
    one = np.ones((count, 3), np.float32)
    return LabelledTracks(seen, labels, np.zeros(count, np.int32), one, one)


def none_dropped() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(0, np.int64), np.zeros(0)


def test_only_tracks_that_lie_together_count() -> None:
    """A twentieth of 400 tracks fits badly: in one corner, or anywhere; by 6 px, or by 2 px of 320."""
    rng = np.random.default_rng(0)
    uv = rng.uniform(0, 320, (400, 2)).astype(np.float32)
    corner = np.argsort(uv.sum(axis=1))[:20]
    everywhere = rng.permutation(400)[:20]
    static = tracks(uv, TrackLabel.STATIC)
    for bad, px, labelled, count in (
        (corner, 6.0, static, 1),
        (everywhere, 6.0, static, 0),
        (corner, 2.0, static, 0),
        (corner, 6.0, tracks(uv, TrackLabel.DYNAMIC), 0),
    ):
        error = np.full(400, 0.5, np.float32)
        error[bad] = px
        assert len(unmasked_motion_warnings(labelled, np.arange(400), error, 0.4, 320, none_dropped)) == count
        # As well where bundle adjustment dropped them.
        good = np.setdiff1d(np.arange(400), bad)
        dropped = (bad, error[bad].astype(np.float64))
        found = unmasked_motion_warnings(labelled, good, error[good], 0.4, 320, lambda dropped=dropped: dropped)
        assert len(found) == count


def test_dropped_tracks_that_move_fit_no_world_and_others_do() -> None:
    """Of 40 tracks half are no landmarks, and half of these move."""
    rng = np.random.default_rng(1)
    intrinsics = np.array([150.0, 150.0, 79.5, 59.5])
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 1.0, 6)
    points = rng.uniform((-1.0, -0.8, 3.0), (1.5, 0.8, 5.0), (40, 3))
    at = np.repeat(points[:, None], 6, axis=1)
    at[30:, :, 1] += 0.3 * np.linspace(0.0, 1.0, 6) ** 2
    uv = project(intrinsics, at - poses[:, :3, 3])
    seen = Tracks(uv.astype(np.float32), np.ones((40, 6), bool), np.zeros(40, np.int32))
    labels = np.full(40, int(TrackLabel.STATIC), np.int32)
    one = np.ones((40, 6), np.float32)
    labelled = LabelledTracks(seen, labels, np.zeros(40, np.int32), one, one)
    scene = {"landmark_track": np.arange(20), "world_T_cam": poses, "intrinsics": intrinsics}
    track, error = dropped_tracks(labelled, scene)
    np.testing.assert_array_equal(track, np.arange(20, 40))
    assert error[:10].max() < 1e-3
    assert error[10:].min() > 0.5
    track, error = dropped_tracks(labelled, {**scene, "landmark_track": np.arange(40)})
    assert len(track) == len(error) == 0
