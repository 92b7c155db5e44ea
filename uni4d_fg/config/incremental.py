"""Configuration of the incremental, windowed solver."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.solver import NEAR_DAMPING, SolverConfig
from uni4d_fg.config.stages import CameraMotionConfig


class IncrementalConfig(Section):
    """Windowed solving of a video of any length. Terms, kernels and sigmas are those of stages 2 and 3."""

    smoother: Literal["window", "isam2"] = setting(
        "window",
        "Solver of the cameras. 'window': the newest keyframes, older ones marginalized; 'isam2': GTSAM's ISAM2 over "
        "all keyframes, for small problems: its memory is not bounded.",
    )
    isam2_max_keyframes: int = setting(
        60, "'isam2' ends with an error at more keyframes than this: it marginalizes none.", ge=2
    )
    isam2_relinearize_threshold: float = setting(
        1e-3, "'isam2' linearizes variables anew whose step is above this, in the units of each.", gt=0
    )
    window: int = setting(
        12, "Keyframes in the window; the oldest is marginalized when it is full.", ge=3, le=200, basic=True
    )
    keyframe_parallax: float = setting(
        0.012,
        "A frame becomes a keyframe when its tracks have moved by this part of the longer image side since the last "
        "one (median); 0 makes every frame one.",
        ge=0,
        le=1,
        basic=True,
    )
    keyframe_overlap: float = setting(
        0.6, "It also becomes one when fewer than this part of the last keyframe's tracks are left ...", ge=0, le=1
    )
    keyframe_interval: int = setting(30, "... or after this many frames in any case.", ge=1)
    min_tracks: int = setting(
        12, "A frame with fewer usable tracks is bridged: its pose comes from the camera motion prior.", ge=3
    )
    min_observations: int = setting(
        2, "Landmarks seen in fewer keyframes are not used; the depth cue holds those that are seen in few.", ge=2
    )
    camera_motion: CameraMotionConfig = setting(
        CameraMotionConfig(rotation_weight=1.0, translation_weight=500.0),
        "E_cam between keyframes that follow each other in the video.",
    )
    bridge_sigma_rad: float = setting(
        0.02, "Standard deviation of a bridged frame's rotation about constant velocity, rad per frame bridged.", gt=0
    )
    bridge_sigma_m: float = setting(
        0.02, "Standard deviation of a bridged frame's position about constant velocity, m per frame bridged.", gt=0
    )
    free_intrinsics_from: int = setting(
        3, "The focal lengths are held until the window has this many keyframes (if input.intrinsics is free).", ge=2
    )
    focal_sigma: float = setting(
        0.002,
        "The focal lengths are fixed once their marginal standard deviation is below this part of their value and a "
        "keyframe has left the window.",
        gt=0,
    )
    noise_smoothing: float = setting(
        0.1, "Part of the newest measurement of the noise in its running mean, once the window is full.", gt=0, le=1
    )
    solver: SolverConfig = setting(
        SolverConfig(max_iterations=6, relative_decrease=1e-3, initial_damping=NEAR_DAMPING),
        "Solver of the window; it starts near its minimum, where damping would only hold the focal lengths.",
    )
    pose_solver: SolverConfig = setting(
        SolverConfig(max_iterations=15, relative_decrease=1e-4), "Solver of a new frame's pose, landmarks held."
    )
    nonrigid_window: int = setting(
        10, "Frames over which moving points are solved together; at least nonrigid_lag + 2.", ge=3, le=200
    )
    nonrigid_lag: int = setting(
        5,
        "A moving point is handed over once this many later frames have been seen; less than window.",
        ge=0,
        basic=True,
    )
    nonrigid_solver: SolverConfig = setting(
        SolverConfig(max_iterations=6, relative_decrease=1e-3), "Solver of the window of moving points."
    )
    max_live_tracks: int = setting(
        3000, "Largest number of points that the built-in tracker follows.", ge=50, basic=True
    )
    checkpoint_interval: int = setting(
        20,
        "The state is written to disk every this many frames ('uni4d-fg stream'); resuming goes on from there.",
        ge=1,
    )
