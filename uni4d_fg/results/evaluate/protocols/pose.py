"""Camera poses: ATE and relative errors after a similarity, as evo computes them for LEAP-VO, MonST3R and Uni4D."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.results.evaluate.trajectory import AlignmentMode, evaluate_trajectory, path_length


@dataclass(frozen=True)
class PoseProtocol:
    """One way to score poses."""

    name: str
    source: str
    """Whose program does so."""
    alignment: AlignmentMode = "sim3"
    unit_path: bool = False
    """Scale the truth to a path of length 1 first, so that long and short videos weigh the same."""

    @property
    def text(self) -> str:
        """What is done, in words."""
        how = {"sim3": "after Sim(3) (Umeyama)", "se3": "after SE(3) (Umeyama)", "none": "without alignment"}
        path = ", truth scaled to a path of length 1" if self.unit_path else ""
        return f"root mean squares {how[self.alignment]}, relative errors over 1 frame, all pairs{path} ({self.source})"


POSE_PROTOCOLS: dict[str, PoseProtocol] = {
    protocol.name: protocol
    for protocol in (
        PoseProtocol("sim3", "evo, as LEAP-VO, MonST3R and Uni4D call it"),
        PoseProtocol("sim3-unit-path", "Uni4D, eval_pose.py with normalize", unit_path=True),
        PoseProtocol("se3", "evo without scale; for metric methods", alignment="se3"),
    )
}


@dataclass(frozen=True)
class PoseScore:
    """Errors of one video."""

    protocol: str
    ate: float
    """m; of the path's length with ``sim3-unit-path``."""
    rpe_translation: float | None
    """The same unit."""
    rpe_rotation_deg: float | None
    scale: float
    """Reference length per estimate length, as aligned."""
    poses: int
    missing: int
    """Frames without an estimate or without truth; not scored."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


def score_poses(protocol: PoseProtocol, estimate: FloatArray, reference: FloatArray) -> PoseScore | None:
    """Score camera poses of the same frames.

    Args:
        protocol: How.
        estimate: (T, 4, 4) camera to world; NaN where there is none.
        reference: (T, 4, 4) camera to world, meters; NaN where unknown.

    Returns:
        The score; None if fewer than two frames have both. Relative errors are of neighbors among the frames that do.

    Raises:
        InputError: If the shapes disagree.
    """
    both = np.isfinite(estimate).all(axis=(1, 2)) & np.isfinite(reference).all(axis=(1, 2))
    if both.sum() < 2:
        return None
    truth = reference[both].copy()
    if protocol.unit_path:
        truth[:, :3, 3] /= max(path_length(truth), 1e-12)
    found = evaluate_trajectory(estimate[both], truth, alignment=protocol.alignment)
    return PoseScore(
        protocol.name, found.ate_m, found.rpe_translation_m, found.rpe_rotation_deg, found.scale, int(both.sum()),
        int((~both).sum()),
    )  # fmt: skip
