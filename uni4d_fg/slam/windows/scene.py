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
from uni4d_fg.factors.priors import log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.optim.cluster_robust import Spread, curvature_batch, gradient_spread
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.marginalization import determined_points
from uni4d_fg.optim.marginals import reduced_hessian
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.stages.acceleration import AccelerationPrior
from uni4d_fg.slam.stages.bundle_adjustment import (
    Freedom,
    bundle_adjustment_problem,
    without_camera_motion,
)
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise
from uni4d_fg.slam.stages.static_covariance import static_marginals, track_cells
from uni4d_fg.slam.stages.static_outliers import landmark_errors, spatial_inliers
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver
from uni4d_fg.slam.stages.structure import refine_structure, relift_structure
from uni4d_fg.slam.windows.information import FRAME, SHARED, Uncertainty, WindowInformation
from uni4d_fg.slam.windows.numbered import NumberedRunner
from uni4d_fg.slam.windows.plan import (
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
    acceleration: AccelerationPrior | None = None
    """On its frames."""

    def state(self) -> State:
        """Return it as the variables of a solve."""
        return self.cameras.state(self.landmark, self.track)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return it as arrays for a file."""
        cameras, seen, noise = self.cameras, self.observations, self.noise
        return {
            "world_T_cam": cameras.world_T_cam, "log_scale": cameras.log_scale, "intrinsics": cameras.intrinsics,
            "landmark": self.landmark, "track": self.track, "row": seen.track, "frame": seen.frame,
            "uv": _as_measured(seen.uv), "depth": _as_measured(seen.depth), "weight": seen.weight,
            "noise": noise.array(),
            **({} if self.acceleration is None else self.acceleration.arrays()),
        }  # fmt: skip

    @classmethod
    def of_arrays(cls, window: Window, arrays: Arrays) -> WindowScene:
        """Return what :meth:`arrays` was made of."""
        return cls(
            window,
            Cameras(arrays["world_T_cam"], arrays["intrinsics"], arrays["log_scale"]),
            arrays["landmark"],
            arrays["track"],
            Observations(
                arrays["row"],
                arrays["frame"],
                arrays["uv"].astype(np.float64, copy=False),
                arrays["depth"].astype(np.float64, copy=False),
                arrays["weight"],
            ),
            StaticNoise.of_array(arrays["noise"]),
            AccelerationPrior.of_arrays(arrays),
        )


def _as_measured(values: FloatArray) -> FloatArray | Float32Array:
    """Return values in single precision if that is what they came in: half the bytes, without time to compress them."""
    single: Float32Array = values.astype(np.float32)
    return single if np.array_equal(single, values, equal_nan=True) else values


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
    frames: IntArray | None = None,
    timestamps: FloatArray | None = None,
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
        frames: (F,) numbers of its frames in the video, where they do not follow each other.
        timestamps: (T,) s of the whole video, for the prior on acceleration; frame numbers when None.

    Returns:
        The scene, the solves, and how much was dropped, per reason.

    Raises:
        DegenerateProblemError: If the cues do not determine the window's cameras.
        SolverError: If a system is singular or a cue is not finite.
    """
    # Landmarks and covariances are those of the joined cameras, later.
    settings = config.bundle_adjustment.model_copy(update={"structure": "keep", "covariance_cells": 0})
    run = NumberedRunner(run, window.frames if frames is None else frames, tracks.track)
    times = None if timestamps is None else timestamps[window.start : window.stop]
    settings_of_window = config.model_copy(update={"bundle_adjustment": settings})
    solver = StaticSceneSolver(settings_of_window, run, hooks, timestamps=times)
    given = None
    if initial_world_T_cam is not None:
        start = np.linalg.inv(initial_world_T_cam[window.start])
        given = start @ initial_world_T_cam[window.start : window.stop]
    try:
        found = solver.solve(
            tracks.labelled, intrinsics, prior_intrinsics,
            free_intrinsics=free_intrinsics, initial_world_T_cam=given,
        )  # fmt: skip
    except DegenerateProblemError as error:
        raise DegenerateProblemError(f"frames {window}: {error}; or use longer windows (windows.frames)") from error
    seen = found.observations
    scene = WindowScene(
        window,
        found.cameras,
        found.landmarks,
        tracks.track[found.landmark_track],
        replace(seen, track=np.searchsorted(found.landmark_track, seen.track)),
        found.noise,
        found.acceleration,
    )
    return scene, found.solves, found.dropped


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
    chosen = calibration_frames(
        TrackSpans.of(labelled), labelled.tracks.num_frames, frames, config.windows.calibration_sightings
    )
    window = Window(0, len(chosen))
    ba = without_camera_motion(config.bundle_adjustment)
    settings = config.model_copy(update={"bundle_adjustment": ba})
    scene, solves, _ = solve_scene(
        tracks_in(labelled, chosen), window, intrinsics, intrinsics, None, settings, hooks, run,
        free_intrinsics=True, frames=chosen,
    )  # fmt: skip
    problem = bundle_adjustment_problem(
        scene.state(), scene.observations, scene.noise, ba, intrinsics[None], Freedom(poses=True, intrinsics=True)
    )
    stage = Stage("bundle_adjustment", problem, ba.solver)
    marginals = static_marginals(stage, scene.state(), track_cells(scene.observations, intrinsics, ba))
    if marginals is None:
        raise DegenerateProblemError(
            "the focal length cannot be found from frames far apart: give it, with input.intrinsics 'fixed'"
        )
    return scene.cameras.intrinsics, marginals.blocks(INTRINSICS, 1)[0], solves


def place(scene: WindowScene, cameras: Cameras, config: BundleAdjustmentConfig, run: StageRunner) -> WindowScene:
    """Put a window's scene under joined cameras: its landmarks are solved again, cameras and scales frozen."""
    moved = replace(scene, cameras=cameras.part(scene.window.start, scene.window.stop))
    problem = bundle_adjustment_problem(
        moved.state(), scene.observations, scene.noise, config, cameras.intrinsics[None],
        Freedom(poses=False, intrinsics=False),
    ).fix(LOG_SCALE)  # fmt: skip
    numbered = NumberedRunner(run, scene.window.frames)
    state, _ = numbered(Stage("structure", problem, config.structure_solver), moved.state(), None)
    return replace(moved, landmark=state[LANDMARK])


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


def information(
    scene: WindowScene, windows: list[Window], index: int, config: Config, *, log_scale_priors: bool = True,
    uncertain: bool = True,
) -> WindowInformation:  # fmt: skip
    """Linearize what a window owns at its present point and eliminate its landmarks; intrinsics have no prior here.

    Args:
        scene: What the window owns.
        windows: All windows.
        index: Which of them.
        config: The whole configuration.
        log_scale_priors: Whether the priors on the frames' log-scales are among it.
        uncertain: Whether covariances will be made of it.

    Raises:
        SolverError: If a factor is not finite.
    """
    ba, given = config.bundle_adjustment, scene.cameras.intrinsics
    free_intrinsics = config.input.intrinsics == "free"
    state, count = scene.state(), len(scene.window)
    problem = bundle_adjustment_problem(
        state, scene.observations, scene.noise, ba, given[None], Freedom(poses=True, intrinsics=free_intrinsics),
        acceleration=scene.acceleration,
    )  # fmt: skip
    batches = tuple(_owned_factors(batch, middle_frames(windows, index)) for batch in problem.batches)
    batches = tuple(
        batch for batch in batches if len(batch) and (log_scale_priors or batch.factor_type is not log_scale_prior)
    )
    known = determined_points(batches, state)
    free = {**problem.free, LANDMARK: np.tile(known[:, None], (1, 3))}
    batches = tuple(_on_points(batch, known) for batch in batches)
    size = FRAME * count + SHARED
    reduced = reduced_hessian(Problem(batches, free), state, ba.solver)
    nothing = np.zeros((size, size))
    if reduced is None:
        unknown = Uncertainty(nothing, None) if uncertain else None
        return WindowInformation(scene.window, scene.cameras, nothing, np.zeros(size), unknown)
    layout, hessian, gradient = reduced
    columns, place = _frame_major(layout, count)
    both, mine = np.ix_(place, place), np.ix_(columns, columns)

    def placed(matrix: FloatArray) -> FloatArray:
        out = np.zeros((size, size))
        out[both] = matrix[mine]
        return out

    slope = np.zeros(size)
    slope[place] = gradient[columns]
    found = WindowInformation(scene.window, scene.cameras, placed(hessian), slope)
    if not uncertain:
        return found
    curved = reduced_hessian(Problem(tuple(curvature_batch(batch, state) for batch in batches), free), state, ba.solver)
    clusters = track_cells(scene.observations, given, ba)
    spread = None
    if clusters is not None:
        own = gradient_spread(batches, state, layout, clusters, LANDMARK)
        scores = np.zeros((len(own.scores), size))
        scores[:, place] = own.scores[:, columns]
        spread = Spread(scores, placed(own.rest))
    curvature = nothing if curved is None else placed(curved[1])
    return replace(found, uncertainty=Uncertainty(curvature, spread))


def _owned_factors(batch: FactorBatch, mine: BoolArray) -> FactorBatch:
    """Keep a window's factors without landmarks that are of its own frames."""
    groups = [slot.variable for slot in batch.slots]
    if LANDMARK in groups:
        return batch
    if INTRINSICS in groups:
        return batch.take(np.zeros(0, dtype=np.int64))
    middle = batch.slots[len(groups) // 2].rows
    return batch.take(np.flatnonzero(mine[middle]))


def _on_points(batch: FactorBatch, known: BoolArray) -> FactorBatch:
    rows = next((s.rows for s in batch.slots if s.variable == LANDMARK), None)
    return batch if rows is None else batch.take(np.flatnonzero(known[rows]))


def _frame_major(layout: DenseLayout, count: int) -> tuple[IntArray, IntArray]:
    """Return the free columns (m,) of a layout, and their places (m,) behind twist and log-scale of every frame."""
    place = np.zeros(layout.size, dtype=np.int64)
    start = {POSE: 0, LOG_SCALE: 6}
    for group in layout.offset:
        rows = np.arange(layout.count[group])
        first = np.full(1, FRAME * count) if group == INTRINSICS else FRAME * rows + start[group]
        place[layout.columns(group, rows)] = first[:, None] + np.arange(group.dim)
    columns = np.flatnonzero(layout.free)
    return columns, place[columns]


def finish(scene: WindowScene, cameras: Cameras, config: BundleAdjustmentConfig, run: StageRunner) -> WindowLandmarks:
    """Return a window's landmarks and scales under the final cameras, as ``bundle_adjustment.structure`` says."""
    scene = place(scene, cameras, config, run)
    # Tracks of a window's observations are rows of its landmarks.
    state, observations, noise = scene.cameras.state(scene.landmark), scene.observations, scene.noise
    solves: list[SolveSummary] = []
    if config.structure == "refine":
        numbered = NumberedRunner(run, scene.window.frames, scene.track)
        state, noise, solves = refine_structure(state, observations, noise, config, None, numbered)
    if config.structure == "relift":
        state = relift_structure(state, observations)
    landmarks = state[LANDMARK]
    keep = spatial_inliers(landmarks, config)
    world = cameras.world_T_cam[scene.window.start]
    return WindowLandmarks(
        (landmarks @ world[:3, :3].T + world[:3, 3])[keep],
        scene.track[keep],
        landmark_errors(state, observations)[keep],
        np.bincount(observations.track, minlength=len(landmarks))[keep],
        state[LOG_SCALE][:, 0],
        noise,
        solves,
        int((~keep).sum()),
    )
