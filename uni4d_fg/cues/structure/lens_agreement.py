"""Whether halves of the tracks ask for the same lens, or for the same zoom.

Whatever tracks slide along, such as outlines or boards of a floor, bends a scene in its own way; if distortion makes up
for that, it takes away as much energy as a weak lens does. Cars that pass through much of the picture do the same to
its size. But a lens is the same everywhere and always, and a zoom is everywhere. So both are fitted once more to the
first and the last half of what is seen, to the left and right half of the tracks, and to the upper and lower one.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.structure.camera_fit import Fitted, fit_lens, fit_zoom, scene_of
from uni4d_fg.cues.structure.selection import mean_pixels
from uni4d_fg.errors import SolverError
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

_OPTIONS = {"relative_decrease": 1e-5, "max_iterations": 50}
_DISAGREE = 1.0 / 3.0
"""Root mean square of how far halves bend the image more or less than all tracks do, as a part of that: 0.01 to 0.25
for lenses of rendered clips, 0.23 to 0.29 for a k1 of -0.06 on recordings; 0.37 to 3 where there is none. Of how far
their zooms are from that of all tracks, as a part of its own: 0.05 to 0.15 for zooms that are one, 0.45 for one that is
none."""


def halves_agree_on_lens(lens: Fitted, image_size: tuple[int, int], config: Config) -> bool:
    """Tell whether halves of the tracks of a scene bend the image about as much as all of them together.

    Args:
        lens: Fitted to all.
        image_size: (height, width), px.
        config: Sections ``bundle_adjustment`` and ``camera``.

    Raises:
        Cancelled: If asked to stop.
    """
    whole = bend(lens.camera, image_size)

    def off(half: Fitted) -> float:
        found = fit_lens(half, lens.camera.lens.model, config, _OPTIONS)
        return bend(found.camera, image_size) / whole - 1.0

    return _halves_agree(lens, off)


def halves_agree_on_zoom(zoom: Fitted, config: Config) -> bool:
    """Tell whether halves of the tracks of a scene zoom about as all of them together do.

    Args:
        zoom: Fitted to all.
        config: Sections ``bundle_adjustment`` and ``camera``.

    Raises:
        Cancelled: If asked to stop.
    """
    whole = _log_zoom(zoom)

    def off(half: Fitted) -> float:
        found = fit_zoom(half, config, _OPTIONS)
        # The level of a focal length is another matter than its change, and less certain.
        return float(np.std((_log_zoom(found) - whole)[found.scene.registered]) / np.std(whole))

    return _halves_agree(zoom, off)


def bend(camera: CameraModel, image_size: tuple[int, int]) -> float:
    """Return by which part a lens moves pixels outward that are half of the image's shorter side from the center.

    Unlike its parameters this hardly depends on the focal length that goes with it.
    """
    radius = 0.5 * min(image_size)
    center = camera.intrinsics[2:]
    real = camera.lens.real_pixels(camera.intrinsics, center + np.array([radius, 0.0]))
    return float((real[0] - center[0]) / radius) - 1.0


def halves(observations: Observations) -> list[BoolArray]:
    """Return which observations (N,) are in the early, late, left, right, upper and lower half.

    Tracks are divided by their mean positions, so that they are whole; frames by how much is seen in them.
    """
    pixels, row = mean_pixels(observations)
    late = observations.frame > np.median(observations.frame)
    right, lower = (pixels >= np.median(pixels, axis=0))[row].T
    return [part for one in (late, right, lower) for part in (~one, one)]


def _halves_agree(whole: Fitted, off: Callable[[Fitted], float]) -> bool:
    """Tell whether what is fitted to halves is near to what all tracks ask for.

    Args:
        whole: Fitted to all.
        off: Fits a half, and returns by which part of the whole it is off. Too few tracks to be solved say nothing.
    """
    parts = halves(whole.scene.observations)
    squares = list[float]()
    for part in parts:
        with suppress(SolverError):
            squares.append(off(_restricted(whole, part)) ** 2)
        if sum(squares) > len(parts) * _DISAGREE**2:
            return False  # whatever the others say
    return not squares or float(np.sqrt(np.mean(squares))) <= _DISAGREE


def _log_zoom(fitted: Fitted) -> FloatArray:
    assert fitted.camera.zoom is not None
    return np.log(fitted.camera.zoom)


def _restricted(lens: Fitted, which: BoolArray) -> Fitted:
    """Return what was fitted with some of its observations (N,)."""
    scene = scene_of(lens.scene.observations.select(which), lens.scene)
    posed = np.zeros_like(scene.registered)
    posed[scene.observations.frame] = True
    return replace(lens, scene=replace(scene, registered=scene.registered & posed))
