"""The interactive view: a scene, its controls, and what happens when one of them changes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from uni4d_fg.arrays import evenly_spread
from uni4d_fg.results.measures import scene_depth
from uni4d_fg.results.pictures.figure import upright_axes
from uni4d_fg.results.run import Run
from uni4d_fg.results.view.coloring import ColorBy, Coloring, as_html, values_of
from uni4d_fg.results.view.content import Limits, RunClouds
from uni4d_fg.results.view.layers import (
    CameraLayer,
    ObjectLayer,
    PointLayers,
    Shown,
    TrajectoryLayer,
    quaternion,
    vertical_fov,
)
from uni4d_fg.results.view.panel import Panel

_POINT_SIZE = 0.004
"""Size of a point, in parts of the scene's depth."""
_CAMERA_SIZE = 0.09
_IDLE_SECONDS = 0.05


class Viewer:
    """Draws a run into a viser server; thread-safe, as callbacks come from viser's threads."""

    def __init__(self, server: Any, run: Run, limits: Limits | None = None) -> None:
        limits = limits or Limits()
        self._server, self._run, self._lock = server, run, threading.RLock()
        clouds = RunClouds(run, limits)
        static, source = clouds.static()
        reconstruction = run.reconstruction
        self._depth = scene_depth(reconstruction)
        self._values = values_of(run)
        self._shown = Shown(landmarks=source == "none")
        self._coloring = Coloring(ColorBy.image, run, self._values)
        size = _POINT_SIZE * self._depth
        rows = evenly_spread(len(reconstruction.landmarks), limits.landmarks)
        self._points = PointLayers(server, run, clouds, static, rows, size)
        tracks = evenly_spread(len(reconstruction.dynamic_points), limits.trajectories)
        self._trajectories = TrajectoryLayer(server, run, tracks, size)
        self._cameras = CameraLayer(server, run, limits, _CAMERA_SIZE * self._depth)
        self._objects = ObjectLayer(server, run, _CAMERA_SIZE * self._depth)
        times = np.diff(reconstruction.timestamps)
        rate = 1.0 / float(np.median(times)) if len(times) else 1.0
        # Sequences without times count frames; they play at an ordinary rate.
        self.panel = Panel(server, run.num_frames, run.name, rate if rate > 1.5 else 15.0, self._shown)
        self.panel.objects.visible = self._objects.count > 0
        self.panel.notes.content = _notes(run, source, limits)
        self._prepare_scene()
        self._attach()

    def _prepare_scene(self) -> None:
        axes = upright_axes(self._run.reconstruction.world_T_cam)
        self._server.scene.set_up_direction(axes[2])
        self._overview = self._overview_of(axes)
        camera = self._server.initial_camera
        camera.position, camera.look_at = self._overview
        camera.up = axes[2]
        camera.near, camera.far = 1e-3 * self._depth, 1e3 * self._depth
        with self._server.atomic():
            self._cameras.build(self._coloring)
            self._draw_still()
            self._draw_frame()

    def _overview_of(self, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a position behind, above and beside the first camera, and the point to look at."""
        first = self._run.reconstruction.world_T_cam[:, :3, 3].mean(axis=0)
        right, forward, up = axes
        target = first + 0.8 * self._depth * forward
        return first + self._depth * (0.3 * right - 0.5 * forward + 0.35 * up), target

    def _attach(self) -> None:
        panel = self.panel
        for control in (
            panel.static, panel.landmarks, panel.moving, panel.trajectories, panel.objects,
            panel.cameras, panel.images, panel.history, panel.trail, panel.point_size, panel.color, panel.frame,
        ):  # fmt: skip
            control.on_update(lambda _: self.refresh())
        panel.look_through.on_click(lambda event: self._look_through([event.client]))
        panel.overview.on_click(lambda event: self._show_overview(event.client))
        panel.follow.on_update(lambda _: self._follow_if_asked())

    def refresh(self) -> None:
        """Draw what the panel asks for now."""
        with self._lock:
            shown, by = self.panel.shown(), self.panel.color_by
            before, self._shown = self._shown, shown
            recolored = by is not self._coloring.by
            if shown == before and not recolored:
                return
            with self._server.atomic():
                if recolored:
                    self._coloring = Coloring(by, self._run, self._values)
                    self._cameras.color(self._coloring)
                if recolored or _still(before) != _still(shown):
                    self._draw_still()
                self._draw_frame()
            if before.frame != shown.frame:
                self._follow_if_asked()

    def _draw_still(self) -> None:
        shown = self._shown
        if self._coloring.by in (ColorBy.residual, ColorBy.uncertainty):
            # Only landmarks have numbers of their own.
            shown = Shown(**{**vars(shown), "landmarks": True})
        self._points.draw_still(self._coloring, shown)
        self.panel.legend.content = self._coloring.legend()

    def _draw_frame(self) -> None:
        self._points.draw_frame(self._coloring, self._shown)
        self._trajectories.draw(self._coloring, self._shown)
        self._objects.draw(self._shown)
        self._cameras.draw_frame(self._shown)
        self.panel.facts.content = self._facts(self._shown.frame)

    def _facts(self, frame: int) -> str:
        reconstruction, values = self._run.reconstruction, self._values
        parts = [f"frame {frame} of {self._run.num_frames}"]
        if not np.array_equal(reconstruction.timestamps, np.arange(self._run.num_frames)):
            parts[0] += f", {reconstruction.timestamps[frame]:.3f} s"
        if np.isfinite(values.camera_error[frame]):
            parts.append(f"median residual {values.camera_error[frame]:.2f} px")
        if np.isfinite(values.position_sigma[frame]):
            factor, unit = self._run.small_unit
            parts.append(f"position ± {factor * values.position_sigma[frame]:.2g} {unit}")
        return as_html(parts)

    def _look_through(self, clients: list[Any]) -> None:
        reconstruction = self._run.reconstruction
        pose = reconstruction.world_T_cam[self._shown.frame]
        height, width = reconstruction.image_size
        fov = vertical_fov(reconstruction)
        # The frusta would stand in the way of the view that is asked for.
        self.panel.cameras.value = False
        for client in clients:
            aspect = client.camera.aspect
            narrow = aspect > 0 and aspect < width / height
            fitted = 2.0 * np.arctan(np.tan(0.5 * fov) * (width / height) / aspect) if narrow else fov
            with client.atomic():
                client.camera.wxyz = quaternion(pose)
                client.camera.position = pose[:3, 3]
                client.camera.fov = float(fitted)

    def _follow_if_asked(self) -> None:
        if self.panel.follow.value:
            self._look_through(list(self._server.get_clients().values()))

    def _show_overview(self, client: Any) -> None:
        self.panel.follow.value = False
        self.panel.cameras.value = True
        position, target = self._overview
        with client.atomic():
            client.camera.up_direction = upright_axes(self._run.reconstruction.world_T_cam)[2]
            client.camera.position = position
            client.camera.look_at = target
            client.camera.fov = np.radians(60.0)

    def run_until(self, should_stop: Callable[[], bool]) -> None:
        """Play when asked to, until ``should_stop``."""
        due = time.monotonic()
        while not should_stop():
            if not self.panel.play.value or self._run.num_frames < 2:
                time.sleep(_IDLE_SECONDS)
                due = time.monotonic()
                continue
            due += 1.0 / float(self.panel.frames_per_second.value)
            self.panel.frame.value = (int(self.panel.frame.value) + 1) % self._run.num_frames
            self.refresh()
            # Drawing may take longer than a frame lasts; the rate then drops instead of a queue growing.
            due = max(due, time.monotonic())
            time.sleep(min(max(due - time.monotonic(), 0.001), 1.0))


def _still(shown: Shown) -> tuple[bool, bool, float]:
    return shown.static, shown.landmarks, shown.point_size


def _notes(run: Run, source: str, limits: Limits) -> str:
    lines = [f"⚠ {text}" for text in run.summary.get("warnings", [])] + list(run.notes)
    if source == "none":
        lines.append("The run has no clouds and they cannot be made: landmarks and trajectories only.")
    elif source == "depth":
        lines.append("The run has no clouds: these are made from its depth.")
    if len(run.reconstruction.landmarks) > limits.landmarks:
        lines.append(f"{limits.landmarks} of {len(run.reconstruction.landmarks)} landmarks are shown.")
    return as_html(lines)
