"""Small synthetic sequences, runs of them, and what every finished run must satisfy."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.trajectory_files import read_tum
from uni4d_fg.pipeline import RunSummary, reconstruct
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

SMALL = {
    "num_frames": 8, "height": 96, "width": 128, "focal": 120.0, "margin_px": 3.0,
    "grid_columns": 16, "grid_rows": 12, "query_interval": 4,
}  # fmt: skip
TINY = SMALL | {"num_frames": 6, "height": 60, "width": 80, "focal": 75.0, "grid_columns": 14, "grid_rows": 10}
NO_VIEWS = ("output.clouds=false", "output.pictures=false")


@functools.cache
def _make(items: tuple[tuple[str, Any], ...]) -> Sequence:
    return make_synthetic_sequence(SyntheticSceneConfig(render_images=False, **dict(items)))


def make_scene(size: dict[str, Any], **changes: Any) -> Sequence:
    """A synthetic sequence with flat gray images; each is made once per process."""
    return _make(tuple((size | changes).items()))


def make_config(*overrides: str, preset: str = "default") -> Config:
    """A configuration without clouds and pictures unless the overrides ask for them."""
    return load_config(preset, [*NO_VIEWS, *overrides])


def depth_of(sequence: Sequence) -> np.ndarray:
    return np.stack(list(sequence.depths))


def masks_of(sequence: Sequence) -> np.ndarray:
    return np.stack(list(sequence.masks))


def with_depth(sequence: Sequence, depth: np.ndarray) -> Sequence:
    return dataclasses.replace(sequence, depths=ArrayFrames(depth.astype(np.float32)))


def with_masks(sequence: Sequence, masks: np.ndarray) -> Sequence:
    return dataclasses.replace(sequence, masks=ArrayFrames(masks.astype(np.int32)))


def with_true_poses(sequence: Sequence) -> Sequence:
    """The sequence with its true cameras as given ones."""
    truth = sequence.ground_truth
    assert truth.world_T_cam is not None
    assert truth.intrinsics is not None
    return dataclasses.replace(sequence, initial_world_T_cam=truth.world_T_cam, intrinsics=truth.intrinsics)


def seen_only(sequence: Sequence, keep: np.ndarray) -> Sequence:
    """The sequence with observations hidden where ``keep`` (broadcast to K, T) is False."""
    tracks = sequence.tracks
    assert tracks is not None
    visible = tracks.visible & keep
    uv = np.where(visible[..., None], tracks.uv, np.float32(np.nan))
    return dataclasses.replace(sequence, tracks=Tracks(uv, visible, tracks.query_frame))


def run_sound(
    sequence: Sequence, run_dir: Path, config: Config | None = None, **options: Any
) -> tuple[RunSummary, Reconstruction]:
    """Reconstruct, check everything that was written, and return the summary and the reconstruction."""
    summary = reconstruct(sequence, run_dir, config or make_config(), **options)
    return summary, check_run(run_dir, sequence)


def check_run(run_dir: Path, sequence: Sequence) -> Reconstruction:
    """Assert what every finished run satisfies; return its reconstruction."""
    folder = RunFolder(run_dir)
    reconstruction = load_reconstruction(folder.reconstruction)
    _check_reconstruction(reconstruction, sequence)
    _check_depth(read_depth(folder.depth).array, depth_of(sequence))
    labelled = load_labels(folder.labels)
    assert labelled.tracks.num_frames == sequence.num_frames
    assert np.isfinite(labelled.weight).all()
    trajectory = read_tum(folder.trajectory)
    np.testing.assert_allclose(trajectory.world_T_cam, reconstruction.world_T_cam, atol=1e-6)
    summary = json.loads(folder.summary.read_text())
    for solve in solves_of(summary["stages"]):
        assert np.isfinite(solve["initial_energy"])
        # A start at the minimum has an energy of rounding errors alone.
        assert solve["final_energy"] <= max(solve["initial_energy"], 1e-18), solve["name"]
    assert temporary_files(run_dir) == []
    return reconstruction


def _check_reconstruction(reconstruction: Reconstruction, sequence: Sequence) -> None:
    rotation = reconstruction.world_T_cam[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (len(rotation), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-9)
    for name in ("world_T_cam", "intrinsics", "depth_log_scale", "landmarks", "landmark_error"):
        assert np.isfinite(getattr(reconstruction, name)).all(), name
    assert (reconstruction.landmark_error >= 0).all()
    np.testing.assert_array_equal(reconstruction.timestamps, sequence.timestamps)
    frame = np.arange(sequence.num_frames)
    for points, observed in zip(reconstruction.dynamic_points, reconstruction.dynamic_observed, strict=True):
        seen = frame[observed]
        finite = np.isfinite(points).all(axis=1)
        assert finite[seen].all()
        assert not finite[(frame < seen[0]) | (frame > seen[-1])].any()


def _check_depth(fused: np.ndarray, cue: np.ndarray) -> None:
    known = np.isfinite(cue) & (cue > 0)
    np.testing.assert_array_equal(np.isfinite(fused), known)
    assert (fused[known] > 0).all()


def solves_of(stages: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    return [solve for stage in stages.values() for solve in stage.get("solves", [])]


def resumed_stages(summary: RunSummary) -> dict[str, bool]:
    """Which stages were taken over, without the output, which is always written anew."""
    return {name: stage["resumed"] for name, stage in summary.stages.items() if name != "output"}


def temporary_files(run_dir: Path) -> list[str]:
    return sorted(str(path.relative_to(run_dir)) for path in run_dir.rglob(".tmp-*"))


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as stored:
        return {name: stored[name] for name in stored.files}


def assert_same_result(run_dir: Path, expected: Path) -> None:
    """Assert that two runs hold the same reconstruction and fused depth, bit by bit."""
    found, wanted = (arrays_of(RunFolder(root).reconstruction) for root in (run_dir, expected))
    assert found.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    assert RunFolder(run_dir).depth.read_bytes() == RunFolder(expected).depth.read_bytes()


def stop_at(poll: int) -> Callable[[], bool]:
    """A ``should_stop`` that turns true at its ``poll``-th question and stays so."""
    asked = 0

    def should_stop() -> bool:
        nonlocal asked
        asked += 1
        return asked >= poll

    return should_stop
