"""Starts that explain a video nearly as well as the one that was taken, and how far their cameras are from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.cues.structure.hypotheses import Hypothesis
from uni4d_fg.errors import SolverError
from uni4d_fg.optim.threads import map_in_order, thread_count

NEARLY_AS_WELL = 0.02
"""A rival leaves at most this much more unexplained."""
_LEAST_COMMON = 4


@dataclass(frozen=True)
class Rival:
    """A start that was not taken."""

    first: int
    second: int
    focal: float
    """px."""
    unexplained: float
    degrees: float
    """Median angle between its cameras and those of the result, after one rotation of the world."""
    degrees_per_frame: float
    """The same of the turns from one frame of the trial to the next, per frame of the video."""


def rivals_of(hypotheses: list[Hypothesis], world_T_cam: FloatArray) -> list[Rival]:
    """Return the starts that explain the tracks nearly as well as the best, refined until they stand.

    Each has frames and tracks of its own: how far their focal lengths spread also tells of errors that all residuals of
    one of them share, like those of a rolling shutter.

    Args:
        hypotheses: All, the best first.
        world_T_cam: (T, 4, 4) the result.

    Raises:
        Cancelled: If asked to stop.
    """

    def refined(hypothesis: Hypothesis) -> Rival | None:
        frames = np.flatnonzero(hypothesis.scene.registered)
        if hypothesis.misfit > hypotheses[0].misfit + NEARLY_AS_WELL or len(frames) < _LEAST_COMMON:
            return None
        try:
            hypothesis.scene.measure_noise()
            hypothesis.scene.converge()
        except SolverError:
            return None
        degrees, turns = rotation_difference(hypothesis.scene.world_T_cam, world_T_cam, frames)
        pair, focal = hypothesis.pair, hypothesis.scene.mean_focal
        return Rival(pair.first, pair.second, focal, hypothesis.unexplained, degrees, turns)

    return [rival for rival in map_in_order(refined, hypotheses, thread_count()) if rival is not None]


def rotation_difference(a: FloatArray, b: FloatArray, frames: IntArray) -> tuple[float, float]:
    """Return how far the rotations of two sets of cameras are apart, in degrees: each camera, and turns per frame.

    Args:
        a: (T, 4, 4) poses in a world of their own.
        b: (T, 4, 4).
        frames: (t,) those to compare, ascending.
    """
    first, second = (Rotation.from_matrix(poses[frames, :3, :3]) for poses in (a, b))
    between = first * second.inv()
    rest = between.mean().inv() * between
    turns = (first[:-1].inv() * first[1:]).inv() * (second[:-1].inv() * second[1:])
    per_frame = np.degrees(turns.magnitude()) / np.diff(frames)
    return float(np.degrees(np.median(rest.magnitude()))), float(np.median(per_frame))
