"""Configuration of depth without a metric depth cue: from camera motion, or from a network's relative depth."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.solver import KernelConfig


class GeometricDepthConfig(Section):
    """Up-to-scale structure from motion, and depth maps interpolated from it."""

    median_depth: float = setting(
        2.0,
        "The median depth of the first frame's points is made this long: the unit of the whole result.",
        gt=0,
        basic=True,
    )
    max_tracks: int = setting(
        3000, "Tracks used to find the cameras, spread over frames and image; all are triangulated afterwards.", ge=50
    )
    min_parallax_px: float = setting(
        2.0,
        "Below this much motion (median, px) that no rotation explains in any pair of frames, depth cannot be "
        "seen, and constant depth is returned with a warning.",
        gt=0,
    )
    start_parallax_px: float = setting(
        30.0, "The two frames to start from have this much parallax where tracks allow: more of it counts no more.",
        gt=0,
    )  # fmt: skip
    min_common_tracks: int = setting(30, "Tracks that the two frames to start from must share.", ge=8)
    max_reprojection_px: float = setting(
        3.0, "A track agrees with a model (two views, pose, point) up to this distance, px.", gt=0
    )
    min_pose_points: int = setting(15, "A frame in which fewer points agree with its pose is bridged instead.", ge=6)
    min_angle_deg: float = setting(
        0.5, "Points whose rays meet at less than this do not take part in finding cameras, degrees.", gt=0, lt=90
    )
    min_angle_px: float = setting(
        1.5, "Where no cameras are found so, points whose rays meet at what so many pixels subtend take part: somebody "
        "who stands and holds a camera in their hands moves it by little. Where a camera pans they do from the "
        "beginning.", gt=0,
    )  # fmt: skip
    growth: float = setting(
        1.3, "Bundle adjustment is repeated whenever the number of frames has grown by this factor.", gt=1
    )
    focal_starts: tuple[float, ...] = setting(
        (1.0, 0.75, 1.4),
        "Starting focal lengths to try on the first frames, as parts of the given one (one that is to be kept is "
        "not varied), beside what pairs of frames tell of it; the one that explains the tracks best is taken.",
        min_length=1,
    )
    max_relative_sigma: float = setting(
        0.2, "Points whose inverse depth has a larger standard deviation than this part of the frame's median are "
        "not interpolated.", gt=0,
    )  # fmt: skip
    depth_prior: bool = setting(
        False, "Bundle adjustment takes depth from motion for a depth cue like any other. Windows always do."
    )
    max_depth_ratio: float = setting(
        10.0, "Depth beyond this many times the frame's median is cut there: parallax does not see so far.", gt=1
    )
    stride: int = setting(4, "Depth is interpolated on a grid of this spacing and bilinearly in between, px.", ge=1)
    contact_fraction: float = setting(
        0.05, "The lowest part of a mask, as a fraction of its height, is where a moving thing touches the ground.",
        gt=0, le=1,
    )  # fmt: skip
    contact_smoothing: int = setting(
        9, "The depth at which a moving thing stands is the nearer quartile over this many frames.", ge=1
    )
    moving_depth_sigma: float = setting(
        0.15, "Standard deviation of the log depth of moving things, known only from where they stand.", gt=0
    )
    sampled_frames: int = setting(20, "The two frames to start from are among this many, evenly spaced.", ge=2)
    fitted_tracks: int = setting(250, "Tracks of a pair of frames on which its parallax is measured, at most.", ge=8)
    enough_tracks: int = setting(300, "More common tracks than this make a pair of frames no better.", ge=8)
    tried_pairs: int = setting(4, "Pairs of frames to start from that compete, the best first.", ge=1)
    trial_frames: int = setting(24, "Frames around such a pair that a trial poses, at most.", ge=2)
    trial_step: int = setting(8, "Frames of a trial from one of the pair to the other.", ge=1)
    trial_tracks: int = setting(800, "Tracks of a trial, spread over its frames and the image.", ge=50)
    held_out_every: int = setting(
        4, "Every so many observations of a track, one is kept from a trial, which is judged by those.", ge=2
    )
    usual_focal: tuple[float, float] = setting(
        (0.4, 3.0), "Starts that end with a focal length outside this range, as parts of the longer image side, are "
        "taken only where no other explains the tracks.",
    )  # fmt: skip
    focal_log_sigma: float = setting(
        0.3, "Where the tracks leave the focal length open it is weighed with the given one, or the longer image side: "
        "standard deviation of its log about that.", gt=0,
    )  # fmt: skip
    retries: int = setting(1, "How often frames that fit badly are taken out and posed again.", ge=0)
    trim_sigmas: float = setting(
        2.5, "Cameras are refined from the tracks of which most observations agree within this many times the noise "
        "of those that agree, at most max_reprojection_px.", gt=0,
    )  # fmt: skip
    stage_trim_sigmas: float = setting(
        3.0, "Takes the place of bundle_adjustment.trim_sigmas where the intrinsics are from camera motion.", gt=0
    )
    focal_kernel: KernelConfig = setting(
        KernelConfig(kind="cauchy", threshold=1.0), "Kernel of reprojection in the refinement that finds focal lengths."
    )
    min_trim_px: float = setting(0.3, "The least such limit, px.", gt=0)
    trim_rounds: int = setting(12, "How often the limit is lowered and cameras are refined, at most; 0 keeps it.", ge=0)
    epipolar_px: float = setting(
        1.0, "A track agrees with the epipolar geometry of most of the picture up to this distance, px.", gt=0
    )
    epipolar_steps: tuple[int, ...] = setting(
        (3, 6), "That geometry is found between frames this far apart.", min_length=1
    )
    epipolar_per_cell: int = setting(6, "Tracks from each of 108 parts of the picture that it is found from.", ge=1)
    two_view_trials: int = setting(5000, "Trials of the robust essential matrix of two frames, at most.", ge=1)
    resection_trials: int = setting(500, "RANSAC trials of a frame's pose from the points it sees.", ge=1)
    focal_min_frames: int = setting(
        3, "The focal lengths are free from this many posed frames on: two do not determine them robustly.", ge=2
    )
    triangulation_huber_px: float = setting(1.0, "Threshold of Huber's kernel in triangulation, px.", gt=0)
    support_neighbors: int = setting(
        8, "A point is interpolated only if it is like some of this many nearest points of the frame: ...", ge=1
    )
    min_supporters: int = setting(2, "... at least this many, ...", ge=0)
    support_ratio: float = setting(1.25, "... whose depth differs from its own by less than this factor.", gt=1)
    min_interpolated_points: int = setting(
        3, "A frame with fewer points takes those of the nearest frame that has enough.", ge=1
    )


class AffineDepthConfig(Section):
    """Scale and shift of every frame of a relative depth network, from points of known depth."""

    kernel_threshold: float = setting(2.0, "Residuals above this many measured sigmas count less.", gt=0)
    max_iterations: int = setting(30, "Largest number of reweighted solves, twice.", ge=1)
    min_points: int = setting(8, "A frame with fewer points has no say of its own and follows its neighbors.", ge=2)
    temporal_sigma: float = setting(
        0.1, "Aligned inverse depth changes from frame to frame by about this part through scale and shift alone.",
        gt=0,
    )  # fmt: skip
    max_depth_ratio: float = setting(
        10.0, "Depth beyond this many times the frame's median is cut there, so that none is negative.", gt=1
    )
    probe_quantiles: tuple[float, ...] = setting(
        (0.1, 0.5, 0.9), "Quantiles of the network's values at which that change is measured.", min_length=1
    )
    min_sigma: float = setting(1e-3, "Floor of the measured noise, as a part of the median inverse depth.", gt=0)
