"""The whole configuration of a run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from pydantic import model_validator

from uni4d_fg.config.adam import AdamConfig
from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.camera import CameraConfig
from uni4d_fg.config.cues import InputConfig, LabelConfig, TrackingConfig
from uni4d_fg.config.geometric_depth import AffineDepthConfig, GeometricDepthConfig
from uni4d_fg.config.imu import ImuConfig
from uni4d_fg.config.incremental import IncrementalConfig
from uni4d_fg.config.loops import LoopsConfig
from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.config.rigid_objects import RigidObjectsConfig
from uni4d_fg.config.shots import ShotsConfig
from uni4d_fg.config.stages import BundleAdjustmentConfig, CameraInitConfig, FusionConfig, JointConfig, NonRigidConfig
from uni4d_fg.config.windows import WindowsConfig


class OutputConfig(Section):
    """What a run writes besides the reconstruction and its summary."""

    clouds: bool = setting(True, "Write the static and per-frame dynamic PLY files.", basic=True)
    pictures: bool = setting(True, "Write the trajectory plot, the depth strip and the rendered views.", basic=True)


class Config(Section):
    """Everything a run depends on besides its input; saved beside every result."""

    normalization: Literal["mean", "sum"] = setting(
        "mean",
        "Weights of the exact energy and of 'paper' solves. 'mean': per-frame means, then the mean over frames "
        "(the reference program); 'sum': plain sums (the paper's text).",
    )
    energy: Literal["map", "paper"] = setting(
        "map",
        "'map': squared, robust terms with calibrated sigmas; 'paper': the paper's unsquared norms and weights, "
        "smoothed and annealed.",
        basic=True,
    )
    solver: Literal["lm", "adam"] = setting(
        "lm",
        "Minimizer of every stage: 'lm' is Levenberg-Marquardt; 'adam' is the first-order baseline, which needs "
        "PyTorch and is made for the preset 'paper'.",
        basic=True,
    )
    backend: Literal["auto", "cpp", "python", "gtsam"] = setting(
        "auto",
        "Implementation of 'lm': 'cpp' is the extension in cpp_factors/, 'python' is NumPy, 'auto' the first of "
        "these that is installed; 'gtsam' is a GTSAM factor graph, slow, for comparison.",
        basic=True,
    )
    input: InputConfig = setting(InputConfig(), "Use of what the sequence brings.", basic=True)
    shots: ShotsConfig = setting(ShotsConfig(), "Cuts of an edited video.", basic=True)
    camera: CameraConfig = setting(CameraConfig(), "Camera model.", basic=True)
    tracking: TrackingConfig = setting(TrackingConfig(), "Built-in tracker.", basic=True)
    labels: LabelConfig = setting(LabelConfig(), "Track labels.", basic=True)
    camera_init: CameraInitConfig = setting(CameraInitConfig(), "Stage 1.", basic=True)
    bundle_adjustment: BundleAdjustmentConfig = setting(BundleAdjustmentConfig(), "Stage 2.", basic=True)
    nonrigid: NonRigidConfig = setting(NonRigidConfig(), "Stage 3.", basic=True)
    rigid_objects: RigidObjectsConfig = setting(
        RigidObjectsConfig(), "Search for moving instances that are rigid bodies, and their poses.", basic=True
    )
    imu: ImuConfig = setting(ImuConfig(), "Inertial measurements in stage 2, where an IMU is given.", basic=True)
    joint: JointConfig = setting(JointConfig(), "Cameras and moving points in one solve, after stage 3.", basic=True)
    adam: AdamConfig = setting(AdamConfig(), "The Adam solver; not used by 'lm'.")
    windows: WindowsConfig = setting(WindowsConfig(), "Reconstruction in windows.", basic=True)
    loops: LoopsConfig = setting(LoopsConfig(), "Loop closing.")
    incremental: IncrementalConfig = setting(
        IncrementalConfig(), "Incremental solving; not used by 'reconstruct'.", basic=True
    )
    fusion: FusionConfig = setting(FusionConfig(), "Fusion.", basic=True)
    measurements: MeasurementsConfig = setting(MeasurementsConfig(), "Odometry, GPS and relative poses from files.")
    networks: NetworkConfig = setting(NetworkConfig(), "Networks that make cues.", basic=True)
    geometric_depth: GeometricDepthConfig = setting(
        GeometricDepthConfig(), "Depth from camera motion alone.", basic=True
    )
    affine_depth: AffineDepthConfig = setting(AffineDepthConfig(), "Scale and shift of relative depth networks.")
    motion_masks: MotionMaskConfig = setting(
        MotionMaskConfig(), "Masks from motion alone, and instances over time.", basic=True
    )
    output: OutputConfig = setting(OutputConfig(), "Output.", basic=True)

    @model_validator(mode="after")
    def _energy_is_whole(self) -> Config:
        """Refuse a mixture of the two energies: kernels, depth priors and noise belong together."""
        found = list(self._contradictions())
        if found:
            raise ValueError(
                f"energy '{self.energy}' contradicts {', '.join(found)}; '--config paper' takes the whole of energy "
                "'paper', the other presets that of 'map'"
            )
        return self

    def _contradictions(self) -> Iterator[str]:
        paper = self.energy == "paper"
        adjustment, moving = self.bundle_adjustment, self.nonrigid
        kernels = {
            "camera_init.kernel": self.camera_init.kernel,
            "bundle_adjustment.reprojection_kernel": adjustment.reprojection_kernel,
            "nonrigid.reprojection_kernel": moving.reprojection_kernel,
            "nonrigid.smoothness_kernel": moving.smoothness_kernel,
            "nonrigid.arap_kernel": moving.arap_kernel,
        }
        if not paper:  # Energy 'paper' has no depth priors, whatever their kernels.
            kernels["bundle_adjustment.depth_kernel"] = adjustment.depth_kernel
            kernels["nonrigid.depth_kernel"] = moving.depth_kernel
        for path, kernel in kernels.items():
            # Equation 4 of the paper's text, stage 1, squares the norm.
            squared_by_text = paper and path == "camera_init.kernel" and kernel.kind == "quadratic"
            if (kernel.kind == "norm") != paper and not squared_by_text:
                yield f"{path}.kind={kernel.kind}"
        if not paper and moving.proximal_weight > 0:
            yield "nonrigid.proximal_weight"
        switches = {
            "bundle_adjustment.measure_noise": adjustment.measure_noise,
            "bundle_adjustment.depth_prior": adjustment.depth_prior,
            "nonrigid.depth_prior": moving.depth_prior,
        }
        for path, on in switches.items():
            if paper and on:
                yield f"{path}=true"
