"""One HTML file that plays a run without a server or a network: viser's own recording within viser's own client."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

from uni4d_fg.arrays import IntArray, evenly_spread
from uni4d_fg.errors import ConfigError, OutputError
from uni4d_fg.files import atomic_path
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.results.measures import scene_depth
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.results.view.camera_layer import CameraLayer
from uni4d_fg.results.view.coloring import ColorBy, Coloring, values_of
from uni4d_fg.results.view.content import NOTHING, Limits, RunClouds
from uni4d_fg.results.view.frame_layer import FrameLayer
from uni4d_fg.results.view.framing import FOV_RAD, first_view
from uni4d_fg.results.view.page import with_scripts
from uni4d_fg.results.view.server import viewer_server
from uni4d_fg.results.view.shown import Shown
from uni4d_fg.results.view.static_layer import StaticLayer
from uni4d_fg.results.view.viewer import CAMERA_SIZE

MB = 1_000_000
_BYTES_PER_POINT = 10.0
"""Of a point in the page: about 7.3 compressed, as text a third more. The start of the search for what fits."""
_STATIC_PART = 0.6
_MOST_STATIC = 1_500_000
_ATTEMPTS = 5
_AIM = 0.93
_ENOUGH = 0.8
"""A page smaller than this part of the size is tried again with more points."""
_TITLE = "<title>Viser</title>"


@dataclass(frozen=True)
class SharedPage:
    """What was written."""

    path: Path
    megabytes: float
    static_points: int
    moving_points: int
    frames: int
    landmarks: int
    """Shown in the place of static points, where a run has none."""


def write_page(
    run: Run,
    path: Path,
    max_mb: float = 25.0,
    *,
    frames_per_second: float | None = None,
    reporter: Reporter | None = None,
) -> SharedPage:
    """Write the page: clouds, trails and cameras of all frames, as many points as the size allows.

    Args:
        run: The run.
        path: The ``.html`` file, which appears whole or not at all.
        max_mb: Most megabytes (10^6 bytes).
        frames_per_second: Speed of the film; that of the video, or 15, if not given.
        reporter: Told about progress.

    Raises:
        ConfigError: If the size is too small for the page with no points at all.
        OutputError: If the file cannot be written, or no number of points was found that fits.
        MissingDependencyError: If viser is not installed.
    """
    reporter = reporter or SilentReporter()
    rate = frames_per_second or _rate(run)
    reporter.begin("clouds", None)
    source = _Source.of(run)
    reporter.end(f"{len(source.static.points)} static and {source.num_moving} moving points")
    total = max(int(_AIM * max_mb * MB / _BYTES_PER_POINT), 1)
    fixed = 0.0  # bytes of the page without any points; measured only once points are to be left out
    reporter.begin("page", _ATTEMPTS)
    for attempt in range(_ATTEMPTS):
        static, moving = source.within(total)
        page = _page(run, static, moving, rate)
        data = page.encode("utf-8")
        reporter.advance(attempt + 1)
        points = len(static.points) + sum(len(cloud.points) for cloud in moving)
        small = len(data) < _ENOUGH * max_mb * MB and points < len(source.static.points) + source.num_moving
        if len(data) <= max_mb * MB and (attempt > 1 or not small):
            reporter.end(f"{len(data) / MB:.1f} MB")
            with atomic_path(path) as temporary:
                temporary.write_bytes(data)
            moving_points = points - len(static.points)
            landmarks = len(_landmark_rows(run, static))
            return SharedPage(path, len(data) / MB, len(static.points), moving_points, len(moving), landmarks)
        if len(data) > max_mb * MB and not fixed:
            fixed = _fixed_size(run, source, rate)
            if fixed > max_mb * MB:
                least = math.ceil(100 * fixed / MB) / 100
                raise ConfigError(f"--max-mb {max_mb:g}: the page without any points takes {least:g} MB")
        total = max(int((_AIM * max_mb * MB - fixed) / max(len(data) - fixed, 1.0) * points), 1)
    raise OutputError(f"{path}: the run does not fit into {max_mb:g} MB; give a larger --max-mb")


@dataclass(frozen=True)
class _Source:
    """The clouds at full density."""

    static: ColoredPoints
    moving: list[ColoredPoints]

    @classmethod
    def of(cls, run: Run) -> _Source:
        clouds = RunClouds(run, Limits(static_points=_MOST_STATIC))
        static, _ = clouds.static()
        dense = clouds.dense_static()
        if dense is not None and len(dense.points) > len(static.points):
            static = dense
        return cls(static, [clouds.moving(frame) for frame in range(run.num_frames)])

    @property
    def num_moving(self) -> int:
        return sum(len(cloud.points) for cloud in self.moving)

    def within(self, total: int) -> tuple[ColoredPoints, list[ColoredPoints]]:
        """Thin the clouds to so many points together; what one does not need goes to the other."""
        # Without any static point landmarks would stand in for them.
        static = self.static.thinned(max(int(_STATIC_PART * total), total - self.num_moving, 1))
        left = (total - len(static.points)) / max(self.num_moving, 1)
        return static, [cloud.thinned(int(left * len(cloud.points))) for cloud in self.moving]


@dataclass
class _Given:
    """Clouds that are at hand, in the place of those of a run."""

    clouds: list[ColoredPoints]

    def moving(self, frame: int) -> ColoredPoints:
        return self.clouds[frame]

    def whole_frame(self, frame: int) -> ColoredPoints:
        return NOTHING


def _page(run: Run, static: ColoredPoints, moving: list[ColoredPoints], rate: float) -> str:
    with viewer_server("127.0.0.1", 0, run.name) as server:
        serializer = _recorded(server, run, static, moving, rate)
        page: str = serializer.as_html(dark_mode=True)
    return with_scripts(page.replace(_TITLE, f"<title>{escape(run.name)}</title>", 1))


def _fixed_size(run: Run, source: _Source, rate: float) -> int:
    """Return the bytes of the page of as good as no points."""
    return len(_page(run, source.static.thinned(1), [NOTHING for _ in source.moving], rate).encode("utf-8"))


def _recorded(server: Any, run: Run, static: ColoredPoints, moving: list[ColoredPoints], rate: float) -> Any:
    reconstruction, limits = run.reconstruction, Limits()
    depth = scene_depth(reconstruction)
    rows = _landmark_rows(run, static)
    shown = Shown(landmarks=len(rows) > 0, full=False)
    coloring = Coloring(ColorBy.image, run, values_of(run))
    view = first_view(reconstruction, depth)
    server.scene.set_up_direction(view.up)
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up, camera.fov = view.position, view.look_at, view.up, FOV_RAD
    camera.near, camera.far = 1e-3 * depth, 1e3 * depth
    still = StaticLayer(server, run, depth, rows)
    still.build(coloring, shown)
    still.replace_by(static, still.send(static, coloring, 1.0))
    tracks = evenly_spread(len(reconstruction.dynamic_points), limits.trajectories)
    frames = FrameLayer(server, run, _Given(moving), tracks, depth)
    frames.build(shown)
    cameras = CameraLayer(server, run, limits, CAMERA_SIZE * depth)
    cameras.build(coloring, shown)
    for frame in range(run.num_frames):
        frames.load(frame, coloring, 1.0)
        cameras.load(frame, shown)
    serializer = server.get_scene_serializer()
    for frame in range(run.num_frames):
        now = replace(shown, frame=frame)
        frames.show(now)
        cameras.show(now)
        if run.num_frames > 1:
            serializer.insert_sleep(1.0 / rate)
    return serializer


def _landmark_rows(run: Run, static: ColoredPoints) -> IntArray:
    """Return the landmarks that stand in for static points: none where there are any."""
    return evenly_spread(len(run.reconstruction.landmarks), 0 if len(static.points) else Limits().landmarks)


def _rate(run: Run) -> float:
    """Return the speed of the video, frames per second; sequences without times play at an ordinary one."""
    times = run.reconstruction.timestamps
    rate = (len(times) - 1) / float(times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 1.0
    return min(rate, 60.0) if rate > 1.5 else 15.0
