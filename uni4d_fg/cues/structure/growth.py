"""Growing a scene frame by frame, and trying again with frames that fit badly."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import IntArray
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.errors import Cancelled
from uni4d_fg.progress import Reporter

_BAD_SHARE = 0.5
"""A frame fits badly if it agrees with less than this part of what frames usually agree with."""


def grow(scene: GrowingScene, reporter: Reporter, growth: float | None = None) -> None:
    """Add frames until no further one can be posed, refine, and try again with those that fit badly.

    Args:
        scene: With two or more cameras and the points that they see.
        reporter: Told the number of frames that have a pose.
        growth: Bundle adjustment is repeated when the frames have grown by this factor; None takes the configured one.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    factor = scene.config.geometric_depth.growth if growth is None else growth
    reporter.begin("structure from motion", len(scene.registered))
    _add_frames(scene, reporter, factor)
    _finish(scene)
    for _ in range(scene.config.geometric_depth.retries):
        bad = misfits(scene)
        if len(bad) == 0:
            break
        scene.take_out(bad)
        scene.adjust()
        _add_frames(scene, reporter, factor)
        _finish(scene)
    reporter.end()


def misfits(scene: GrowingScene) -> IntArray:
    """Return the frames whose observations of points agree much less often than is usual."""
    has_point = np.isfinite(scene.position[scene.row, 0]) & scene.registered[scene.observations.frame]
    count = np.bincount(scene.observations.frame[has_point], minlength=len(scene.registered))
    agree = np.bincount(scene.observations.frame[has_point & scene.good], minlength=len(scene.registered))
    share = agree / np.maximum(count, 1)
    known = np.flatnonzero(scene.registered)
    # Three at least stay, and most of them: otherwise it is not the frame that is wrong.
    bad = known[share[known] < _BAD_SHARE * float(np.median(share[known]))]
    return bad if len(bad) <= len(known) // 3 else bad[:0]


def _finish(scene: GrowingScene) -> None:
    scene.adjust()
    scene.triangulate(~np.isfinite(scene.position[:, 0]))
    scene.adjust()


def _add_frames(scene: GrowingScene, reporter: Reporter, growth: float) -> None:
    failed: set[int] = set()
    adjusted = int(scene.registered.sum())
    while True:
        if scene.should_stop():
            raise Cancelled("structure from motion stopped")
        frame = scene.next_frame(failed)
        count = int(scene.registered.sum())
        if frame is None or count >= growth * adjusted:
            if count > adjusted:
                scene.adjust()
                scene.triangulate(~np.isfinite(scene.position[:, 0]))
                adjusted = count
                failed.clear()  # better points may now pose a frame that failed before
                continue
            break
        if scene.register(frame):
            reporter.advance(int(scene.registered.sum()), f"frame {frame}")
        else:
            failed.add(frame)
