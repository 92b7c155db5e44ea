"""The search for rigid objects in a run: after stage 3, into its record."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence as SequenceOf
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.slam.stages.energy import energy_of
from uni4d_fg.slam.stages.nonrigid import solve_nonrigid
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.rigid_objects import (
    RigidEvidence,
    RigidObject,
    find_rigid_objects,
    visible_observations,
)
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise

NOT_IN_WINDOWS = "rigid objects are not searched for in windows"
NOT_A_LIKELIHOOD = "rigid objects are not searched for: the paper's energy measures no noise to judge them by"


def rigid_objects_part(
    motion: DynamicScene,
    observations: Observations,
    labelled: LabelledTracks,
    cameras: Cameras,
    noise: StaticNoise,
    timestamps: FloatArray,
    config: Config,
    hooks: Hooks,
    run: StageRunner,
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any], list[str]]:
    """Search for rigid objects among what stage 3 found.

    Args:
        motion: The trajectories of stage 3.
        observations: What it saw; the depth cue with all corrections.
        labelled: All tracks.
        cameras: Frozen cameras.
        noise: Sigmas measured on the static scene.
        timestamps: (T,) seconds.
        config: Of the run.
        hooks: Progress and cancellation.
        run: What solves the declared stages.

    Returns:
        Arrays for the record, plain data for the summary, and facts.
    """
    if not energy_of(config).is_likelihood:
        return {}, {}, [NOT_A_LIKELIHOOD]

    def solve(seen: Observations) -> DynamicScene:
        instance = labelled.instance.astype(np.int64)
        return solve_nonrigid(seen, instance, cameras, noise, config.nonrigid, energy_of(config), hooks=hooks, run=run)

    began = time.perf_counter()
    found, evidence = find_rigid_objects(
        motion, observations, visible_observations(labelled), cameras, noise, timestamps,
        config.nonrigid.smoothness_sigma_m, config.rigid_objects, solve, hooks, run,
    )  # fmt: skip
    summary = {
        "seconds": time.perf_counter() - began,
        "instances": [{"instance": i, **_plain(asdict(e))} for i, e in evidence.items()],
        "solves": [solve_dict(o.solve) for o in found],
    }
    return object_arrays(found, len(timestamps)), summary, [_fact(i, e) for i, e in evidence.items()]


def object_arrays(found: SequenceOf[RigidObject], num_frames: int) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of J objects under their names in a reconstruction."""
    count = len(found)
    return {
        "object_instance": np.array([o.instance for o in found], dtype=np.int32),
        "object_reference": np.array([o.reference for o in found], dtype=np.int32),
        "object_observed": np.array([o.observed for o in found], dtype=bool).reshape(count, num_frames),
        "object_world_T_object": np.reshape([o.world_T_object for o in found], (count, num_frames, 4, 4)),
        "object_covariance": np.reshape([o.covariance for o in found], (count, num_frames, 6, 6)),
        "object_velocity": np.reshape([o.velocity for o in found], (count, num_frames, 6)),
    }


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return what JSON can hold: None instead of NaN."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def _fact(instance: int, evidence: RigidEvidence) -> str:
    members = f"{evidence.num_members} of {evidence.num_tracks} trajectories move as one body"
    verdict = "a rigid body" if evidence.is_rigid else "not taken for rigid"
    tested = ""
    if math.isfinite(evidence.advantage):
        tested = (
            f", held-out pixels predicted {'better' if evidence.advantage > 0 else 'worse'} by "
            f"{abs(evidence.advantage):.2f} ± {evidence.standard_error:.2f} nats "
            f"({evidence.rigid_error_px:.2f} px, non-rigid {evidence.nonrigid_error_px:.2f} px)"
        )
    return f"instance {instance} is {verdict}: {members}{tested}"
