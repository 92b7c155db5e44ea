"""The whole configuration of a run."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.adam import AdamConfig
from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.cues import InputConfig, LabelConfig, TrackingConfig
from uni4d_fg.config.geometric_depth import AffineDepthConfig, GeometricDepthConfig
from uni4d_fg.config.incremental import IncrementalConfig
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.config.stages import BundleAdjustmentConfig, CameraInitConfig, FusionConfig, NonRigidConfig
from uni4d_fg.config.windows import WindowsConfig


class OutputConfig(Section):
    """What a run writes besides the reconstruction and its summary."""

    clouds: bool = setting(True, "Write the static and per-frame dynamic PLY files.")
    pictures: bool = setting(True, "Write the trajectory plot, the depth strip and the rendered views.")


class Config(Section):
    """Everything a run depends on besides its input; saved beside every result."""

    normalization: Literal["mean", "sum"] = setting(
        "mean",
        "Weights of the exact energy and of 'paper' solves. 'mean': per-frame means, then the mean over frames "
        "(the reference program); 'sum': plain sums (the paper's text).",
    )
    energy: Literal["map", "unsquared"] = setting(
        "map",
        "'map': squared, robust terms with calibrated sigmas; 'unsquared': the paper's norms and weights, "
        "smoothed and annealed.",
    )
    solver: Literal["lm", "adam"] = setting(
        "lm",
        "Minimiser of every stage: 'lm' is Levenberg-Marquardt; 'adam' is the first-order baseline, which needs "
        "PyTorch and is made for the preset 'paper'.",
    )
    backend: Literal["auto", "cpp", "python", "gtsam"] = setting(
        "auto",
        "Implementation of 'lm': 'cpp' is the extension in cpp_factors/, 'python' is NumPy, 'auto' the first of "
        "these that is installed; 'gtsam' is a GTSAM factor graph, slow, for comparison.",
    )
    input: InputConfig = setting(InputConfig(), "Use of what the sequence brings.")
    tracking: TrackingConfig = setting(TrackingConfig(), "Built-in tracker.")
    labels: LabelConfig = setting(LabelConfig(), "Track labels.")
    camera_init: CameraInitConfig = setting(CameraInitConfig(), "Stage 1.")
    bundle_adjustment: BundleAdjustmentConfig = setting(BundleAdjustmentConfig(), "Stage 2.")
    nonrigid: NonRigidConfig = setting(NonRigidConfig(), "Stage 3.")
    adam: AdamConfig = setting(AdamConfig(), "The Adam solver; not used by 'lm'.")
    windows: WindowsConfig = setting(WindowsConfig(), "Reconstruction in windows.")
    incremental: IncrementalConfig = setting(IncrementalConfig(), "Incremental solving; not used by 'reconstruct'.")
    fusion: FusionConfig = setting(FusionConfig(), "Fusion.")
    networks: NetworkConfig = setting(NetworkConfig(), "Networks that make cues.")
    geometric_depth: GeometricDepthConfig = setting(GeometricDepthConfig(), "Depth from camera motion alone.")
    affine_depth: AffineDepthConfig = setting(AffineDepthConfig(), "Scale and shift of relative depth networks.")
    motion_masks: MotionMaskConfig = setting(MotionMaskConfig(), "Masks from motion alone, and instances over time.")
    output: OutputConfig = setting(OutputConfig(), "Output.")
