"""The controls beside the 3D scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from uni4d_fg.results.view.coloring import ColorBy
from uni4d_fg.results.view.shown import Shown

_MAX_HISTORY = 8


class Panel:
    """Makes the controls and says what they ask for. Callbacks are attached by the viewer."""

    def __init__(self, server: Any, num_frames: int, title: str, frames_per_second: float, start: Shown) -> None:
        gui = server.gui
        gui.set_panel_label(f"uni4d-fg: {title}")
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        with gui.add_folder("Time"):
            self.frame = gui.add_slider("Frame", min=0, max=max(num_frames - 1, 1), step=1, initial_value=0)
            self.frame.disabled = num_frames < 2
            self.play = gui.add_checkbox("Play", initial_value=False)
            self.frames_per_second = gui.add_slider(
                "Frames per second", min=1, max=60, step=1, initial_value=round(min(max(frames_per_second, 1), 60))
            )
            self.facts = gui.add_html("")
        with gui.add_folder("Color"):
            self.color = gui.add_dropdown("Color by", options=tuple(choice.value for choice in ColorBy))
            self.point_size = gui.add_slider("Point size", min=0.2, max=5.0, step=0.1, initial_value=1.0)
            self.legend = gui.add_html("")
        with gui.add_folder("Show"):
            self.static = gui.add_checkbox("Static cloud", initial_value=start.static)
            self.landmarks = gui.add_checkbox("Landmarks", initial_value=start.landmarks)
            self.moving = gui.add_checkbox("Moving cloud", initial_value=start.moving)
            self.full = gui.add_checkbox("Every pixel of this frame", initial_value=start.full)
            self.history = gui.add_slider("Earlier clouds", min=0, max=_MAX_HISTORY, step=1, initial_value=0)
            self.trajectories = gui.add_checkbox("Trajectories", initial_value=start.trajectories)
            self.trail = gui.add_slider(
                "Trail, frames",
                min=0,
                max=max(num_frames - 1, 1),
                step=1,
                initial_value=min(start.trail, num_frames - 1),
            )
            self.objects = gui.add_checkbox("Axes of rigid objects", initial_value=start.objects)
            self.cameras = gui.add_checkbox("Cameras", initial_value=start.cameras)
            self.images = gui.add_checkbox("Image of the camera", initial_value=start.images)
        with gui.add_folder("Camera"):
            self.look_through = gui.add_button("Look through the current camera")
            self.follow = gui.add_checkbox("Follow the camera", initial_value=False)
            self.overview = gui.add_button("Whole scene")
        self.notes = gui.add_html("")
        self._gui = gui

    @property
    def of_the_picture(self) -> tuple[Any, ...]:
        """Controls that change what is shown."""
        return (
            self.frame, self.color, self.point_size, self.static, self.landmarks, self.moving, self.full, self.history,
            self.trajectories, self.trail, self.objects, self.cameras, self.images,
        )  # fmt: skip

    def add_keys(self, step: Callable[[int], None]) -> None:
        """Let the space bar start and halt the time, and the arrow keys go by a frame."""
        for label, key, frames in (
            ("Play or halt", "space", 0),
            ("Next frame", "arrowright", 1),
            ("Frame before", "arrowleft", -1),
        ):
            command = self._gui.add_command(label, hotkey=key)
            command.on_trigger(lambda _, frames=frames: step(frames))

    @property
    def color_by(self) -> ColorBy:
        """What colors shall show."""
        return ColorBy(self.color.value)

    def shown(self) -> Shown:
        """Return what the controls ask for."""
        return Shown(
            frame=int(self.frame.value),
            static=self.static.value,
            landmarks=self.landmarks.value,
            moving=self.moving.value,
            full=self.full.value,
            trajectories=self.trajectories.value,
            objects=self.objects.value,
            cameras=self.cameras.value,
            images=self.images.value,
            history=int(self.history.value),
            trail=int(self.trail.value),
            point_size=float(self.point_size.value),
        )
