"""Configuration of masks made from motion alone, and of instances followed over time."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting


class InstanceConfig(Section):
    """Detections of single frames joined to instances by overlap after optical-flow warping."""

    min_overlap: float = setting(
        0.2, "Least intersection over union of a warped instance and a detection of the same thing.", gt=0, le=1
    )
    max_missed_frames: int = setting(5, "An instance that is not found keeps its number for this many frames ...", ge=0)
    drawn_missed_frames: int = setting(2, "... and is drawn, moved on by its velocity, in the first of them.", ge=0)
    hidden_overlap_weight: float = setting(
        0.5,
        "Weight of the share of a detection that lies within an instance missed before, where that exceeds "
        "their intersection over union: what comes out from behind something is at first only partly seen.",
        ge=0,
        le=1,
    )
    join_parts: bool = setting(
        False, "A further detection within an instance is a part of it: for regions, which break where hidden."
    )
    min_part_overlap: float = setting(0.5, "Least share of a part that lies within its instance.", gt=0, le=1)
    max_part_gap: float = setting(
        1.0,
        "What is farther away than this, in parts of the side of a square of its area, is no part but left it.",
        ge=0,
    )
    min_apart_frames: int = setting(
        5, "Where parts are joined, things that were apart for this many frames stay so where they touch.", ge=1
    )
    min_held_part: float = setting(
        0.6, "Share of such a thing that a region must hold to be parted among several.", gt=0, le=1
    )
    min_score: float = setting(0.3, "Detections below this score are dropped.", ge=0, le=1)
    min_area_px: int = setting(64, "Detections smaller than this are dropped, px.", ge=1)
    same_class: bool = setting(False, "Only detections of an instance's own class continue it.")
    flow_size_px: int = setting(480, "Longer side of the images on which flow is computed, px.", ge=32)


class MotionMaskConfig(Section):
    """Masks of what moves, from tracks, depth and images, without a network."""

    working_size_px: int = setting(384, "Longer side at which images are compared, px.", ge=64)
    baselines: tuple[int, ...] = setting(
        (2, 6, 12), "Each frame is compared with the frames this far before and after it.", min_length=1
    )
    background_baselines: tuple[int, ...] = setting(
        (4, 12, 24),
        "For the second look each frame is compared with the background that those this far before and after it show.",
        min_length=1,
    )
    background_margin_px: int = setting(
        3, "What is nearer than this to what the first look found is no background, working px.", ge=0
    )
    background_contrast: float = setting(
        20.0, "By how much what moves differs from the background at least, as a rule, gray levels.", gt=0
    )
    background_track_weight: float = setting(2.0, "What ``track_weight`` is in the second look.", ge=0)
    background_smoothing_px: int = setting(8, "What ``smoothing_px`` is in the second look.", ge=1)
    memory: float = setting(
        0.9,
        "What the second look says of a surface is averaged over time along optical flow: each frame before and behind "
        "weighs this part of the one nearer; 0 for not.",
        ge=0,
        lt=1,
    )
    memory_contrast: float = setting(
        12.0, "A surface is followed to where its color differs by less than about this, gray levels.", gt=0
    )
    shadow_window_px: int = setting(
        15, "Side of the window in which a shadow darkens the background evenly, working px.", ge=3
    )
    deepest_shadow: float = setting(0.4, "What is darker than this part of the background is no shadow.", gt=0, le=1)
    first_guess_step: int = setting(
        5, "The first guess of what moves compares frames this far apart by the pose that most tracks agree on.", ge=1
    )
    first_guess_px: float = setting(3.0, "A track agrees with that pose if it misses by less than this, px.", gt=0)
    max_bundle_observations: int = setting(
        400, "Track observations per frame that the camera solves use, on average.", ge=50
    )
    free_intrinsics: bool = setting(True, "Estimate the focal lengths along with the cameras.")
    track_sigma_px: float = setting(
        0.7, "Standard deviation of a track's position relative to another frame, px.", gt=0
    )
    depth_sigma: float = setting(0.03, "Standard deviation of log depth within a frame.", gt=0)
    depth_edge_px: float = setting(
        25.0,
        "Depth may be displaced against color by up to half of this, px: near a depth edge, motion along the "
        "direction in which depth would explain it does not count.",
        ge=0,
    )  # fmt: skip
    track_baselines: tuple[int, ...] = setting(
        (2, 5, 10, 20), "A track is tested between frames this far apart.", min_length=1
    )
    moving_sigmas: float = setting(
        3.5,
        "A track moves if it departs from the static scene by more standard deviations than this.",
        gt=0,
        basic=True,
    )
    static_sigmas: float = setting(
        3.0, "It is static below this; between this and moving_sigmas it does not say.", gt=0
    )
    track_quantile: float = setting(
        0.8, "Quantile of a track's departures over its frame pairs that is compared with both.", gt=0, le=1
    )
    track_weight: float = setting(5.0, "Evidence of many tracks that agree, in units of log odds.", ge=0)
    intensity_sigma: float = setting(4.0, "Standard deviation of a pixel's intensity, gray levels.", gt=0)
    occlusion_margin: float = setting(
        0.1, "A point is hidden in another frame whose depth there is smaller by more than this fraction.", gt=0
    )
    smoothing_px: int = setting(16, "Radius within which evidence is shared among like colors, px.", ge=1)
    smoothing_contrast: float = setting(0.03, "Standard deviation of color (0 to 1) within one surface.", gt=0)
    threshold: float = setting(1.0, "Log odds above which a pixel moves.", basic=True)
    interpolated_threshold: float = setting(
        0.25,
        "The same where depth is interpolated between points of the static scene, until colors have their say: what "
        "masks miss is then put on what is behind it, which costs more than what they hold too much.",
    )
    min_area_fraction: float = setting(0.001, "Regions smaller than this part of the image are dropped.", ge=0, lt=1)
    max_static_fraction: float = setting(
        0.5, "Regions in which more than this share of the decided tracks is static are dropped.", ge=0, le=1
    )
    color_reach_px: int = setting(
        24, "Colors tell what moves in regions, and up to this far beyond what evidence says, working px.", ge=0
    )
    color_moving: float = setting(2.75, "What evidence exceeds this, 4 at most, has colors that move ...", gt=0)
    color_static: float = setting(-1.25, "... and what it is below this, colors that do not.", lt=0)
    color_limit: float = setting(4.0, "Log odds that colors add or take at most; 0 for not.", ge=0)
    min_frames: int = setting(5, "Instances that move in fewer frames than this are dropped.", ge=1)
    grow_px: int = setting(2, "Masks are grown by this at the end, px.", ge=0, basic=True)
    instances: InstanceConfig = setting(InstanceConfig(join_parts=True), "How regions are joined to instances.")
    camera_rounds: int = setting(
        2,
        "Cameras are solved and tracks tested this often, each time without the tracks that were found to move, where "
        "depth was given; depth from motion has cameras of its own.",
        ge=1,
    )
    first_guess_min_tracks: int = setting(12, "Frames that share fewer tracks take no part in the first guess.", ge=4)
    first_guess_max_tracks: int = setting(600, "Tracks from which the pose of the first guess is found, at most.", ge=4)
    first_guess_trials: int = setting(200, "RANSAC trials of the first guess.", ge=1)
    depthless_sigma: float = setting(1.5, "Standard deviation of log depth where a track has no depth.", gt=0)
    shared_min_tracks: int = setting(
        30,
        "What the tracks of a pair of frames share (an error of its cameras) is fitted to at least this many ...",
        ge=6,
    )
    shared_max_tracks: int = setting(800, "... and at most this many tracks.", ge=6)
    shared_prior: float = setting(
        1e-3, "Weight that holds this fit at zero, as a part of the weight of the tracks.", gt=0
    )
    blur_px: float = setting(1.5, "Standard deviation of the blur before images are compared, working px.", gt=0)
    patch_px: int = setting(5, "Side of the patch over which differences of color are averaged, working px.", ge=1)
    contrast_window_px: int = setting(
        15, "Side of the window whose contrast says how a moved pixel would differ, working px.", ge=3
    )
    prediction_sigma_px: float = setting(
        1.0, "Standard deviation of a predicted position apart from depth, working px.", ge=0
    )
    evidence_limits: tuple[float, float] = setting(
        (-1.0, 3.0), "Least and largest evidence of a pixel in one pair of frames, in units of log odds."
    )
    track_reach_px: float = setting(
        4.0, "How far a track's evidence reaches over the pixels around it, working px.", gt=0
    )
    behind_reach_px: int = setting(
        4,
        "Depth that was interpolated is taken from the scene around up to this far beyond where most tracks move, "
        "working px.",
        ge=0,
    )
    track_undecided: float = setting(
        0.6,
        "Undecided tracks that are added at every pixel, as a part of those that are usually around one: with more "
        "of them, single tracks say less.",
        gt=0,
    )
