"""What the viewer shows of a run, thinned so that a browser can draw it."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import Uni4dFgError
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints, moving_cloud, static_cloud

_CACHED_FRAMES = 64
_MAX_LIFTED_FRAMES = 60


NOTHING = ColoredPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int32))


@dataclass(frozen=True)
class Limits:
    """How much is sent to the browser."""

    static_points: int = 400_000
    dynamic_points: int = 40_000
    """Per frame."""
    landmarks: int = 60_000
    trajectories: int = 1_500
    cameras: int = 120
    """Frusta; of a longer video every n-th is drawn."""
    camera_images: int = 40
    image_width: int = 160


@dataclass
class RunClouds:
    """The dense clouds of a run, thinned; ``source`` says where the static one is from: 'files', 'depth' or 'none'."""

    run: Run
    limits: Limits
    fusion: FusionConfig = field(init=False)
    _cache: OrderedDict[int, ColoredPoints] = field(default_factory=OrderedDict)

    def __post_init__(self) -> None:
        try:
            self.fusion = self.run.config.fusion
        except Uni4dFgError:
            # A run of another version may hold fields that this one does not know; the clouds can do without.
            self.fusion = FusionConfig()

    def static(self) -> tuple[ColoredPoints, str]:
        """Return the static cloud and where it comes from."""
        cloud, source = static_cloud(self.run, self.fusion, _MAX_LIFTED_FRAMES)
        return (NOTHING if cloud is None else cloud.thinned(self.limits.static_points)), source

    def dynamic(self, frame: int) -> ColoredPoints:
        """Return the cloud of what moves in one frame."""
        if frame in self._cache:
            self._cache.move_to_end(frame)
            return self._cache[frame]
        cloud = (moving_cloud(self.run, frame, self.fusion) or NOTHING).thinned(self.limits.dynamic_points)
        self._cache[frame] = cloud
        if len(self._cache) > _CACHED_FRAMES:
            self._cache.popitem(last=False)
        return cloud
