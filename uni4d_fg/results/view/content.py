"""What the viewer shows of a run: at full density, as far as a browser can hold it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import Uni4dFgError
from uni4d_fg.results.fusion import clouds
from uni4d_fg.results.fusion.dense import dense_static_cloud
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints, moving_cloud, static_cloud

_MAX_LIFTED_FRAMES = 60

NOTHING = ColoredPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int32))


@dataclass(frozen=True)
class Limits:
    """How much is sent to the browser."""

    static_points: int = 3_000_000
    moving_points: int = 6_000_000
    """In all frames together: a browser holds the moving clouds of the whole video."""
    landmarks: int = 60_000
    trajectories: int = 1_500
    cameras: int = 120
    """Frusta; of a longer video every n-th is drawn."""
    image_width: int = 160
    current_images: int = 600
    """Frames whose image is held for the frustum of the current camera; every n-th of a longer video."""


@dataclass
class RunClouds:
    """The dense clouds of a run, thinned to the limits."""

    run: Run
    limits: Limits
    fusion: FusionConfig = field(init=False)

    def __post_init__(self) -> None:
        try:
            fusion = self.run.config.fusion
        except Uni4dFgError:
            # A run of another version may hold fields that this one does not know; the clouds can do without.
            fusion = FusionConfig()
        self.fusion = fusion.model_copy(update={"dynamic_stride": 1})

    def static(self, limit: int | None = None) -> tuple[ColoredPoints, str]:
        """Return the static cloud that is at hand, and where it comes from: 'files', 'depth' or 'none'.

        Args:
            limit: Points that are enough; a part of a file is read sooner.
        """
        most = min(limit or self.limits.static_points, self.limits.static_points)
        cloud, source = static_cloud(self.run, self.fusion, _MAX_LIFTED_FRAMES, most)
        return (NOTHING if cloud is None else cloud.thinned(most)), source

    def dense_static(self, should_stop: Callable[[], bool] = lambda: False) -> ColoredPoints | None:
        """Return the static cloud at the images' resolution; None without images or depth. Takes seconds."""
        run = self.run
        if run.sequence is None or run.depth is None:
            return None
        limit = self.limits.static_points
        cloud = dense_static_cloud(
            run.sequence, run.depth, run.confidence, run.reconstruction, self.fusion, limit, should_stop=should_stop
        )
        return ColoredPoints.of(*cloud, np.zeros(len(cloud.points), np.int32))

    def moving(self, frame: int) -> ColoredPoints:
        """Return the cloud of what moves in one frame, a point per pixel where it is made from depth."""
        cloud = moving_cloud(self.run, frame, self.fusion) or NOTHING
        return cloud.thinned(max(1, self.limits.moving_points // self.run.num_frames))

    def whole_frame(self, frame: int) -> ColoredPoints:
        """Return everything that one frame shows, a point per pixel; nothing without images or depth."""
        run = self.run
        if run.sequence is None or run.depth is None:
            return NOTHING
        depth, result = run.depth[frame], run.reconstruction
        keep = ~clouds.depth_edges(depth, self.fusion.edge_relative_gradient)
        camera = result.frame_intrinsics[frame], result.world_T_cam[frame], 1, result.lens
        points, colors = clouds.lift(run.sequence.images[frame], depth, keep, *camera)
        masks = run.sequence.masks
        if masks is None:
            return ColoredPoints.of(points, colors, np.zeros(len(points), np.int32))
        instance = clouds.lift(np.asarray(masks[frame]), depth, keep, *camera).colors.astype(np.int32)
        return ColoredPoints.of(points, colors, instance)
