"""Configuration of the Adam solver: the optimizer of Uni4D's authors, with the numbers of their program."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.base import Section, setting


class AdamScheduleConfig(Section):
    """Step sizes and stopping of one stage."""

    max_iterations: int = setting(2000, "Largest number of iterations.", ge=1)
    pose_learning_rate: float = setting(1e-2, "Learning rate of rotation vectors (rad) and camera centers (m).", gt=0)
    intrinsics_learning_rate: float = setting(1e-4, "Learning rate of the intrinsics, px.", gt=0)
    point_learning_rate: float = setting(1e-2, "Learning rate of landmarks and dynamic points, m.", gt=0)
    log_scale_learning_rate: float = setting(1e-2, "Learning rate of the frames' depth log-scales.", gt=0)
    plateau_patience: int = setting(
        20, "Iterations without progress after which the learning rates are lowered; progress is relative.", ge=0
    )
    plateau_factor: float = setting(0.5, "Factor on the learning rates at a plateau.", gt=0, lt=1)
    plateau_threshold: float = setting(
        1e-4, "A loss below the best by this part of it is progress for the learning rates.", ge=0
    )
    min_learning_rate: float = setting(1e-4, "Learning rates are not lowered beyond this.", ge=0)
    stop_patience: int = setting(100, "Iterations without progress after which the solve stops.", ge=1)
    stop_decrease: float = setting(1e-4, "A loss below the best by this much (absolute) is progress.", ge=0)


class AdamConfig(Section):
    """The Adam solver (``solver: adam``): first-order descent on the energy of the same stages."""

    camera_init: AdamScheduleConfig = setting(
        AdamScheduleConfig(max_iterations=600, pose_learning_rate=1e-3, plateau_patience=10, stop_patience=20),
        "Every window of stage 1; each starts a new optimizer.",
    )
    bundle_adjustment: AdamScheduleConfig = setting(AdamScheduleConfig(), "Every solve of stage 2.")
    nonrigid: AdamScheduleConfig = setting(AdamScheduleConfig(max_iterations=1000, plateau_patience=10), "Stage 3.")
    amsgrad: bool = setting(True, "Use the variant of Adam whose second moment never falls.")
    reference_windows: bool = setting(
        True,
        "Windows of stage 1 as in the reference program: a new frame starts at the pose before it, and every frame "
        "moves but frame 0, so that a window is not tied to the frames before it. False takes the windows of the "
        "other solver: a start at constant velocity, the oldest frame held.",
    )
    keep_best: bool = setting(
        False, "End at the variables of the lowest loss; false ends at the last ones (the reference program)."
    )
    scale_anchor: bool = setting(
        False,
        "Keep the term that holds the scale of bundle adjustment without a depth prior. The reference program has "
        "none: descent leaves the scale about where it starts, and so stiff a term slows everything else.",
    )
    precision: Literal["float32", "float64"] = setting("float32", "Arithmetic of the descent.")
    device: Literal["cpu", "cuda", "auto"] = setting("cpu", "Where it runs; 'auto' takes a GPU if there is one.")
    deterministic: bool = setting(
        True, "Sum in a fixed order on a GPU too, which is slower; no random number is drawn in any case."
    )
