r"""Whether the images that a scene was grown from were read row by row, from its tracks.

A rolling shutter bends a scene as a lens does, a little: hand-held, a readout of half the time between frames asked
for k1 = -0.03 and a focal length 3.5 % too short. Moved to where they were when the middle row was read
(:mod:`uni4d_fg.slam.lens.rolling_shutter`), tracks fit by 5 to 38 % better; where all rows are read at once, by 1.1 %
at most, and by 1.8 % where a zoom is not known yet. So it is asked for before a lens is. Times are in units of the
time between two frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.cues.structure.camera_fit import part_of
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.slam.lens.readout_search import BELIEVED, FIRST, least_readout
from uni4d_fg.slam.lens.rolling_shutter import Axis, Readout
from uni4d_fg.slam.lens.track_energy import track_energies
from uni4d_fg.slam.stages.observations import Observations

_OBSERVATIONS = 8000
"""So many are compared, about."""
_AXES: tuple[Axis, ...] = ("rows", "columns")
_SOLVED = 1e-4
"""Relative decrease at which bundle adjustment with a readout ends: what readouts differ by is a hundred times that."""


def find_readout(scene: GrowingScene, observations: Observations, image_size: tuple[int, int]) -> Readout | None:
    """Return how the images were read, in units of the time between two frames; None where all rows are read at once.

    None as well where the tracks fit best if reading takes as long as it can: something else makes them do so.

    Args:
        scene: Grown from the observations.
        observations: N, of all tracks, in the order of tracks and then frames.
        image_size: (height, width), px.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    trials = _trials_of(scene, observations, image_size)
    if trials is None:
        return None
    least = scene.config.camera.min_readout_evidence
    likely = [axis for axis in _AXES if trials.gain_at_first(axis) >= 0.5 * least]
    if not likely:
        return None
    best = min((trials.best_along(axis) for axis in likely), key=trials.loss)
    is_told = trials.loss(best) <= 1.0 - least and abs(best.seconds) < BELIEVED
    return best if is_told else None


def is_told_still(
    scene: GrowingScene, observations: Observations, readout: Readout, image_size: tuple[int, int]
) -> bool:
    """Tell whether tracks ask for a readout with the camera, too, that was found after it: a zoom may look like one.

    Args:
        scene: Grown with that camera.
        observations: N, from which it was grown: moved by the readout, on ideal pixels.
        readout: In units of the time between two frames.
        image_size: (height, width), px.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    trials = _trials_of(scene, observations, image_size)
    undone = replace(readout, seconds=-readout.seconds)
    return trials is not None and trials.loss(undone) * (1.0 - scene.config.camera.min_readout_evidence) >= 1.0


def _trials_of(scene: GrowingScene, observations: Observations, image_size: tuple[int, int]) -> _Trials | None:
    """Return trials with part of a scene's tracks; None if none of them has a point."""
    part = part_of(scene, _OBSERVATIONS, np.ones(len(scene.registered), dtype=bool))
    if not part.good.any():
        return None
    rows = _rows_of(part.observations, observations)
    velocity, acceleration = (values[rows] for values in _motion(observations))
    return _Trials(part, velocity, acceleration, image_size)


def at_one_time(observations: Observations, readout: Readout, image_size: tuple[int, int]) -> Observations:
    """Return observations where they are when the middle of each image is read.

    Args:
        observations: N, in the order of tracks and then frames.
        readout: In units of the time between two frames.
        image_size: (height, width), px.
    """
    return replace(observations, uv=readout.undone(observations.uv, *_motion(observations), image_size))


def _motion(observations: Observations) -> tuple[FloatArray, FloatArray]:
    """Return velocities and accelerations (N, 2), px per frame and its square, as the frames right beside tell."""
    follows = ((np.diff(observations.track) == 0) & (np.diff(observations.frame) == 1))[:, None]
    step = np.where(follows, np.diff(observations.uv, axis=0), 0.0)
    nothing, never = np.zeros((1, 2)), np.zeros((1, 1), dtype=bool)
    before, after = np.concatenate([nothing, step]), np.concatenate([step, nothing])
    both = np.concatenate([never, follows]) & np.concatenate([follows, never])
    return np.where(both, 0.5 * (before + after), before + after), np.where(both, after - before, 0.0)


def _rows_of(some: Observations, of: Observations) -> IntArray:
    """Return at which observations (N,) those (n,) of some tracks and frames are."""
    count = int(of.frame.max(initial=0)) + 1
    return np.searchsorted(of.track * count + of.frame, some.track * count + some.frame)


@dataclass(frozen=True)
class _Trials:
    """Scenes of one set of tracks for several readouts."""

    scene: GrowingScene
    """With the tracks as they are seen."""
    velocity: FloatArray
    """(n, 2) px per frame."""
    acceleration: FloatArray
    """(n, 2)."""
    image_size: tuple[int, int]
    known: dict[Readout, FloatArray] = field(default_factory=dict)

    def gain_at_first(self, axis: Axis) -> float:
        """Return the part of the energy that the first readouts along an axis take away, the better of them."""
        return 1.0 - min(self.loss(Readout(part, axis)) for part in (-FIRST, FIRST))

    def best_along(self, axis: Axis) -> Readout:
        """Return the readout along an axis with which the tracks fit best."""
        return Readout(least_readout(lambda part: self.loss(Readout(part, axis))), axis)

    def loss(self, readout: Readout) -> float:
        """Return the energy with a readout as a part of that without one, of the tracks that have a point in both."""
        ours, theirs = self._energies(readout), self._energies(Readout(0.0))
        both = np.isfinite(ours) & np.isfinite(theirs)
        return float(ours[both].sum() / max(theirs[both].sum(), 1e-300)) if both.any() else 1.0

    def _energies(self, readout: Readout) -> FloatArray:
        """Return the mean robust energy (M,) of each track; NaN without a point."""
        readout = readout if readout.seconds else Readout(0.0)  # along whatever axis
        if readout not in self.known:
            seen = self.scene.observations
            uv = readout.undone(seen.uv, self.velocity, self.acceleration, self.image_size)
            scene = self.scene.seeing(replace(seen, uv=uv))
            scene.measure_noise()
            scene.adjust(_SOLVED)
            scene.triangulate_all()
            energy = track_energies(scene.errors() / self.scene.noise_px, scene.row, scene.num_tracks)
            self.known[readout] = np.where(np.isfinite(scene.position[:, 0]), energy, np.nan)
        return self.known[readout]
