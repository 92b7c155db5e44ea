"""Stages 1 and 2 of one window, what it tells the join, and its landmarks once the cameras are joined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import TANGENT_DIM, State, VariableNames
from uni4d_fg.solve.clustered import curvature_batch, gradient_spread
from uni4d_fg.solve.layout import DenseLayout
from uni4d_fg.solve.levenberg_marquardt import Hooks
from uni4d_fg.solve.marginalisation import determined_points
from uni4d_fg.solve.marginals import reduced_hessian
from uni4d_fg.solve.summary import SolveSummary
from uni4d_fg.stages.bundle_adjustment import (
    Freedom,
    StaticNoise,
    adjust_bundle,
    bundle_adjustment_stage,
    landmark_errors,
    measure_noise,
    spatial_inliers,
    static_marginals,
    structure_stage,
    track_cells,
    without_camera_motion,
)
from uni4d_fg.stages.camera_init import initialize_cameras
from uni4d_fg.stages.lifting import lift, mean_per_row
from uni4d_fg.stages.observations import Observations, observations_of, weigh_by_drift
from uni4d_fg.stages.stage import StageRunner
from uni4d_fg.tracks.model import LabelledTracks, TrackLabel
from uni4d_fg.windows.join import Cameras, WindowInformation
from uni4d_fg.windows.plan import (
    TrackSpans,
    Window,
    WindowTracks,
    calibration_frames,
    middle_frames,
    owned_range,
    tracks_in,
)

Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class WindowScene:
    """A window's static scene, in the axes of its first camera."""

    window: Window
    cameras: Cameras
    landmark: FloatArray
    """(N, 3)."""
    track: IntArray
    """(N,) number of each landmark's track in the whole video, ascending."""
    observations: Observations
    """Of these landmarks; ``track`` is the landmark's row, ``frame`` counts from the window's first."""
    noise: StaticNoise

    def state(self) -> State:
        """Return it as the variables of a solve."""
        groups = {
            "pose": self.cameras.world_T_cam,
            "intrinsics": self.cameras.intrinsics[None],
            "log_scale": self.cameras.log_scale[:, None],
            "landmark": self.landmark,
        }
        return State(groups, VariableNames(landmark_track=self.track))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return it as arrays for a file."""
        cameras, seen, noise = self.cameras, self.observations, self.noise
        return {
            "world_T_cam": cameras.world_T_cam, "log_scale": cameras.log_scale, "intrinsics": cameras.intrinsics,
            "landmark": self.landmark, "track": self.track, "row": seen.track, "frame": seen.frame, "uv": seen.uv,
            "depth": seen.depth, "weight": seen.weight,
            "noise": np.array([noise.reprojection_sigma_px, noise.depth_sigma, noise.depth_correlation]),
        }  # fmt: skip

    @classmethod
    def of_arrays(cls, window: Window, arrays: Arrays) -> WindowScene:
        """Return what :meth:`arrays` was made of."""
        return cls(
            window,
            Cameras(arrays["world_T_cam"], arrays["log_scale"], arrays["intrinsics"]),
            arrays["landmark"],
            arrays["track"],
            Observations(arrays["row"], arrays["frame"], arrays["uv"], arrays["depth"], arrays["weight"]),
            StaticNoise(*arrays["noise"].tolist()),
        )


@dataclass(frozen=True)
class WindowLandmarks:
    """Landmarks of one window under the joined cameras."""

    point: FloatArray
    """(N, 3) in the world."""
    track: IntArray
    """(N,)."""
    error: Float32Array
    """(N,) px."""
    count: IntArray
    """(N,) observations."""
    log_scale: FloatArray
    """(F,) of the window's frames."""
    noise: StaticNoise
    solves: list[SolveSummary]
    dropped: int


def solve_scene(
    tracks: WindowTracks,
    window: Window,
    intrinsics: FloatArray,
    prior_intrinsics: FloatArray,
    initial_world_T_cam: FloatArray | None,
    config: Config,
    hooks: Hooks,
    run: StageRunner,
    *,
    free_intrinsics: bool = False,
) -> tuple[WindowScene, list[SolveSummary], dict[str, int]]:
    """Run stages 1 and 2 on a window.

    Args:
        tracks: Its tracks.
        window: Its frames.
        intrinsics: (4,) where its intrinsics start.
        prior_intrinsics: (4,) the sequence's own.
        initial_world_T_cam: (T, 4, 4) of the whole video, instead of stage 1.
        config: The whole configuration.
        hooks: Progress and cancellation.
        run: What solves each declared stage.
        free_intrinsics: Whether the intrinsics move.

    Returns:
        The scene, the solves, and how much was dropped, per reason.

    Raises:
        DegenerateProblemError: If the cues do not determine the window's cameras.
        SolverError: If a system is singular or a cue is not finite.
    """
    stage, labelled = config.bundle_adjustment, tracks.labelled
    if initial_world_T_cam is None:
        first = initialize_cameras(
            labelled, intrinsics, config.camera_init,
            free_intrinsics=free_intrinsics and config.camera_init.free_intrinsics,
            unsquared=False, normalization=config.normalization, hooks=hooks, run=run,
        )  # fmt: skip
        poses, intrinsics, solves = first.world_T_cam, first.intrinsics, first.windows
    else:
        start = np.linalg.inv(initial_world_T_cam[window.start])
        poses, solves = start @ initial_world_T_cam[window.start : window.stop], []
    observations = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
    observations = weigh_by_drift(observations, labelled.tracks.query_frame, stage.drift_frames)
    # Landmarks and covariances are those of the joined cameras, later.
    settings = stage.model_copy(update={"structure": "keep", "covariance_cells": 0})
    try:
        result = adjust_bundle(
            observations, poses, intrinsics, prior_intrinsics, settings,
            Freedom(poses=True, intrinsics=free_intrinsics),
            unsquared=False, normalization=config.normalization, hooks=hooks, run=run,
        )  # fmt: skip
    except DegenerateProblemError as error:
        raise DegenerateProblemError(f"frames {window}: {error}; or use longer windows (windows.frames)") from error
    seen = result.observations
    scene = WindowScene(
        window,
        Cameras(result.world_T_cam, result.log_scale, result.intrinsics),
        result.landmarks,
        tracks.track[result.landmark_track],
        replace(seen, track=np.searchsorted(result.landmark_track, seen.track)),
        result.noise,
    )
    return scene, [*solves, *result.solves], result.dropped


def calibrate(
    labelled: LabelledTracks, intrinsics: FloatArray, frames: int, config: Config, hooks: Hooks, run: StageRunner
) -> tuple[FloatArray, FloatArray, list[SolveSummary]]:
    """Find the intrinsics from one graph of frames that lie far apart.

    A window is short, and so are its tracks: each alone would find another focal length. Frames far apart, without
    the prior on camera motion, which is made for consecutive ones, have the long baselines that show it.

    Args:
        labelled: All tracks of the video.
        intrinsics: (4,) the sequence's own.
        frames: Frames of the graph at most.
        config: The whole configuration.
        hooks: Progress and cancellation.
        run: What solves each declared stage.

    Returns:
        The intrinsics (4,), their covariance (4, 4), zero where they are held, and the solves.

    Raises:
        DegenerateProblemError: If the cues do not determine the cameras.
        SolverError: If a system is singular or a cue is not finite.
    """
    chosen = calibration_frames(TrackSpans.of(labelled), labelled.tracks.num_frames, frames)
    window = Window(0, len(chosen))
    ba = without_camera_motion(config.bundle_adjustment)
    settings = config.model_copy(update={"bundle_adjustment": ba})
    scene, solves, _ = solve_scene(
        tracks_in(labelled, chosen), window, intrinsics, intrinsics, None, settings, hooks, run, free_intrinsics=True
    )
    stage = bundle_adjustment_stage(
        scene.state(), scene.observations, scene.noise, ba, intrinsics[None], Freedom(poses=True, intrinsics=True),
        unsquared=False, normalization="mean",
    )  # fmt: skip
    marginals = static_marginals(stage, scene.state(), track_cells(scene.observations, intrinsics, ba))
    if marginals is None:
        raise DegenerateProblemError(
            "the focal length cannot be found from frames far apart: give it, with input.intrinsics 'fixed'"
        )
    return scene.cameras.intrinsics, marginals.blocks("intrinsics", 1)[0], solves


def place(scene: WindowScene, cameras: Cameras, config: BundleAdjustmentConfig, run: StageRunner) -> WindowScene:
    """Put a window's scene under joined cameras: its landmarks are solved again, cameras and scales frozen."""
    moved = replace(scene, cameras=cameras.part(scene.window))
    stage = bundle_adjustment_stage(
        moved.state(), scene.observations, scene.noise, config, cameras.intrinsics[None],
        Freedom(poses=False, intrinsics=False), unsquared=False, normalization="mean",
    )  # fmt: skip
    stage = replace(stage, free={"landmark": stage.free["landmark"]}, solver=config.structure_solver)
    state, _ = run(stage, moved.state(), None)
    return replace(moved, landmark=state["landmark"])


def owned(scene: WindowScene, spans: TrackSpans, windows: list[Window], index: int) -> WindowScene:
    """Keep the observations that a window owns, and the landmarks that these determine.

    Args:
        scene: A window's scene.
        spans: Of every track of the video.
        windows: All windows.
        index: The scene's own.
    """
    track = scene.track
    lower, upper = owned_range(spans.first[track], spans.last[track], track, windows, index)
    seen = scene.observations
    frame = seen.frame + scene.window.start
    kept = seen.select((frame >= lower[seen.track]) & (frame < upper[seen.track])).with_min_observations(2)
    rows, row = kept.rows()
    return replace(scene, landmark=scene.landmark[rows], track=track[rows], observations=replace(kept, track=row))


def information(scene: WindowScene, windows: list[Window], index: int, config: Config) -> WindowInformation:
    """Linearise what a window owns at its present point and eliminate its landmarks; intrinsics have no prior here.

    Raises:
        SolverError: If a factor is not finite.
    """
    ba, given = config.bundle_adjustment, scene.cameras.intrinsics
    free_intrinsics = config.input.intrinsics == "free"
    state, count = scene.state(), len(scene.window)
    stage = bundle_adjustment_stage(
        state, scene.observations, scene.noise, ba, given[None],
        Freedom(poses=True, intrinsics=free_intrinsics), unsquared=False, normalization="mean",
    )  # fmt: skip
    batches = tuple(_owned_factors(batch, middle_frames(windows, index)) for batch in stage.batches)
    batches = tuple(batch for batch in batches if len(batch))
    known = determined_points(batches, state)
    free = {**stage.free, "landmark": np.tile(known[:, None], (1, 3))}
    batches = tuple(_on_points(batch, known) for batch in batches)
    size = 7 * count + 4
    nothing = np.zeros((size, size))
    reduced = reduced_hessian(Problem(batches, free), state, stage.solver)
    curved = reduced_hessian(
        Problem(tuple(curvature_batch(batch, state) for batch in batches), free), state, stage.solver
    )
    if reduced is None or curved is None:
        return WindowInformation(scene.window, scene.cameras, nothing, np.zeros(size), nothing, None)
    layout, hessian, gradient = reduced
    onto = _frame_major(layout, count)
    clusters = track_cells(scene.observations, given, ba)
    spread = None
    if clusters is not None:
        spread = gradient_spread(batches, state, layout, clusters, "landmark").project(onto)
    return WindowInformation(
        scene.window, scene.cameras, onto.T @ hessian @ onto, onto.T @ gradient, onto.T @ curved[1] @ onto, spread
    )


def _owned_factors(batch: FactorBatch, mine: BoolArray) -> FactorBatch:
    """Keep a window's factors without landmarks that are of its own frames."""
    groups = [slot.group for slot in batch.slots]
    if "landmark" in groups:
        return batch
    if "intrinsics" in groups:
        return batch.take(np.zeros(0, dtype=np.int64))
    middle = batch.slots[len(groups) // 2].rows
    return batch.take(np.flatnonzero(mine[middle]))


def _on_points(batch: FactorBatch, known: BoolArray) -> FactorBatch:
    rows = next((s.rows for s in batch.slots if s.group == "landmark"), None)
    return batch if rows is None else batch.take(np.flatnonzero(known[rows]))


def _frame_major(layout: DenseLayout, count: int) -> FloatArray:
    """Return the matrix (layout.size, 7 count + 4) from twist and log-scale per frame, and intrinsics, to a layout."""
    out = np.zeros((layout.size, 7 * count + 4))
    start = {"pose": 0, "log_scale": 6}
    for group in layout.offset:
        for row in range(layout.count[group]):
            columns = layout.columns(group, np.array([row]))[0]
            first = 7 * count if group == "intrinsics" else 7 * row + start[group]
            out[columns, first + np.arange(TANGENT_DIM[group])] = layout.free[columns]
    return out


def finish(scene: WindowScene, cameras: Cameras, config: BundleAdjustmentConfig, run: StageRunner) -> WindowLandmarks:
    """Return a window's landmarks and scales under the final cameras, as ``bundle_adjustment.structure`` says."""
    scene = place(scene, cameras, config, run)
    state, observations, noise, solves = scene.state(), scene.observations, scene.noise, []
    if config.structure == "refine":
        for _ in range(2):  # as in the batch stage: the second solve uses the depth noise that the first reveals
            state, summary = run(structure_stage(state, observations, noise, config), state, None)
            solves.append(summary)
            noise = measure_noise(state, observations, noise, config)
    landmarks = state["landmark"]
    if config.structure == "relift":
        points = lift(observations, state["pose"], state["intrinsics"][0], state["log_scale"][:, 0])
        lifted = mean_per_row(points, observations.weight, observations.track, len(landmarks))
        landmarks = np.where(np.isfinite(lifted), lifted, landmarks)
    keep = spatial_inliers(landmarks, config)
    world = cameras.world_T_cam[scene.window.start]
    return WindowLandmarks(
        (landmarks @ world[:3, :3].T + world[:3, 3])[keep],
        scene.track[keep],
        landmark_errors(state.replace(landmark=landmarks), observations)[keep],
        np.bincount(observations.track, minlength=len(landmarks))[keep],
        state["log_scale"][:, 0],
        noise,
        solves,
        int((~keep).sum()),
    )
