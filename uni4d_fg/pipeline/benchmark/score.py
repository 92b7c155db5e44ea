"""Every score of an estimate that the truth of its video allows, by the protocols that are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.frontend.sequence.frames import ChangedFrames, no_masks
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.frontend.sequence.resize import resize_nearest
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.geometry.camera import camera_to_world, world_to_camera
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.pipeline.store import StageStore
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.points import evaluate_points
from uni4d_fg.results.evaluate.protocols.consistency import ConsistencyScore, score_consistency
from uni4d_fg.results.evaluate.protocols.depth import DEPTH_PROTOCOLS, score_depth
from uni4d_fg.results.evaluate.protocols.pose import POSE_PROTOCOLS, score_poses
from uni4d_fg.results.evaluate.protocols.tracks3d import score_tracks
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

_STILL_M = 0.002
"""A point that moves by less in the whole video is static."""
POINT_PROTOCOL = "observed, aligned by Sim(3) Umeyama of the cameras"
NO_MASKS = "all, without masks"


@dataclass(frozen=True)
class Estimate:
    """What a method says about a video; None where it says nothing."""

    world_T_cam: FloatArray | None = None
    """(T, 4, 4); NaN where there is none."""
    depths: FrameSource[Float32Array] | None = None
    """T maps of any size."""
    intrinsics: FloatArray | None = None
    """(4,), or (T, 4) where the camera zooms, px, of images of the size of ``depths``."""
    lens: Lens = PINHOLE
    log_scale: FloatArray | None = None
    """(T,) logarithm of a factor on each frame's depth, with which it agrees with the cameras; for self-consistency
    alone, as depth by the protocols is scored as it is."""
    tracks: tuple[FloatArray, BoolArray] | None = None
    """(K, T, 3) of the video's own tracks, in the camera of their frame, NaN where there is none; and (K, T) seen."""

    @property
    def has_consistency(self) -> bool:
        """Whether depth can be compared with itself: there are depth, intrinsics and the pose of every frame."""
        if self.depths is None or self.intrinsics is None or self.world_T_cam is None:
            return False
        return bool(np.isfinite(self.world_T_cam).all())


def score_estimate(
    video: Video,
    estimate: Estimate,
    dataset: str,
    pose_protocols: tuple[str, ...],
    depth_protocols: tuple[str, ...],
    masks: FrameSource[Int32Array] | None = None,
    mask_source: str = NO_MASKS,
) -> dict[str, Any]:
    """Score an estimate.

    Args:
        video: With its truth.
        estimate: Of the same frames.
        dataset: Name of the dataset, which decides on ranges.
        pose_protocols: Names.
        depth_protocols: Names.
        masks: T label maps of any size, for self-consistency; without them everything is taken for static.
        mask_source: Which pixels they call static, in words: by whose masks.

    Returns:
        By kind: 'poses' and 'depth' by protocol, 'consistency', 'tracks', 'points'; a kind that cannot be scored is not
        there. 'posed' says how many of the frames with a true pose have an estimated one, which poses are scored on.
        'regions' says whose masks parted the depth, 'masks' of 'consistency' whose masks those of the maps were.
    """
    truth = video.ground_truth
    found: dict[str, Any] = {}
    if estimate.world_T_cam is not None and truth.world_T_cam is not None:
        scores = {
            name: score_poses(POSE_PROTOCOLS[name], estimate.world_T_cam, truth.world_T_cam) for name in pose_protocols
        }
        found["poses"] = {name: score.to_dict() for name, score in scores.items() if score is not None}
        known, told = (np.isfinite(poses).all(axis=(1, 2)) for poses in (truth.world_T_cam, estimate.world_T_cam))
        found["posed"] = {"posed": int((known & told).sum()), "frames": int(known.sum())}
    if estimate.depths is not None and truth.depths is not None:
        regions = truth.masks if truth.masks is not None else video.masks
        found["depth"] = {
            name: score_depth(DEPTH_PROTOCOLS[name], dataset, estimate.depths, truth.depths, regions).to_dict()
            for name in depth_protocols
        }
        if regions is not None:
            found["regions"] = "true masks" if truth.masks is not None else "masks of the cues"
    own = _score_self(estimate, masks)
    if own is not None:
        found["consistency"] = own.to_dict() | {"masks": NO_MASKS if masks is None else mask_source}
    if estimate.tracks is not None:
        tracked = _score_tracks(video, *estimate.tracks)
        if tracked is not None:
            found["tracks"] = tracked
        points = _score_points(video, estimate.world_T_cam, *estimate.tracks)
        if points is not None:
            found["points"] = points
    return found


def estimates_of_run(folder: Path, sequence: Sequence) -> tuple[Estimate, Estimate]:
    """Return what a finished run says, and the depth that it started from, seen by the run's cameras.

    Raises:
        InputError: If the run cannot be read.
    """
    files = RunFolder(folder)
    found = load_reconstruction(files.reconstruction)
    depths = read_depth(files.depth) if files.depth.exists() else None
    cameras = found.world_T_cam, found.frame_intrinsics
    own = Estimate(cameras[0], depths, cameras[1], found.lens, tracks=_tracks_of(found, sequence))
    return own, Estimate(cameras[0], sequence.depths, cameras[1], found.lens, found.depth_log_scale)


def poses_of_stages(folder: Path) -> dict[str, FloatArray]:
    """Return the camera poses (T, 4, 4) after each stage of a run that left some, in order."""
    store = StageStore(folder / "stages")
    records = {stage: store.load(stage) for stage in ("camera_init", "bundle_adjustment", "joint")}
    return {
        stage: record.arrays["world_T_cam"]
        for stage, record in records.items()
        if record is not None and "world_T_cam" in record.arrays
    }


def _tracks_of(found: Reconstruction, sequence: Sequence) -> tuple[FloatArray, BoolArray] | None:
    """Return the points of the sequence's own tracks in the cameras, and where the run takes them to be seen."""
    tracks = sequence.tracks
    used = [rows for rows in (found.landmark_track, found.dynamic_track) if len(rows)]
    if tracks is None or not used or max(int(rows.max()) for rows in used) >= tracks.num_tracks:
        return None
    world: FloatArray = np.full((*tracks.visible.shape, 3), np.nan)
    seen: BoolArray = np.zeros(tracks.visible.shape, dtype=bool)
    world[found.landmark_track] = found.landmarks[:, None]
    seen[found.landmark_track] = tracks.visible[found.landmark_track]
    world[found.dynamic_track] = found.dynamic_points
    seen[found.dynamic_track] = found.dynamic_observed
    points = np.stack([world_to_camera(pose, world[:, t]) for t, pose in enumerate(found.world_T_cam)], axis=1)
    return points, seen & np.isfinite(points).all(axis=2)


def _score_self(estimate: Estimate, masks: FrameSource[Int32Array] | None) -> ConsistencyScore | None:
    """Score depth against itself, with label maps brought to its size; None if something of it is not there."""
    depths, poses, intrinsics = estimate.depths, estimate.world_T_cam, estimate.intrinsics
    if not estimate.has_consistency or depths is None or poses is None or intrinsics is None:
        return None
    size = depths[0].shape
    if masks is None:
        masks = no_masks(size, len(depths))
    elif masks[0].shape != size:
        masks = ChangedFrames(masks, partial(resize_nearest, size=size))
    return score_consistency(depths, masks, poses, intrinsics, lens=estimate.lens, log_scale=estimate.log_scale)


def _score_points(
    video: Video, world_T_cam: FloatArray | None, points: FloatArray, seen: BoolArray
) -> dict[str, Any] | None:
    """Return the errors of static and of moving points where they are seen, in the true world, by Sim(3) of cameras."""
    truth, true_poses = video.ground_truth.track_points, video.ground_truth.world_T_cam
    if truth is None or true_poses is None or world_T_cam is None or truth.shape != points.shape:
        return None
    if not (np.isfinite(true_poses).all() and np.isfinite(world_T_cam).all()):
        return None
    world = np.stack([camera_to_world(pose, points[:, t]) for t, pose in enumerate(world_T_cam)], axis=1)
    similarity = align_trajectories(world_T_cam, true_poses)
    known = np.isfinite(truth)
    span = np.where(known, truth, -np.inf).max(axis=1) - np.where(known, truth, np.inf).min(axis=1)
    moving: BoolArray = np.asarray((span > _STILL_M).any(axis=1))
    return {
        name: evaluate_points(world, truth, seen & rows[:, None], similarity, protocol=POINT_PROTOCOL).to_dict()
        for name, rows in (("static", ~moving), ("moving", moving))
    }


def _score_tracks(video: Video, points: FloatArray, seen: BoolArray) -> dict[str, Any] | None:
    truth, tracks = video.ground_truth, video.tracks
    if truth.track_points is None or truth.world_T_cam is None or truth.intrinsics is None or tracks is None:
        return None
    if truth.track_points.shape != points.shape:
        return None
    local = np.stack(
        [world_to_camera(pose, truth.track_points[:, t]) for t, pose in enumerate(truth.world_T_cam)], axis=1
    )
    known = np.isfinite(local).all(axis=2)
    score = score_tracks(points, seen, local, tracks.visible & known, truth.intrinsics)
    return None if score is None else score.to_dict()
