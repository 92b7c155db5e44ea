"""Where moving things are that one camera has seen: standing on what is below them, or nearer.

What moves hides what is behind it, so that it is no farther than the static surface at the lowest part of its mask.
Most things stand there. Those that do not (they fly, they are carried, or the image cuts them off) are nearer, by a
factor that only the camera's own motion may show (``moving_parallax.py``). Both are weighed by what it shows:

- standing: ``log rho ~ N(0, 0.15^2)``, where ``rho`` is the inverse depth over that of the surface below. Where tracks
  show how the thing's apparent size changes, the frames in which it seems nearest say most of the others
  (``standing_over_time.py``);
- nearer: ``log rho`` exponential, 0.7 in the mean, and at most ``log 8``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, Int32Array, IntArray, at_nearest_pixel
from uni4d_fg.cues.camera_noise import CameraNoise
from uni4d_fg.cues.interpolated_depth import NEAREST_SHARE
from uni4d_fg.cues.moving_parallax import Parallax, moving_parallax
from uni4d_fg.cues.standing_over_time import standing_over_time
from uni4d_fg.frontend.track_model import Tracks

_STANDING_SIGMA = 0.15
_STANDS, _STANDS_CUT = 0.7, 0.1
"""Probability that a thing stands where its mask ends, and where the image's lower border cuts it off."""
_NEARER_MEAN = 0.7
_NEAREST = 8.0
_LOG_RATIO = np.arange(-0.6, np.log(_NEAREST), 0.01)
_TOO_SURE = 1.3
"""Standard deviations of the parallax are this much too small, on synthetic scenes ..."""
_SHARED = 0.08
"""... and cameras that are not exact bias it by up to this part besides."""
_MODEL_WRONG = 0.1
"""Probability that a thing is not as smooth as it is taken to be: parallax then shows any ratio up to the nearest."""
_ON_IT = 0.5
"""A track is on a thing if it is inside its mask in this part of its frames."""
_MIN_TRACKS = 8
_MOSTLY = 0.5
_CUT_WIDTH = 0.4
"""A thing is cut off where its mask is wider than this at the image's lower border, as a part of its widest row: what
reaches down to it and is narrower is a leg, a foot or a shadow ..."""
_LEG = 0.2
"""... and if it does so in most frames, and in most of those in which it seems nearest, what is missing of it makes it
nearer by this log factor: 0.3 of somebody who is followed; a camera at the height of eyes sees 0.3 of one whose knee is
at the border."""


@dataclass
class Sightings:
    """Collects, frame by frame, which tracks are on which thing and how much of it is cut off."""

    tracks: Tracks
    inside: dict[int, IntArray] = field(default_factory=dict)
    """By id: (K,) frames in which a track is inside the mask."""
    area: dict[int, IntArray] = field(default_factory=dict)
    """By id: (T,) area of its mask, px."""
    cut_in: dict[int, set[int]] = field(default_factory=dict)
    """By id: frames in which the image's lower border cuts it off, ..."""
    reaches_in: dict[int, set[int]] = field(default_factory=dict)
    """... and those in which it reaches that border at all."""

    def add(self, frame: int, mask: Int32Array) -> None:
        """Add the mask (H, W) of a frame."""
        labels = np.unique(mask[mask > 0])
        if not len(labels):
            return
        seen = np.flatnonzero(self.tracks.visible[:, frame])
        at = at_nearest_pixel(mask, self.tracks.uv[seen, frame])
        for label in labels.tolist():
            inside = self.inside.setdefault(label, np.zeros(self.tracks.num_tracks, np.int64))
            inside[seen[at == label]] += 1
            width = np.count_nonzero(mask == label, axis=1)
            self.area.setdefault(label, np.zeros(self.tracks.num_frames, np.int64))[frame] += width.sum()
            cut_in = self.cut_in.setdefault(label, set())
            if width[-1] > _CUT_WIDTH * width.max():
                cut_in.add(frame)
            reaches_in = self.reaches_in.setdefault(label, set())
            if width[-1] > 0:
                reaches_in.add(frame)

    def stand_by(self, feet: Sequence[Mapping[int, int]]) -> None:
        """Take things that stand by others (T: by id) as cut off where those are."""
        for frame, foot_of in enumerate(feet):
            for label, foot in foot_of.items():
                for frames in (self.cut_in, self.reaches_in):
                    if frame in frames[foot]:
                        frames[label].add(frame)

    def is_cut(self, label: int) -> bool:
        """Tell whether the image cuts a thing off in most of what it shows of it.

        Frames count by area: what is left of a mask while a thing comes and goes says nothing of where it stands.
        """
        area = self.area[label]
        return bool(area[list(self.cut_in[label])].sum() > _MOSTLY * area.sum())

    def on(self, label: int) -> BoolArray:
        """Return which tracks (K,) are on a thing."""
        total = np.count_nonzero(self.tracks.visible, axis=1)
        return np.asarray(self.inside[label] > _ON_IT * np.maximum(total, 1))


@dataclass(frozen=True)
class Placed:
    """Inverse depth of moving things, and which of them do not stand."""

    inverse_depth: tuple[dict[int, float], ...]
    """T: by id."""
    nearer: dict[int, float]
    """By id: over the inverse depth of the surface below, for things that do not stand on it."""
    open: list[int]
    """Things that are cut off by the image and whose depth nothing shows."""


def place_moving(
    contacts: tuple[Mapping[int, float], ...],
    sightings: Sightings,
    tracks: Tracks,
    world_T_cam: FloatArray,
    intrinsics: FloatArray,
    noise: CameraNoise,
) -> Placed:
    """Decide where things are.

    Args:
        contacts: T: inverse depth of the static surface at the lowest part of each thing, by id.
        sightings: Of all frames.
        tracks: Those of the sightings, at the pixels of a pinhole that does not zoom.
        world_T_cam: (T, 4, 4).
        intrinsics: (4,) px.
        noise: Errors of the cameras.
    """
    placed = [dict(contact) for contact in contacts]
    nearer: dict[int, list[float]] = {}
    unknown = []
    for label in sorted(sightings.inside):
        mine = sightings.on(label)
        stretches = list[Parallax]()
        if np.count_nonzero(mine) >= _MIN_TRACKS:
            uv = tracks.uv[mine].astype(np.float64)
            stretches = moving_parallax(uv, tracks.visible[mine], world_T_cam, intrinsics, noise)
        shown, cut_frames, all_frames = False, 0, 0
        for parallax in stretches:
            frames = [
                frame for frame in range(parallax.first, parallax.first + len(parallax.size))
                if label in contacts[frame]
            ]  # fmt: skip
            if not frames:
                continue
            size = parallax.size[np.array(frames) - parallax.first]
            at_size_one = np.array([contacts[frame][label] for frame in frames]) / size
            standing = float(np.quantile(at_size_one, NEAREST_SHARE))
            # Seen whole in some frames, a thing stands where it does there: in others it goes on below the image,
            # nearer than what is at the border, and where its feet were missed it seems farther.
            nearest = set(np.array(frames)[at_size_one >= standing].tolist())
            cut = _mostly_in(nearest, sightings.cut_in[label])
            reaches = sightings.reaches_in[label]
            legs_cut = not cut and _mostly_in(nearest, reaches) and _mostly_in(set(frames), reaches)
            weighed = weigh(
                parallax.inverse_depth / standing, parallax.sigma / standing, cut, _LEG if legs_cut else 0.0
            )
            tells = not weighed.contradicts and parallax.sigma < _ON_IT * abs(parallax.inverse_depth)
            shown |= tells
            cut_frames, all_frames = cut_frames + cut * len(frames), all_frames + len(frames)
            at_size = np.full(len(frames), standing)
            if weighed.stands and not cut and not legs_cut:
                is_bound = np.array([frame in sightings.cut_in[label] for frame in frames])
                at_size = np.exp(standing_over_time(np.log(at_size_one), is_bound))
            for frame, inverse in zip(frames, (at_size * size).tolist(), strict=True):
                placed[frame][label] = np.exp(weighed.log_ratio) * inverse
            if tells and not weighed.stands:
                nearer.setdefault(label, []).append(float(np.exp(weighed.log_ratio)))
        is_cut = 2 * cut_frames > all_frames if all_frames else sightings.is_cut(label)
        if is_cut and not shown:
            unknown.append(label)
    return Placed(tuple(placed), {label: float(np.median(ratios)) for label, ratios in nearer.items()}, unknown)


def _mostly_in(frames: set[int], those: set[int]) -> bool:
    return len(frames & those) > _MOSTLY * len(frames)


class Weighed(NamedTuple):
    """What parallax tells of a thing."""

    stands: bool
    log_ratio: float
    """Mean of ``log rho`` if so, or if not."""
    contradicts: bool
    """No ratio explains the parallax: what is said of the thing is what holds for most."""


def weigh(ratio: float, sigma: float, cut: bool, legs: float = 0.0) -> Weighed:
    """Weigh that a thing stands against that it is nearer.

    Args:
        ratio: Inverse depth from parallax over that of the surface below.
        sigma: Its standard deviation; infinite if nothing is known.
        cut: The image cuts the thing off below.
        legs: Log factor by which what stands is nearer, as the image cuts off its legs.
    """
    share = _STANDS_CUT if cut else _STANDS
    standing = np.exp(-0.5 * ((_LOG_RATIO - legs) / _STANDING_SIGMA) ** 2)
    nearer = np.where(_LOG_RATIO >= 0, np.exp(-_LOG_RATIO / _NEARER_MEAN), 0.0)
    standing, nearer = share * standing / standing.sum(), (1 - share) * nearer / nearer.sum()
    likelihood, wrong = np.ones_like(_LOG_RATIO), 0.0
    if np.isfinite(sigma):
        total = np.hypot(_TOO_SURE * sigma, _SHARED * ratio)
        likelihood = np.exp(-0.5 * ((np.exp(_LOG_RATIO) - ratio) / total) ** 2)
        wrong = _MODEL_WRONG / (1 - _MODEL_WRONG) * np.sqrt(2 * np.pi) * total / _NEAREST
    weights = [hypothesis * (likelihood + wrong) for hypothesis in (standing, nearer)]
    stands = bool(weights[0].sum() >= weights[1].sum())
    chosen = weights[0] if stands else weights[1]
    told = float(((standing + nearer) * likelihood).sum())
    # Nothing is behind what it hides: that it seems so comes from errors of the cameras, which make it too far.
    return Weighed(stands, max(float(_LOG_RATIO @ chosen / chosen.sum()), 0.0), told < wrong)
