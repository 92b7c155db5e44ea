"""What solves the cameras of a stream: a sliding window, or ISAM2 over everything."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from uni4d_fg.config.incremental import IncrementalConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.optim.isam2 import Isam2Runner
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.slam.incremental.window import CameraWindow


class Smoother(Protocol):
    """The camera back end of a stream."""

    def solve(self, window: CameraWindow) -> None:
        """Solve the keyframes and landmarks."""
        ...

    def must_slide(self, window: CameraWindow) -> bool:
        """Return whether the oldest keyframe is to be marginalized.

        Raises:
            SolverError: If there are more keyframes than may be kept.
        """
        ...


@dataclass
class WindowSmoother:
    """Solves the window as a whole and marginalizes what leaves it: bounded memory and time."""

    config: IncrementalConfig
    run: StageRunner

    def solve(self, window: CameraWindow) -> None:
        """Solve the window."""
        window.solve(self.run)

    def must_slide(self, window: CameraWindow) -> bool:
        """Return whether the window is longer than configured."""
        return len(window) > self.config.window


@dataclass
class Isam2Smoother:
    """Keeps every keyframe and landmark in GTSAM's ISAM2: nothing is marginalized, and memory grows."""

    config: IncrementalConfig
    run: StageRunner

    def solve(self, window: CameraWindow) -> None:
        """Update the Bayes tree with what is new."""
        window.solve(self.run)

    def must_slide(self, window: CameraWindow) -> bool:
        """Return False: nothing leaves.

        Raises:
            SolverError: If there are more keyframes than configured.
        """
        if len(window) > self.config.isam2_max_keyframes:
            raise SolverError(
                f"incremental.smoother 'isam2' keeps every keyframe, and keyframe {len(window)} is one more than "
                f"incremental.isam2_max_keyframes allows. For a video of this length take smoother 'window', whose "
                "memory is bounded, or raise the limit"
            )
        return False


def make_smoother(config: IncrementalConfig, run: StageRunner) -> Smoother:
    """Return the configured back end; ``run`` solves a window."""
    if config.smoother == "window":
        return WindowSmoother(config, run)
    return Isam2Smoother(config, Isam2Runner(config.isam2_relinearize_threshold))
