"""Configuration of depth without a metric depth cue: from camera motion, or from a network's relative depth."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting


class GeometricDepthConfig(Section):
    """Up-to-scale structure from motion, and depth maps interpolated from it."""

    median_depth: float = setting(
        2.0, "The median depth of the first frame's points is made this long: the unit of the whole result.", gt=0
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
        1.0, "Points whose rays meet at less than this do not take part in finding cameras, degrees.", gt=0, lt=90
    )
    growth: float = setting(
        1.3, "Bundle adjustment is repeated whenever the number of frames has grown by this factor.", gt=1
    )
    focal_starts: tuple[float, ...] = setting(
        (1.0, 0.75, 1.4),
        "Starting focal lengths to try on the first frames, as parts of the given one (one that is to be kept is "
        "not varied); the one that ends with the least reprojection error is taken.",
        min_length=1,
    )
    max_relative_sigma: float = setting(
        0.2, "Points whose inverse depth has a larger standard deviation than this part of the frame's median are "
        "not interpolated.", gt=0,
    )  # fmt: skip
    max_depth_ratio: float = setting(
        10.0, "Depth beyond this many times the frame's median is cut there: parallax does not see so far.", gt=1
    )
    stride: int = setting(4, "Depth is interpolated on a grid of this spacing and bilinearly in between, px.", ge=1)
    contact_fraction: float = setting(
        0.05, "The lowest part of a mask, as a fraction of its height, is where a moving thing touches the ground.",
        gt=0, le=1,
    )  # fmt: skip
    contact_smoothing: int = setting(
        9, "The depth at which a moving thing stands is the median over this many frames.", ge=1
    )
    moving_depth_sigma: float = setting(
        0.15, "Standard deviation of the log depth of moving things, known only from where they stand.", gt=0
    )


class AffineDepthConfig(Section):
    """Scale and shift of every frame of a relative depth network, from points of known depth."""

    kernel_threshold: float = setting(2.0, "Residuals above this many measured sigmas count less.", gt=0)
    max_iterations: int = setting(30, "Largest number of reweighted solves, twice.", ge=1)
    min_points: int = setting(8, "A frame with fewer points has no say of its own and follows its neighbours.", ge=2)
    temporal_sigma: float = setting(
        0.1, "Aligned inverse depth changes from frame to frame by about this part through scale and shift alone.",
        gt=0,
    )  # fmt: skip
    max_depth_ratio: float = setting(
        10.0, "Depth beyond this many times the frame's median is cut there, so that none is negative.", gt=1
    )
