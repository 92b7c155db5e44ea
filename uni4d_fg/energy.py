r"""The exact energy of a state, term by term, whichever solver found it.

    E = sum over terms of  sum_n weight_n e(|r_n / sigma_n|)

e is the term's robust kernel rho; where the kernel is 'norm', whose smoothing is a solver's aid, e is the
plain Euclidean norm itself. The paper's energy consists of such norms alone, with the paper's term weights and
either normalisation. Solvers may minimise smooth surrogates; this is the one yardstick by which their results
are compared.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.config.stages import BundleAdjustmentConfig, CameraMotionConfig, NonRigidConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.graph.state import State, VariableNames
from uni4d_fg.stages.bundle_adjustment import Freedom, StaticNoise, bundle_adjustment_stage
from uni4d_fg.stages.nonrigid import FrozenCameras, PointMesh, nonrigid_stage
from uni4d_fg.stages.observations import Normalization, Observations

_UNIT_NOISE = StaticNoise(1.0, 1.0)
_NORM = KernelConfig(kind="norm", threshold=1e-6)


def exact_energy(batches: Iterable[FactorBatch], state: State) -> dict[str, float]:
    """Return the energy per term name, 'norm' kernels without their smoothing."""
    out: dict[str, float] = {}
    for batch in batches:
        squared = batch.squared_norm(state)
        value = np.sqrt(squared) if batch.kernel.kind == "norm" else batch.kernel.rho(squared)
        out[batch.name] = out.get(batch.name, 0.0) + float(np.dot(batch.weight, value))
    return out


def static_energy(
    world_T_cam: FloatArray,
    intrinsics: FloatArray,
    landmarks: FloatArray,
    observations: Observations,
    normalization: Normalization,
) -> dict[str, float]:
    """Score stage 2: E_BA and E_cam.

    Args:
        world_T_cam: (T, 4, 4).
        intrinsics: (4,).
        landmarks: (N, 3), one per distinct track of the observations, ascending.
        observations: Observations of those tracks; their weights count.
        normalization: 'mean' or 'sum'.
    """
    tracks, _ = observations.rows()
    state = State({"pose": world_T_cam, "intrinsics": intrinsics[None], "landmark": landmarks}, VariableNames(tracks))
    config = BundleAdjustmentConfig(depth_prior=False, camera_motion=CameraMotionConfig(), reprojection_kernel=_NORM)
    stage = bundle_adjustment_stage(
        state, observations, _UNIT_NOISE, config, intrinsics[None], Freedom(poses=False, intrinsics=False),
        unsquared=True, normalization=normalization,
    )  # fmt: skip
    return exact_energy(stage.batches, state)


def dynamic_energy(
    state: State,
    mesh: PointMesh,
    observations: Observations,
    rows: np.ndarray,
    cameras: FrozenCameras,
    normalization: Normalization,
) -> dict[str, float]:
    """Score stage 3: E_NR, E_smooth (first difference, weight 10) and E_arap (weight 100).

    Args:
        state: Group 'dynamic_point'.
        mesh: Rows and links of the points.
        observations: Observations of the mesh's tracks.
        rows: (N,) row of each observation.
        cameras: Frozen cameras.
        normalization: 'mean' or 'sum'.
    """
    config = NonRigidConfig(
        depth_prior=False, smoothness_order=1, smoothness_weight=10.0, arap_weight=100.0, bridge_gaps=False,
        reprojection_kernel=_NORM, smoothness_kernel=_NORM, arap_kernel=_NORM,
    )  # fmt: skip
    stage = nonrigid_stage(
        state, mesh, observations, rows, cameras, config, unsquared=True, normalization=normalization
    )
    return exact_energy(stage.batches, state)
