"""A run folder such as the pipeline leaves, filled from the truth of a synthetic scene with a little noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.config.load import dump_config, load_config
from uni4d_fg.files import atomic_write_json, atomic_write_text
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.geometry.se3 import retract
from uni4d_fg.results.clouds import write_clouds
from uni4d_fg.results.confidence_store import write_confidence
from uni4d_fg.results.depth_store import read_depth, write_depth
from uni4d_fg.results.fusion.clouds import dynamic_clouds, static_cloud
from uni4d_fg.results.io import save_reconstruction
from uni4d_fg.results.labels_io import save_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

SCENE = SyntheticSceneConfig(num_frames=7, width=128, height=96, focal=120.0, grid_columns=20, grid_rows=15)


def write_run(sequence_folder: Path, run_folder: Path) -> None:
    sequence, config = make_synthetic_sequence(SCENE), load_config("fast")
    write_native(sequence, sequence_folder)
    run = RunFolder(run_folder)
    assert sequence.tracks is not None
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    result = _reconstruction(sequence, labelled)
    save_labels(run.labels, labelled)
    save_reconstruction(run.reconstruction, result)
    assert sequence.ground_truth.depths is not None
    with write_depth(run.depth, sequence.num_frames, sequence.image_size) as store:
        for frame, depth in enumerate(sequence.ground_truth.depths):
            holes = depth.copy()
            holes[10:20, 30 + frame : 50] = np.nan
            store.write(frame, holes)
    with write_confidence(run.confidence, sequence.num_frames, (SCENE.height // 2, SCENE.width // 2)) as sure:
        for frame in range(sequence.num_frames):
            sure.write(np.full((SCENE.height // 2, SCENE.width // 2), 0.9 + 0.01 * frame, np.float32))
    maps = read_depth(run.depth)
    arguments = (sequence.images, maps, sequence.masks, result.intrinsics, result.world_T_cam, config.fusion)
    write_clouds(run, static_cloud(*arguments), dynamic_clouds(*arguments))
    atomic_write_text(run.config, dump_config(config))
    atomic_write_json(run.summary, {"sequence": {"root": str(sequence_folder)}, "stages": {}})


def _reconstruction(sequence: Sequence, labelled: LabelledTracks) -> Reconstruction:
    rng = np.random.default_rng(3)
    truth = sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.intrinsics is not None
    assert truth.track_points is not None
    static = np.flatnonzero(np.isin(labelled.label, [TrackLabel.STATIC, TrackLabel.SHORT_STATIC]))
    landmarks = np.nanmean(truth.track_points[static], axis=1)
    moving = np.flatnonzero(labelled.label == TrackLabel.DYNAMIC)
    points, observed = truth.track_points[moving].copy(), labelled.weight[moving] > 0
    for track, seen in enumerate(observed):
        first, last = np.flatnonzero(seen)[[0, -1]]
        points[track, :first], points[track, last + 1 :] = np.nan, np.nan
    return Reconstruction(
        world_T_cam=retract(
            truth.world_T_cam, rng.normal(scale=[5e-4] * 3 + [2e-3] * 3, size=(sequence.num_frames, 6))
        ),
        intrinsics=truth.intrinsics,
        timestamps=sequence.timestamps,
        image_size=sequence.image_size,
        depth_log_scale=np.zeros(sequence.num_frames),
        landmarks=landmarks + rng.normal(scale=0.002, size=landmarks.shape),
        landmark_track=static.astype(np.int32),
        landmark_color=rng.integers(0, 256, landmarks.shape).astype(np.uint8),
        landmark_error=np.zeros(len(static), dtype=np.float32),
        dynamic_points=points,
        dynamic_observed=observed,
        dynamic_track=moving.astype(np.int32),
        dynamic_instance=labelled.instance[moving],
        dynamic_color=rng.integers(0, 256, (len(moving), 3)).astype(np.uint8),
    )
