"""Cuts of a video, found by what is seen again on their other side.

Two frames are connected where the corners of one are found in the other
(:mod:`uni4d_fg.frontend.shots.links`). A hard cut is a place that no pair of frames around it connects: a flash, a change of
exposure or a frame that shows nothing is bridged by the frames beside it, and a whip pan by the overlap of its
frames. Across a dissolve every frame is connected with the next, but the two ends of it are not, and what lies between
is a blend of them, ``I_s = alpha A + beta B + c`` (both moved along with the camera).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.shots import ShotsConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.shots.links import SmallFrame, link, pan_between, small_frame

_REST = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_BLUR_PX = 2.0
_PURE = 0.08
"""Share of the other shot that cannot be seen."""


@dataclass(frozen=True, order=True)
class Cut:
    """One change of shot. Frames ``stop`` to ``start - 1`` are of neither: a blend, black or white; none at a hard cut."""

    stop: int
    """First frame that is not of the shot before."""
    start: int
    """First frame of the shot behind."""

    @property
    def frame(self) -> int:
        """The middle of it; at a hard cut the first frame of the shot behind."""
        return (self.stop + self.start) // 2


def find_cuts(
    images: FrameSource[ImageArray], config: ShotsConfig, should_stop: Callable[[], bool] | None = None
) -> tuple[Cut, ...]:
    """Find the cuts of a video, in order; each frame is read once.

    Args:
        images: T images (H, W, 3) or (H, W), uint8.
        config: Sizes and checks.
        should_stop: Asked before every frame.

    Raises:
        InputError: If a frame cannot be read.
        Cancelled: If ``should_stop`` said so.
    """
    frames = []
    for number, image in enumerate(images):
        if should_stop is not None and should_stop():
            raise Cancelled(f"the search for cuts stopped at frame {number} of {len(images)}")
        frames.append(small_frame(image, config))
    if len(frames) < 2:
        return ()
    return _Search(frames, config).run()


@dataclass(frozen=True)
class _Dissolve:
    cut: Cut
    quality: float


class _Search:
    def __init__(self, frames: list[SmallFrame], config: ShotsConfig) -> None:
        self.frames, self.config = frames, config
        self.motion: list[FloatArray] = [_REST]
        """From the frame before."""
        self.broken: list[bool] = [False]

    def run(self) -> tuple[Cut, ...]:
        for t in range(1, len(self.frames)):
            connected, motion = self.connected(t - 1, t)
            self.broken.append(not connected)
            self.motion.append(motion if connected else _REST)
        hard = merged(self.hard_cuts(), self.config.look_around)
        soft = [d.cut for d in self.dissolves()]
        # A short dissolve is found both ways, and its extent by the second.
        alone = [c for c in hard if not any(d.stop - 2 <= c.start and c.stop <= d.start + 2 for d in soft)]
        return tuple(merged(sorted([*alone, *soft]), self.config.look_around))

    def connected(self, a: int, b: int) -> tuple[bool, FloatArray]:
        """Tell whether two frames show one scene, and how pixels of the one move to the other."""
        one, other = self.frames[a], self.frames[b]
        if not (one.shows_something and other.shows_something):
            return False, _REST
        config = self.config
        best = link(one, other, _REST, config)
        if best.found >= config.max_broken:
            return True, best.source_T_target
        similarity, shift = pan_between(one, other, config.min_overlap)
        return similarity >= config.pan_similarity, shift

    def hard_cuts(self) -> list[Cut]:
        shows = [frame.shows_something for frame in self.frames]
        seen = np.flatnonzero(shows)
        cuts = []
        for before, behind in zip(seen[:-1].tolist(), seen[1:].tolist(), strict=True):
            if (behind == before + 1 and not self.broken[behind]) or self.is_bridged(before, behind):
                continue
            cuts.append(Cut(before + 1, behind))
        return cuts

    def is_bridged(self, before: int, behind: int) -> bool:
        """Tell whether any frame up to ``before`` is connected with any from ``behind`` on, near by."""
        reach = self.config.look_around
        for i, j in sorted({(0, k) for k in range(reach)} | {(k, 0) for k in range(reach)}, key=sum):
            a, b = before - i, behind + j
            if (i or j or behind > before + 1) and a >= 0 and b < len(self.frames) and self.connected(a, b)[0]:
                return True
        return False

    def dissolves(self) -> list[_Dissolve]:
        found: list[_Dissolve] = []
        for span in self.config.dissolve_spans:
            for a in range(0, len(self.frames) - span, max(1, span // 4)):
                candidate = self.dissolve(a, a + span)
                if candidate is not None:
                    found.append(candidate)
        kept: list[_Dissolve] = []
        for candidate in sorted(found, key=lambda d: (-d.quality, d.cut)):
            if all(candidate.cut.start <= k.cut.stop or k.cut.start <= candidate.cut.stop for k in kept):
                kept.append(candidate)
        return sorted(kept, key=lambda d: d.cut)

    def dissolve(self, a: int, b: int) -> _Dissolve | None:
        """Return the dissolve that lies between two frames, if there is one."""
        one, other = self.frames[a], self.frames[b]
        if not (one.shows_something and other.shows_something):
            return None
        for guess in (_REST, self.accumulated(a, b)):
            across = link(one, other, guess, self.config)
            if across.overlap < self.config.min_overlap or across.found > self.config.max_dissolve_link:
                return None
        if pan_between(one, other, self.config.min_overlap)[0] >= self.config.pan_similarity:
            return None
        shares, explained = self.blend(a, b)
        mixed = (shares > 0.15) & (shares < 0.85)
        if mixed.sum() < 2 or explained[mixed].mean() < self.config.min_blend:
            return None
        if np.corrcoef(shares, np.arange(len(shares)))[0, 1] < 0.8 or shares[0] > 0.3 or shares[-1] < 0.7:
            return None
        # The ends are blends as well where the dissolve is longer than the span: its rate tells how far it goes.
        rate, offset = np.polyfit(np.flatnonzero(mixed) + a + 1.0, shares[mixed], 1)
        if rate <= 0.0:
            return None
        stop = int(np.clip(np.ceil((_PURE - offset) / rate), a + 1, b))
        start = int(np.clip(np.floor((1.0 - _PURE - offset) / rate) + 1, stop, b))
        return _Dissolve(Cut(stop, start), float(explained.mean()))

    def accumulated(self, a: int, b: int) -> FloatArray:
        """Return the (2, 3) motion of pixels from one frame to a later one, step by step."""
        total = np.eye(3)
        for t in range(a + 1, b + 1):
            total = np.vstack((self.motion[t], [0.0, 0.0, 1.0])) @ total
        return total[:2]

    def blend(self, a: int, b: int) -> tuple[FloatArray, FloatArray]:
        """Fit the frames between two as blends of them.

        Returns:
            shares: (b - a - 1,) of the second in each, 0 to 1.
            explained: (b - a - 1,) part of its variance that the blend explains.
        """
        shares, explained = [], []
        height, width = self.frames[a].size
        everywhere = np.full((height, width), 255, np.uint8)
        for s in range(a + 1, b):
            forth = self.accumulated(a, s)
            back = cv2.invertAffineTransform(self.accumulated(s, b))
            valid = (cv2.warpAffine(everywhere, forth, (width, height)) > 254) & (
                cv2.warpAffine(everywhere, back, (width, height)) > 254
            )
            images = (
                cv2.warpAffine(self.frames[a].gray, forth, (width, height), borderMode=cv2.BORDER_REPLICATE),
                cv2.warpAffine(self.frames[b].gray, back, (width, height), borderMode=cv2.BORDER_REPLICATE),
                self.frames[s].gray,
            )
            first, second, middle = (
                cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX)[valid].astype(np.float64)
                for image in images
            )
            if valid.mean() < 0.2:
                shares.append(0.0)
                explained.append(0.0)
                continue
            columns = np.stack((first - first.mean(), second - second.mean()), axis=1)
            right = middle - middle.mean()
            weights = np.linalg.lstsq(columns, right, rcond=None)[0]
            rest = right - columns @ weights
            alpha, beta = np.maximum(weights, 0.0)
            shares.append(beta / max(alpha + beta, 1e-9))
            explained.append(1.0 - float(rest @ rest) / max(float(right @ right), 1e-9))
        return np.array(shares), np.array(explained)


def merged(cuts: list[Cut], distance: int) -> list[Cut]:
    """Join cuts that leave no shot of ``distance`` frames between them."""
    result: list[Cut] = []
    for cut in sorted(cuts):
        if result and cut.stop - result[-1].start < distance:
            result[-1] = Cut(result[-1].stop, max(cut.start, result[-1].start))
        else:
            result.append(cut)
    return result
