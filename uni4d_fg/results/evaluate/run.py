"""Every score that the ground truth of a sequence allows for the results in a run folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, Int32Array
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.geometry.alignment import Similarity, align_first_pose, align_trajectories
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.consistency import ConsistencyMetrics, evaluate_consistency
from uni4d_fg.results.evaluate.depth import DepthReport, evaluate_depth
from uni4d_fg.results.evaluate.points import PointMetrics, evaluate_points
from uni4d_fg.results.evaluate.protocols.consistency import ConsistencyScore, score_consistency
from uni4d_fg.results.evaluate.rigid_objects import ObjectReport, evaluate_objects
from uni4d_fg.results.evaluate.trajectory import TrajectoryMetrics, evaluate_trajectory
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

T = TypeVar("T")

NO_GROUND_TRUTH = "no ground truth"


@dataclass(frozen=True)
class EvaluationReport:
    """Scores of one run. A part that could not be scored is None and has its reason in ``missing``."""

    sequence: str
    run_dir: str
    frames: int
    trajectory: TrajectoryMetrics | None
    poses_without_truth: int
    """Frames left out of the trajectory scores because their true pose is unknown."""
    consistency: tuple[ConsistencyMetrics, ...] | None
    """Whether the errors of the poses are as large as their covariances say; one entry per gauge. None as
    well, without a reason, where the run has no covariances."""
    depth: DepthReport | None
    """Of the run's fused depth."""
    depth_cue: DepthReport | None
    """Of the depth the run started from, for comparison."""
    self_consistency: dict[str, ConsistencyScore] | None
    """Of the ``fused`` depth, and of the ``cue`` with the scale that each frame's was given; no truth is needed.
    None, without a reason, where no static pixel is seen in two frames that follow each other."""
    landmarks: tuple[PointMetrics, ...] | None
    """One entry per alignment."""
    dynamic_points: tuple[PointMetrics, ...] | None
    """One entry per alignment and selection (observed, bridged)."""
    rigid_objects: ObjectReport | None
    """None as well, without a reason, where the run did not search for rigid objects."""
    missing: dict[str, str]
    """Part to reason, e.g. ``{"depth": "no ground truth"}``."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values; a part that is absent is ``{"missing": reason}``."""
        parts: dict[str, Any] = {
            "trajectory": self.trajectory and self.trajectory.to_dict(),
            "consistency": self.consistency and [metrics.to_dict() for metrics in self.consistency],
            "depth": self.depth and self.depth.to_dict(),
            "depth_cue": self.depth_cue and self.depth_cue.to_dict(),
            "self_consistency": self.self_consistency
            and {name: score.to_dict() for name, score in self.self_consistency.items()},
            "landmarks": self.landmarks and [metrics.to_dict() for metrics in self.landmarks],
            "dynamic_points": self.dynamic_points and [metrics.to_dict() for metrics in self.dynamic_points],
            "rigid_objects": self.rigid_objects and self.rigid_objects.to_dict(),
        }
        absent = {name: {"missing": reason} for name, reason in self.missing.items()}
        head = {"sequence": self.sequence, "run_dir": self.run_dir, "frames": self.frames}
        return {**head, **parts, **absent, "poses_without_truth": self.poses_without_truth}


class _Unavailable(Exception):
    """A part cannot be scored; the message says why."""


def evaluate_run(run_dir: str | Path, sequence: Sequence, *, max_depth_m: float = 70.0) -> EvaluationReport:
    """Score the results of a run against its sequence's ground truth.

    Args:
        run_dir: Folder with ``reconstruction.npz`` and, if depth is to be scored, ``depth.npy``.
        sequence: The sequence that was reconstructed; frames correspond by index.
        max_depth_m: Cap of the depth scores.

    Raises:
        InputError: If the run is unreadable or has another number of frames than the sequence.
    """
    folder = RunFolder(Path(run_dir))
    reconstruction = load_reconstruction(folder.reconstruction)
    if reconstruction.num_frames != sequence.num_frames:
        raise InputError(
            f"{run_dir}: has {reconstruction.num_frames} frames but sequence {sequence.name!r} has "
            f"{sequence.num_frames}; evaluate it against the sequence it was made from"
        )
    missing: dict[str, str] = {}

    def part(name: str, compute: Callable[[], T]) -> T | None:
        try:
            return compute()
        except _Unavailable as reason:
            missing[name] = str(reason)
            return None

    trajectory = part("trajectory", lambda: evaluate_trajectory(*_pose_pairs(reconstruction, sequence)))
    return EvaluationReport(
        sequence=sequence.name,
        run_dir=str(run_dir),
        frames=reconstruction.num_frames,
        trajectory=trajectory,
        poses_without_truth=reconstruction.num_frames - (0 if trajectory is None else trajectory.poses),
        consistency=part("consistency", lambda: _consistency(reconstruction, sequence)),
        depth=part("depth", lambda: _depth(folder, sequence, max_depth_m)),
        depth_cue=part("depth_cue", lambda: _depth(None, sequence, max_depth_m)),
        self_consistency=_self_consistency(reconstruction, sequence, folder),
        landmarks=part("landmarks", lambda: _landmarks(reconstruction, sequence, folder)),
        dynamic_points=part("dynamic_points", lambda: _dynamic(reconstruction, sequence, folder)),
        rigid_objects=part("rigid_objects", lambda: _objects(reconstruction, sequence)),
        missing=missing,
    )


def _pose_pairs(reconstruction: Reconstruction, sequence: Sequence) -> tuple[FloatArray, FloatArray]:
    """Return the estimated and true poses (F, 4, 4) of the F frames whose true pose is known."""
    truth, known = _true_poses(sequence)
    return reconstruction.world_T_cam[known], truth[known]


def _true_poses(sequence: Sequence) -> tuple[FloatArray, BoolArray]:
    """Return the true poses (T, 4, 4) and which of them (T,) are known."""
    truth = sequence.ground_truth.world_T_cam
    if truth is None:
        raise _Unavailable(NO_GROUND_TRUTH)
    if truth.shape != (sequence.num_frames, 4, 4):
        raise InputError(f"ground-truth poses {truth.shape} must be ({sequence.num_frames}, 4, 4)")
    known = np.asarray(np.isfinite(truth).all(axis=(1, 2)))
    if not known.any():
        raise _Unavailable("no ground truth: every true pose is unknown")
    return truth, known


def _consistency(reconstruction: Reconstruction, sequence: Sequence) -> tuple[ConsistencyMetrics, ...] | None:
    covariance = reconstruction.pose_covariance
    if covariance is None:
        return None
    truth, known = _true_poses(sequence)
    if not known[0]:
        raise _Unavailable("the true pose of the first frame, to which covariances are relative, is unknown")
    estimate = reconstruction.world_T_cam[known]
    found = [
        evaluate_consistency(estimate, truth[known], covariance[known], with_scale=with_scale)
        for with_scale in (False, True)
    ]
    metrics = tuple(one for one in found if one is not None)
    if not metrics:
        raise _Unavailable("the run's covariances are not determined")
    return metrics


def _depth(folder: RunFolder | None, sequence: Sequence, max_depth_m: float) -> DepthReport:
    """Score the depth of a run, or the depth cue where no run is given."""
    truth = sequence.ground_truth.depths
    if truth is None:
        raise _Unavailable(NO_GROUND_TRUTH)
    if folder is not None and not folder.depth.exists():
        raise _Unavailable(f"the run has no {folder.depth.name}")
    prediction = sequence.depths if folder is None else read_depth(folder.depth)
    return evaluate_depth(prediction, truth, sequence.masks, max_depth_m=max_depth_m)


def _self_consistency(
    reconstruction: Reconstruction, sequence: Sequence, folder: RunFolder
) -> dict[str, ConsistencyScore] | None:
    sources = [("cue", sequence.depths, reconstruction.depth_log_scale)]
    if folder.depth.exists():
        sources.insert(0, ("fused", read_depth(folder.depth), np.zeros(reconstruction.num_frames)))
    found = {
        name: score_consistency(
            depths, sequence.masks, reconstruction.world_T_cam, reconstruction.frame_intrinsics,
            lens=reconstruction.lens, log_scale=log_scale,
        )
        for name, depths, log_scale in sources
    }  # fmt: skip
    return {name: score for name, score in found.items() if score is not None} or None


def _true_tracks(sequence: Sequence, folder: RunFolder, used: Int32Array) -> FloatArray:
    """Return the true positions (K, T, 3) of the run's tracks."""
    truth = sequence.ground_truth.track_points
    if truth is None:
        raise _Unavailable(NO_GROUND_TRUTH)
    same = not len(used) or int(used.max()) < len(truth)
    if same and folder.labels.exists():
        query_frame = load_labels(folder.labels).tracks.query_frame
        given = None if sequence.tracks is None else sequence.tracks.query_frame
        same = given is not None and np.array_equal(query_frame, given)
    if not same:
        raise _Unavailable("no ground truth: the run's tracks are not the sequence's own")
    return truth


def _alignments(reconstruction: Reconstruction, sequence: Sequence) -> list[tuple[str, Similarity]]:
    """Return the maps to the true world that the cameras give, by name."""
    estimate, reference = _pose_pairs(reconstruction, sequence)
    return [
        ("Sim(3) Umeyama of the cameras", align_trajectories(estimate, reference)),
        ("first camera", align_first_pose(estimate[0], reference[0])),
    ]


def _landmarks(reconstruction: Reconstruction, sequence: Sequence, folder: RunFolder) -> tuple[PointMetrics, ...]:
    truth = _true_tracks(sequence, folder, reconstruction.landmark_track)[reconstruction.landmark_track]
    known: BoolArray = np.asarray(np.isfinite(truth).all(axis=2))
    count = np.maximum(known.sum(axis=1), 1)[:, None]
    mean = np.where(known[..., None], truth, 0.0).sum(axis=1) / count
    position = np.where((known.sum(axis=1) > 0)[:, None], mean, np.nan)
    return tuple(
        evaluate_points(reconstruction.landmarks, position, None, similarity, protocol=f"aligned by {name}, RMSE")
        for name, similarity in _alignments(reconstruction, sequence)
    )


def _dynamic(reconstruction: Reconstruction, sequence: Sequence, folder: RunFolder) -> tuple[PointMetrics, ...]:
    truth = _true_tracks(sequence, folder, reconstruction.dynamic_track)[reconstruction.dynamic_track]
    estimated = np.isfinite(reconstruction.dynamic_points).all(axis=2)
    observed = reconstruction.dynamic_observed
    selections = (("observed", observed), ("bridged", estimated & ~observed))
    return tuple(
        evaluate_points(
            reconstruction.dynamic_points, truth, mask, similarity, protocol=f"{what}, aligned by {name}, RMSE"
        )
        for name, similarity in _alignments(reconstruction, sequence)
        for what, mask in selections
    )


def _objects(reconstruction: Reconstruction, sequence: Sequence) -> ObjectReport | None:
    instance, reference = reconstruction.object_instance, reconstruction.object_reference
    observed, poses = reconstruction.object_observed, reconstruction.object_world_T_object
    if instance is None or reference is None or observed is None or poses is None:
        return None
    truth = sequence.ground_truth
    if truth.rigid_instance is None or truth.world_T_object is None or truth.world_T_cam is None:
        raise _Unavailable(NO_GROUND_TRUTH)
    return evaluate_objects(
        instance, reference, observed, poses, reconstruction.world_T_cam,
        truth.rigid_instance, truth.world_T_object, truth.world_T_cam,
    )  # fmt: skip
