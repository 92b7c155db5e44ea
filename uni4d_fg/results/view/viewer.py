"""The interactive view: a scene, its controls, and what happens when one of them changes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from uni4d_fg.arrays import evenly_spread
from uni4d_fg.errors import InputError
from uni4d_fg.results.measures import scene_depth
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.results.view.camera_layer import CameraLayer, ObjectLayer
from uni4d_fg.results.view.coloring import ColorBy, Coloring, as_html, values_of
from uni4d_fg.results.view.content import Limits, RunClouds
from uni4d_fg.results.view.frame_layer import FrameLayer
from uni4d_fg.results.view.framing import FOV_RAD, Framing, first_view
from uni4d_fg.results.view.nodes import quaternion, vertical_fov
from uni4d_fg.results.view.panel import Panel
from uni4d_fg.results.view.shown import Shown
from uni4d_fg.results.view.static_layer import FIRST_POINTS, StaticLayer

CAMERA_SIZE = 0.035
"""Size of the current camera, in parts of the scene's depth."""
_IDLE_SECONDS = 0.03
_HEAD_START, _HEAD_START_SECONDS = 0.7, (0.7, 3.0)
"""A browser gets this part of the time that its page took to load for drawing the first picture; least and most."""
_STILL_SECONDS = 0.3
"""The time must stand still for so long before every pixel of a frame is sent."""


class Viewer:
    """Draws a run into a viser server; thread-safe, as callbacks come from viser's threads.

    It begins with a thin cloud and the first frame; :meth:`load` sends the rest.
    """

    def __init__(self, server: Any, run: Run, limits: Limits | None = None) -> None:
        limits = limits or Limits()
        self._server, self._run, self._lock = server, run, threading.RLock()
        reconstruction = run.reconstruction
        self._depth = scene_depth(reconstruction)
        self._clouds = RunClouds(run, limits)
        first, self._source = self._clouds.static(FIRST_POINTS)
        self._seen = threading.Event()
        self._values = values_of(run)
        self._shown = Shown(landmarks=self._source == "none")
        self._coloring = Coloring(ColorBy.image, run, self._values)
        size = CAMERA_SIZE * self._depth
        rows = evenly_spread(len(reconstruction.landmarks), limits.landmarks)
        self._static = StaticLayer(server, run, self._depth, rows)
        tracks = evenly_spread(len(reconstruction.dynamic_points), limits.trajectories)
        self._frames = FrameLayer(server, run, self._clouds, tracks, self._depth)
        self._cameras = CameraLayer(server, run, limits, size)
        self._objects = ObjectLayer(server, run, 2.0 * size)
        times = np.diff(reconstruction.timestamps)
        rate = 1.0 / float(np.median(times)) if len(times) else 1.0
        # Sequences without times count frames; they play at an ordinary rate.
        self.panel = Panel(server, run.num_frames, run.name, rate if rate > 1.5 else 15.0, self._shown)
        self.panel.objects.visible = self._objects.count > 0
        self.panel.notes.content = _notes(run, self._source, limits)
        self._changed = time.monotonic()
        self._prepare_scene(first)
        self._attach()

    def _prepare_scene(self, first: ColoredPoints) -> None:
        view = first_view(self._run.reconstruction, self._depth)
        self._server.scene.set_up_direction(view.up)
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = view.position, view.look_at, view.up, FOV_RAD
        camera.near, camera.far = 1e-3 * self._depth, 1e3 * self._depth
        with self._server.atomic():
            self._static.build(self._coloring, self._shown)
            first_node = self._static.send(first, self._coloring, self._shown.point_size)
            self._static.replace_by(first, first_node)
            self._frames.build(self._shown)
            self._cameras.build(self._coloring, self._shown)
            self._load_frame(0)
            self._show()
        self.panel.legend.content = self._coloring.legend()

    def _attach(self) -> None:
        panel = self.panel
        for control in panel.of_the_picture:
            control.on_update(lambda _: self.refresh())
        panel.look_through.on_click(lambda event: self._look_through([event.client]))
        panel.overview.on_click(lambda event: self._show_overview(event.client))
        panel.follow.on_update(lambda _: self._follow_if_asked())
        panel.add_keys(self.step)
        self._server.on_client_connect(self._welcome)

    def load_when_seen(self, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Do what :meth:`load` does when a browser shows the first picture, which would come later with it."""
        began = time.monotonic()
        while not self._seen.wait(_IDLE_SECONDS):
            if should_stop():
                return
        least, most = _HEAD_START_SECONDS
        time.sleep(min(max(_HEAD_START * (time.monotonic() - began), least), most))
        self.load(should_stop)

    def load(self, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Send everything that is not there yet: the whole static cloud, all frames, then the dense static cloud."""
        if self._source == "files" and not should_stop():
            self._send_file()
        for frame in range(self._run.num_frames):
            if should_stop():
                return
            with self._lock:
                self._load_frame(frame)
        dense = self._clouds.dense_static(should_stop)
        if dense is not None and len(dense.points) > self._static.num_points and not should_stop():
            self._send_static(dense)

    def _send_file(self) -> None:
        try:
            whole, _ = self._clouds.static()
        except InputError as error:
            self.panel.notes.content += as_html([f"⚠ {error}"])
            return
        if len(whole.points) > self._static.num_points:
            self._send_static(whole)

    def _send_static(self, cloud: Any) -> None:
        coloring, factor = self._coloring, self._shown.point_size
        # Chunks of millions of points take seconds; the panel must answer meanwhile.
        node = self._static.send(cloud, coloring, factor)
        with self._lock, self._server.atomic():
            self._static.replace_by(cloud, node)
            if self._coloring is not coloring:
                self._static.color(self._coloring)
            if self._shown.point_size != factor:
                self._static.resize(self._shown.point_size)

    def _load_frame(self, frame: int) -> None:
        self._frames.load(frame, self._coloring, self._shown.point_size)
        self._cameras.load(frame, self._shown)

    def refresh(self) -> None:
        """Show what the panel asks for now."""
        with self._lock:
            shown, by = self.panel.shown(), self.panel.color_by
            if by in (ColorBy.residual, ColorBy.uncertainty):
                # Only landmarks have numbers of their own.
                shown = replace(shown, landmarks=True)
            before, self._shown = self._shown, shown
            recolored = by is not self._coloring.by
            if shown == before and not recolored:
                return
            if shown.frame != before.frame or shown.full != before.full or recolored:
                self._changed = time.monotonic()
            if shown.images != before.images:
                self._cameras.drop_images()
            if shown.frame not in self._frames.loaded or shown.images != before.images:
                self._load_frame(shown.frame)
            with self._server.atomic():
                self._show()
                if recolored:
                    self._recolor(by)
                if shown.point_size != before.point_size:
                    self._static.resize(shown.point_size)
                    self._frames.resize(shown.point_size)
            if before.frame != shown.frame:
                self._follow_if_asked()

    def _recolor(self, by: ColorBy) -> None:
        self._coloring = Coloring(by, self._run, self._values)
        for layer in (self._cameras, self._static, self._frames):
            layer.color(self._coloring)
        self.panel.legend.content = self._coloring.legend()

    def _show(self) -> None:
        self._static.show(self._shown)
        self._frames.show(self._shown)
        self._objects.draw(self._shown)
        self._cameras.show(self._shown)
        self.panel.facts.content = self._facts(self._shown.frame)

    def _facts(self, frame: int) -> str:
        reconstruction, values = self._run.reconstruction, self._values
        parts = [f"frame {frame} of {self._run.num_frames}"]
        if self._run.has_times:
            parts[0] += f", {reconstruction.timestamps[frame]:.3f} s"
        if np.isfinite(values.camera_error[frame]):
            parts.append(f"median residual {values.camera_error[frame]:.2f} px")
        if np.isfinite(values.position_sigma[frame]):
            factor, unit = self._run.small_unit
            parts.append(f"position ± {factor * values.position_sigma[frame]:.2g} {unit}")
        return as_html(parts)

    def step(self, frames: int) -> None:
        """Go some frames forward or back, around the ends; 0 starts or halts the time."""
        with self._lock:
            if frames == 0:
                self.panel.play.value = not self.panel.play.value
                return
            # Slider and picture in one message, so that no picture is of another frame than the slider says.
            with self._server.atomic():
                self.panel.frame.value = (int(self.panel.frame.value) + frames) % self._run.num_frames
                self.refresh()
            # At once: viser collects messages for a sixtieth of a second.
            self._server.flush()

    def _look_through(self, clients: list[Any]) -> None:
        reconstruction = self._run.reconstruction
        pose = reconstruction.world_T_cam[self._shown.frame]
        height, width = reconstruction.image_size
        fov = vertical_fov(reconstruction, self._shown.frame)
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

    def _welcome(self, client: Any) -> None:
        self._seen.set()
        if 0.0 < client.camera.aspect < 1.0:
            _point(client, first_view(self._run.reconstruction, self._depth, client.camera.aspect))

    def _show_overview(self, client: Any) -> None:
        self.panel.follow.value = False
        self.panel.cameras.value = True
        _point(client, first_view(self._run.reconstruction, self._depth, client.camera.aspect or 1.5))

    def run_until(self, should_stop: Callable[[], bool]) -> None:
        """Play when asked to, and fill in a frame that stands still, until ``should_stop``."""
        due = time.monotonic()
        while not should_stop():
            if not self.panel.play.value or self._run.num_frames < 2:
                self._fill_in_if_still()
                time.sleep(_IDLE_SECONDS)
                due = time.monotonic()
                continue
            due += 1.0 / float(self.panel.frames_per_second.value)
            self.step(1)
            # Drawing may take longer than a frame lasts; the rate then drops instead of a queue growing.
            due = max(due, time.monotonic())
            time.sleep(min(max(due - time.monotonic(), 0.001), 1.0))

    def _fill_in_if_still(self) -> None:
        if self._changed and time.monotonic() - self._changed > _STILL_SECONDS and self._shown.full:
            with self._lock:
                self._changed = 0.0
                self._frames.show_full(self._shown, self._coloring)


def _point(client: Any, view: Framing) -> None:
    with client.atomic():
        client.camera.up_direction = view.up
        client.camera.position = view.position
        client.camera.look_at = view.look_at
        client.camera.fov = FOV_RAD


def _notes(run: Run, source: str, limits: Limits) -> str:
    lines = [f"⚠ {text}" for text in run.summary.get("warnings", [])] + list(run.notes)
    if source == "none":
        lines.append("The run has no clouds and they cannot be made: landmarks and trajectories only.")
    elif source == "depth":
        lines.append("The run has no clouds: these are made from its depth.")
    if len(run.reconstruction.landmarks) > limits.landmarks:
        lines.append(f"{limits.landmarks} of {len(run.reconstruction.landmarks)} landmarks are shown.")
    return as_html(lines)
