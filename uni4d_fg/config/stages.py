"""Configuration of the three stages and of fusion."""

from __future__ import annotations

from typing import Literal

from pydantic import PositiveFloat

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.config.rejoin import RejoinConfig
from uni4d_fg.config.solver import KernelConfig, SolverConfig


class CameraMotionConfig(Section):
    """E_cam: relative change of successive relative motions."""

    rotation_weight: float = setting(1.0, "Weight of E_rot; 0 switches it off.", ge=0, basic=True)
    translation_weight: float = setting(1.0, "Weight of E_trans; 0 switches it off.", ge=0, basic=True)
    rotation_floor_rad: float = setting(
        2e-3,
        "Guard added to the denominator of E_rot, rad: a camera at rest has zero, not infinite, energy.",
        gt=0,
    )
    translation_floor_m: float = setting(1e-3, "Guard added to the denominator of E_trans, m.", gt=0)
    translation_axes: Literal["world", "camera"] = setting(
        "world",
        "Axes in which E_trans compares two successive motions: 'world' (the reference program), or for each motion "
        "those of the 'camera' at its end: the relative poses of the paper's text, which a steady turn leaves alone.",
    )
    norm_threshold: float = setting(
        3e-3, "Smoothing at zero of both norms (energy 'paper' only); the larger, the farther the minimum moves.", gt=0
    )


class AccelerationConfig(Section):
    """The camera's acceleration, in the time units of the timestamps (energy 'map' only)."""

    linear: PositiveFloat | Literal["auto"] | None = setting(
        "auto",
        "Standard deviation of each component of the camera's acceleration, m/s^2; 'auto' estimates it from the "
        "sequence once the noise is measured, null switches the term off.",
    )
    angular: PositiveFloat | Literal["auto"] | None = setting("auto", "The same of its angular acceleration, rad/s^2.")


class CameraInitConfig(Section):
    """Stage 1: poses by depth reprojection over a sliding window that stays attached to older frames."""

    window: int = setting(
        5, "Frames in the window; the oldest is held fixed once the window has slid.", ge=2, basic=True
    )
    max_tracks_per_pair: int = setting(
        400, "Tracks used per frame pair, spread evenly over those available; 0 uses all.", ge=0, basic=True
    )
    min_tracks_per_frame: int = setting(12, "Frames with fewer usable tracks are bridged by constant velocity.", ge=3)
    free_intrinsics: bool = setting(
        False, "Let the focal lengths move in the window solves (if input.intrinsics is free)."
    )
    focal_prior_fraction: float = setting(
        0.2, "Standard deviation of the focal lengths' prior, as a part of their value.", gt=0
    )
    aspect_prior_sigma: float = setting(
        1e-3, "Standard deviation of log(fx / fy) about the given intrinsics' own: pixels keep their shape.", gt=0
    )
    max_depth_spread: float | None = setting(
        0.025,
        "Where the depths of static points depart from frame to frame by more (a standard deviation of log depth), the "
        "cameras are found from the tracks alone, by structure from motion; null: always with the depth cue.",
        gt=0,
    )
    reprojection_sigma_px: float = setting(
        1.0, "Standard deviation of a depth reprojection residual, px.", gt=0, basic=True
    )
    kernel: KernelConfig = setting(
        KernelConfig(kind="huber", threshold=1.345),
        "Kernel of depth reprojection. Energy 'paper' takes 'norm' (the program) or, in this stage only, 'quadratic', "
        "half the squared norm (the paper's text).",
    )
    camera_motion: CameraMotionConfig = setting(
        CameraMotionConfig(rotation_weight=0.0, translation_weight=0.0), "E_cam within the window."
    )
    solver: SolverConfig = setting(
        SolverConfig(max_iterations=20, relative_decrease=1e-5), "Solver of each window.", basic=True
    )


class BundleAdjustmentConfig(Section):
    """Stage 2: poses, intrinsics, depth scales and landmarks together."""

    free_principal_point: bool = setting(False, "Free cx, cy too (if input.intrinsics is free).", basic=True)
    focal_prior_fraction: float = setting(
        0.2, "Standard deviation of the focal lengths' prior, as a part of their value.", gt=0, basic=True
    )
    aspect_prior_sigma: float = setting(
        1e-3, "Standard deviation of log(fx / fy) about the given intrinsics' own: pixels keep their shape.", gt=0
    )
    reprojection_sigma_px: float = setting(
        1.0, "Starting standard deviation of static reprojection, px.", gt=0, basic=True
    )
    depth_sigma: float = setting(0.03, "Starting standard deviation of log depth.", gt=0, basic=True)
    measure_noise: bool = setting(
        True, "Replace both by the static scene's own (median absolute deviation) after a first solve.", basic=True
    )
    reprojection_sigma_factor: float = setting(
        1.0, "Measured reprojection sigma is multiplied by this.", gt=0, basic=True
    )
    depth_correlation: float = setting(
        0.5, "Starting correlation of the log-depth errors along a track; then measured.", ge=0, le=1
    )
    depth_sigma_factor: float = setting(
        3.5,
        "The depth prior of the camera solves is this much wider than its correlation along tracks says: a cue errs "
        "alike in neighboring pixels too.",
        gt=0,
        basic=True,
    )
    first_depth_sigma: float | None = setting(
        0.07,
        "Standard deviation of the depth prior of the first solve, whose residuals tell the noise of the cue: cameras "
        "that are held loosely depart from a sound cue, which would count as its noise, and hold them no closer "
        "afterwards. null: that of depth_sigma and what widens it.",
        gt=0,
    )
    blurred_frames: float | None = setting(
        2.0,
        "Frames whose reprojection residuals are this many times those of the frames around them after the first solve "
        "weigh by what they say; null: all frames weigh alike.",
        gt=1,
    )
    track_noise_dof: float | None = setting(
        6.0,
        "Each track has a variance of its own after the first solve, from its residuals, which count for two degrees "
        "of freedom, and from a prior with this many; null: all tracks alike.",
        gt=0,
    )
    min_reprojection_sigma_px: float = setting(0.1, "Floor of the measured reprojection sigma, px.", gt=0)
    min_depth_sigma: float = setting(0.002, "Floor of the measured depth sigma.", gt=0)
    reprojection_kernel: KernelConfig = setting(KernelConfig(kind="huber", threshold=0.7), "Kernel of E_BA.")
    depth_kernel: KernelConfig = setting(KernelConfig(kind="cauchy", threshold=2.0), "Kernel of the depth prior.")
    depth_prior: bool = setting(
        True, "Use the depth prior with a log-scale per frame; without it one distance anchors the scale.", basic=True
    )
    scale_anchor_sigma: float = setting(
        1e-3, "Standard deviation of the one distance that anchors the scale where there is no depth prior, m.", gt=0
    )
    depth_scale_prior_sigma: float = setting(0.05, "Standard deviation of a frame's log-scale about zero.", gt=0)
    camera_motion: CameraMotionConfig = setting(
        CameraMotionConfig(rotation_weight=0.0, translation_weight=0.0),
        "E_cam of the paper: relative change of successive relative motions.",
    )
    acceleration: AccelerationConfig = setting(AccelerationConfig(), "E_cam of 'map'.")
    max_reprojection_px: float = setting(
        8.0, "Observations above this after the first solve are dropped, px.", gt=0, basic=True
    )
    trim_sigmas: float | None = setting(
        4.0, "Landmarks of which most observations are farther off than so many times the noise of their frames are "
        "dropped; null keeps them.", gt=0,
    )  # fmt: skip
    min_observations: int = setting(3, "Landmarks seen in fewer frames are dropped.", ge=2, basic=True)
    max_depth_ratio: float = setting(
        1.5,
        "Landmarks whose depth disagrees with the cue's median by more than this factor are dropped.",
        gt=1,
        basic=True,
    )
    outlier_quantile: float = setting(
        0.98,
        "Landmarks whose mean squared neighbor distance lies above this quantile (times outlier_factor) are dropped.",
        gt=0,
        le=1,
    )
    outlier_factor: float = setting(3.0, "Factor on that quantile.", gt=0)
    drift_frames: float = setting(
        30.0, "A track's observation this many frames from its query frame has twice the variance (tracks drift).", gt=0
    )
    rejoin: RejoinConfig = setting(RejoinConfig(), "Tracks that were lost and found again.")
    covariance_cells: int = setting(
        5,
        "Static tracks that start in the same cell, of this many along the longer image side, may err alike in any "
        "way: the covariances of the cameras allow for it; 0 takes all observations for independent.",
        ge=0,
        le=64,
    )
    max_camera_observations: int = setting(
        2_000_000,
        "Of more observations than this the camera solves of 'map' take evenly spread tracks with about as many; the "
        "other landmarks are refined with the cameras held (structure: refine). Bounds memory and time.",
        ge=100,
    )
    structure: Literal["refine", "relift", "keep"] = setting(
        "refine",
        "Landmarks after the solve. 'refine': solve them and the frames' scales once more with frozen cameras and "
        "the depth prior at its measured sigma; 'relift': mean lift of the depth cue (the reference's choice); "
        "'keep': as they are.",
    )
    solver: SolverConfig = setting(
        SolverConfig(max_iterations=30, relative_decrease=1e-3),
        "Solver; of two solves, the second starts with a damping of 1e-8 at most, as it is near its minimum.",
        basic=True,
    )
    structure_solver: SolverConfig = setting(
        SolverConfig(max_iterations=40, relative_decrease=1e-6, early_relative_decrease=1e-4, landmark_steps=12),
        "Solver of 'refine': nothing couples the landmarks but the scales.",
    )


class NonRigidConfig(Section):
    """Stage 3: one point per dynamic track and frame, cameras frozen."""

    neighbors: int = setting(6, "ARAP neighbors per track, within its own instance.", ge=0, basic=True)
    max_neighbor_ratio: float = setting(
        6.0,
        "Neighbors farther than this many times the instance's median neighbor distance are not linked.",
        gt=0,
    )
    min_observations: int = setting(3, "Dynamic tracks seen in fewer frames are dropped.", ge=1)
    min_depth_observations: int = setting(
        2, "Dynamic tracks with a depth cue in fewer frames are dropped: one wrong depth would place them alone.", ge=1
    )
    bridge_gaps: bool = setting(
        True,
        "Estimate a track's points in the frames between its first and last observation in which it is hidden.",
        basic=True,
    )
    local_scale_neighbors: int = setting(
        32,
        "The depth cue at a moving point is corrected by the frame's shift of disparity and by the median over this "
        "many nearest static observations, the less the farther they are, where that predicts better than the "
        "frame's scale; 0 always takes the frame's scale.",
        ge=0,
    )
    local_scale_samples: int = setting(
        512, "Predictions of static observations per frame and direction on which that is measured, at most.", ge=8
    )
    reprojection: bool = setting(True, "Use E_NR.")
    depth_prior: bool = setting(True, "Use the depth prior.", basic=True)
    proximal_weight: float = setting(
        0.0,
        "Energy 'paper': weight of the distance to the lifted points along their rays, in units of the lift's noise "
        "and with depth_kernel. Keeps a solver that goes to the minimum from shrinking the scene; Adam goes without.",
        ge=0,
    )
    proximal_cg_tolerance: float = setting(
        0.05,
        "Replaces solver.cg_tolerance where that term holds the modes that shrink whole objects, for which the bare "
        "energy needs a tighter one.",
        gt=0,
        lt=1,
    )
    reprojection_sigma_px: float | None = setting(
        None, "Sigma of E_NR, px; null takes the one measured on the static scene.", gt=0, basic=True
    )
    depth_sigma: float | None = setting(
        None, "Sigma of log depth; null takes the one measured on the static scene.", gt=0, basic=True
    )
    reprojection_kernel: KernelConfig = setting(KernelConfig(kind="huber", threshold=1.345), "Kernel of E_NR.")
    depth_kernel: KernelConfig = setting(KernelConfig(kind="huber", threshold=1.345), "Kernel of the depth prior.")
    smoothness_order: Literal[1, 2] = setting(2, "1: first difference (velocity); 2: second difference (acceleration).")
    smoothness_sigma_m: float = setting(
        0.004, "Sigma of the difference, m. 'default': a point's acceleration per frame^2.", gt=0, basic=True
    )
    smoothness_weight: float = setting(1.0, "Weight of temporal smoothness; 0 switches the term off.", ge=0, basic=True)
    smoothness_kernel: KernelConfig = setting(KernelConfig(kind="huber", threshold=1.345), "Its kernel.")
    arap_sigma_m: float = setting(0.01, "Sigma of the change of a neighbor distance, m.", gt=0, basic=True)
    arap_weight: float = setting(1.0, "Weight of ARAP; 0 switches the term off.", ge=0, basic=True)
    arap_kernel: KernelConfig = setting(KernelConfig(kind="huber", threshold=1.345), "Its kernel.")
    arap_mutual_pairs: Literal["once", "twice"] = setting(
        "once",
        "How often ARAP counts a pair of which each is a neighbor of the other: 'once', or 'twice' as in the reference "
        "program, which lists the neighbors of every track. All other pairs count once.",
    )
    annealing: tuple[float, ...] = setting(
        (1.0,), "Successive solves with the smoothing of every 'norm' kernel multiplied by these factors; ends at 1."
    )
    warm_up_reprojection_weight: float = setting(
        0.01,
        "A first, loose solve multiplies the weight of E_NR by this, so that a point with a wrong cue follows its "
        "neighbors and its own path before it is held to its ray; 1 leaves that solve out.",
        gt=0,
        le=1,
    )
    also_without_warm_up: bool = setting(
        True, "Solve a second time without that first solve, and keep whichever ends at the lower energy."
    )
    outlier_quantile: float = setting(
        0.98,
        "Tracks whose motion energy exceeds this quantile plus outlier_margin are dropped.",
        gt=0,
        le=1,
        basic=True,
    )
    outlier_margin: float = setting(1.0, "Added to that quantile.", ge=0)
    solver: SolverConfig = setting(
        SolverConfig(
            max_iterations=60,
            relative_decrease=1e-7,
            early_relative_decrease=1e-1,
            kernel_curvature=0.7,
            cg_tolerance=0.06,
        ),
        "Solver.",
        basic=True,
    )


class JointConfig(Section):
    """The joint energy: cameras, static and moving points free together, with the terms of stages 2 and 3."""

    enabled: bool = setting(
        False,
        "Solve the joint energy after stage 3, from where the stages ended. Off by default: it takes longer than all "
        "stages together, and its cameras are worse (docs/results.md). Not in windows.",
        basic=True,
    )
    solver: SolverConfig = setting(SolverConfig(max_iterations=30, relative_decrease=1e-4), "Solver.")


class FusionConfig(Section):
    """Dense depth that agrees with the sparse points, and the 4D cloud."""

    static: Literal["field", "nearest_points"] = setting(
        "field",
        "How static depth is made: 'field' corrects the cue by a smooth field and weighs it with depth from several "
        "views; 'nearest_points' corrects every pixel by its nearest control points alone, as what moves is.",
    )
    neighbors: int = setting(3, "Control points per pixel (nearest in 3D, of the pixel's own instance).", ge=1)
    distance_power: Literal[1, 2] = setting(
        2,
        "'nearest_points': a control point weighs by the inverse of this power of its distance: 2 (the reference "
        "program) or 1 (the paper's text).",
    )
    averaged_scale: Literal["log", "linear"] = setting(
        "log",
        "'nearest_points': 'log' averages the logarithm of the control points' scales, so that too near and too far "
        "count alike; 'linear' the scales themselves (the paper's text and the reference program).",
    )
    smoothing: int = setting(
        16,
        "Each control point's scale is the median over this many nearest control points; 1 keeps it raw.",
        ge=1,
    )
    min_control_points: int = setting(8, "With fewer, the instance's pixels get the frame's scale alone.", ge=1)
    max_scale_sigmas: float = setting(
        2.5,
        "Control scales farther than this many measured depth sigmas from the frame's log-scale are discarded.",
        gt=0,
    )
    stride: int = setting(
        4, "Scales are interpolated on a grid of this spacing and bilinearly in between, px.", ge=1, basic=True
    )
    averaged_offsets: tuple[int, ...] = setting(
        (1, 2, 4, 6, 8),
        "Static depth is averaged with that of the frames this far before and after; empty leaves it out.",
        basic=True,
    )
    averaged_sigmas: float = setting(
        2.5,
        "Static depth of two frames is averaged where its logarithms differ by less than this many measured sigmas.",
        gt=0,
    )
    multiview: MultiviewConfig = setting(MultiviewConfig(), "Depth of the static scene from several views.")
    field_windows: tuple[float, ...] = setting(
        (0.15, 0.05, 0.016),
        "The smooth error of a cue is measured over Gaussian windows of these standard deviations, parts of the width.",
    )
    field_prior: float = setting(
        0.005, "It is drawn to that of the wider window as if this part of a window agreed with it.", gt=0
    )
    broken_ratio: float = setting(
        1.8, "A frame's cue is not used if it errs this many times as much as that of the median frame ...", gt=1
    )
    broken_share: float = setting(0.6, "... and this part of what a constant depth would err by.", gt=0)
    min_broken_frames: int = setting(5, "Frames with landmarks that such a judgment takes.", ge=3)
    edge_relative_gradient: float = setting(
        0.05, "Pixels whose depth changes by more than this part per pixel are left out of the clouds.", gt=0
    )
    cloud_confidence: float = setting(
        0.8,
        "The static cloud takes pixels whose depth is right to 3 % with at least this probability, as the frames "
        "around say; 0 takes all.",
        ge=0,
        le=1,
        basic=True,
    )
    static_stride: int = setting(4, "The static cloud takes every this many pixels in x and y.", ge=1, basic=True)
    static_frame_stride: int = setting(5, "It takes every this many frames.", ge=1)
    static_voxel_m: float = setting(0.01, "Voxel size of the static cloud, m; 0 keeps every point.", ge=0, basic=True)
    dynamic_stride: int = setting(2, "The dynamic clouds take every this many pixels in x and y.", ge=1, basic=True)
