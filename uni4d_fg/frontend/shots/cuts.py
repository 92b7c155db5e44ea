"""Cuts of a video, found by what is seen again on their other side.

Two frames are connected where the corners of one are found in the other
(:mod:`uni4d_fg.frontend.shots.links`). A hard cut is a place that no pair of frames around it connects: a flash, a
change of exposure or a frame that shows nothing is bridged by the frames beside it, and a whip pan by the overlap of
its frames. Across a dissolve every frame is connected with the next, but no corner lasts from one end of it to the
other (:mod:`uni4d_fg.frontend.shots.survival`), and what lies between is a blend of both,
``I_s = alpha A + beta B + c`` (both moved along with the camera). In ordinary motion A and B show the same things, so
that both together explain hardly more of a frame between them than one of them does; in a dissolve they do not.

Small images do for almost all of that. But grass and leaves have corners that are lost in them at every step, so that
what is found is looked for once more in larger images of the frames around it, and must be seen there, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.shots import ShotsConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.shots.links import SmallFrame, link, pan_between, small_frame
from uni4d_fg.frontend.shots.one_place import show_one_place
from uni4d_fg.frontend.shots.survival import Span, spans
from uni4d_fg.optim.threads import map_in_order, thread_count

_REST = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_BLUR_PX = 2.0
_PURE = 0.08
"""Share of the other shot that cannot be seen."""
_BLENDED = 2
"""Frames beyond both ends of a dissolve that may still be a blend."""
_MUCH_EXPLAINED = 0.5
"""Of the variance of a dissolve's frames: an orbit of two degrees a frame around dancers has 0.38."""


@dataclass(frozen=True, order=True)
class Cut:
    """One change of shot. Frames ``stop`` to ``start - 1`` are of neither (a blend, black); none at a hard cut."""

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
    """Find the cuts of a video, in order; each frame is read once, and those around a cut once more.

    Args:
        images: T images (H, W, 3) or (H, W), uint8.
        config: Sizes and checks.
        should_stop: Asked before every frame.

    Raises:
        InputError: If a frame cannot be read.
        Cancelled: If ``should_stop`` said so.
    """
    frames = _small_frames(images, range(len(images)), config, should_stop)
    if len(frames) < 2:
        return ()
    search = _Search(frames, config)
    return tuple(
        cut for cut in search.run() if _is_confirmed(cut, search.explained.get(cut, 1.0), images, config, should_stop)
    )


def _small_frames(
    images: FrameSource[ImageArray], which: range, config: ShotsConfig, should_stop: Callable[[], bool] | None
) -> list[SmallFrame]:
    """Read frames and make them small, one after the other."""
    frames = []
    for number in which:
        if should_stop is not None and should_stop():
            raise Cancelled(f"the search for cuts stopped at frame {number} of {len(images)}")
        frames.append(small_frame(images[number], config))
    return frames


def _is_confirmed(
    cut: Cut,
    explained: float,
    images: FrameSource[ImageArray],
    config: ShotsConfig,
    should_stop: Callable[[], bool] | None,
) -> bool:
    """Tell whether a cut is found in larger images of the frames around it as well.

    A dissolve of which a blend explains much need not be found there if no corner outlives it: corners do not outlive a
    fast orbit either. And its ends must not show one place, as those of a fast pan do, in whose blur corners are lost.
    """
    is_soft = cut.start > cut.stop
    reach = max(config.dissolve_spans) if is_soft else 2 * config.look_around
    around = range(max(0, cut.stop - reach), min(len(images), cut.start + reach))
    larger = config.model_copy(update={"width": config.confirming_width})
    search = _Search(_small_frames(images, around, larger, should_stop), larger)
    there = Cut(cut.stop - around.start, cut.start - around.start)
    if is_soft:
        first, last = max(0, cut.stop - 1 - _BLENDED), min(len(images) - 1, cut.start + _BLENDED)
        if show_one_place(images[first], images[last]):
            return False
    found = any(c.stop <= there.start and there.stop <= c.start for c in search.run())
    return found or (is_soft and explained >= _MUCH_EXPLAINED and not search.is_outlived(there))


@dataclass(frozen=True)
class _Dissolve:
    cut: Cut
    is_whole: bool
    """Both ends of the span are beyond it."""
    explained: float
    """Part of the variance of its frames that a blend explains."""
    rank: tuple[float, float]
    """The lowest is believed: the steepest change, in the middle of its span."""


class _Search:
    def __init__(self, frames: list[SmallFrame], config: ShotsConfig) -> None:
        self.frames, self.config = frames, config
        self.motion: list[FloatArray] = [_REST]
        """From the frame before."""
        self.broken: list[bool] = [False]
        self.followed: list[bool] = [False]
        """Whether corners were found again in it: not in the blur of a pan."""
        self.gaps: list[Span] = []
        """Where corners could not be followed, nor be found again soon."""
        self.explained: dict[Cut, float] = {}
        """Part of the variance of the frames of each dissolve that a blend explains; known after :meth:`run`."""

    def run(self) -> tuple[Cut, ...]:
        steps = map_in_order(self.step, list(range(1, len(self.frames))), thread_count())
        for connected, followed, motion in steps:
            self.broken.append(not connected)
            self.followed.append(followed)
            self.motion.append(motion if connected else _REST)
        hard = merged(self.hard_cuts(), self.config.look_around)
        sharp = [cut for cut in hard if self.is_sharp(cut)]
        soft = [d for d in self.dissolves() if all(cut.start < d.stop or d.start < cut.stop for cut in sharp)]
        # A short dissolve is found both ways, and its extent by the second.
        alone = [c for c in hard if not any(d.stop - 2 <= c.start and c.stop <= d.start + 2 for d in soft)]
        return tuple(merged(sorted([*alone, *soft]), self.config.look_around))

    def step(self, t: int) -> tuple[bool, bool, FloatArray]:
        """Return whether a frame is connected with the one before, whether corners are found again, and the motion."""
        connected, motion = self.connected(t - 1, t)
        return connected, connected and self.has_corners(t - 1, t, motion), motion

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

    def has_corners(self, a: int, b: int, motion: FloatArray) -> bool:
        """Tell whether corners of one frame are found in the other, with what is known of the motion."""
        return link(self.frames[a], self.frames[b], motion, self.config).found >= self.config.max_broken

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

    def is_sharp(self, cut: Cut) -> bool:
        """Tell whether the frames up to a cut show nothing of what is behind it, and the other way round."""
        a, b = cut.stop - 3, cut.start + 2
        if cut.stop != cut.start or a < 0 or b >= len(self.frames):
            return False
        shares, _, _ = self.blend(a, b)
        return bool(shares[:2].max() < 0.25 and shares[2:].min() > 0.75)

    @cached_property
    def spans(self) -> list[Span]:
        """What became of corners across the video, between its gaps; which are known afterwards."""
        return list(spans(self.frames, self.steps(), self.config))

    def is_outlived(self, cut: Cut) -> bool:
        """Tell whether more corners outlive the shortest spans across a dissolve than do if it is one."""
        across = [s for s in self.spans if s.first < cut.stop and s.last >= cut.start]
        shortest = min((s.last - s.first for s in across), default=0)
        return bool(across) and all(s.alive > 2.0 * self.surviving(s) for s in across if s.last - s.first == shortest)

    def surviving(self, span: Span) -> float:
        """Return the part of the corners that outlives a span across a dissolve, at most.

        The longer the span, the fewer corners outlive it in a video without any cut.
        """
        return self.over(self.config.max_surviving, span)

    @cached_property
    def usually_alive(self) -> dict[int, float]:
        """The part of the corners that outlives spans of each length where most do.

        From the window of a train few corners outlive any half of a second, and that says nothing of a dissolve.
        """
        alive: dict[int, list[float]] = {}
        for span in self.spans:
            alive.setdefault(span.last - span.first, []).append(span.alive)
        return {length: float(np.quantile(parts, 0.75)) for length, parts in alive.items()}

    def over(self, limit: float, span: Span) -> float:
        """Return a limit that holds over the shortest span for another one, in proportion to how much longer it is."""
        return limit * min(self.config.dissolve_spans) / (span.last - span.first)

    def dissolves(self) -> list[Cut]:
        found: list[_Dissolve] = []
        for span in [*self.spans, *self.gaps]:
            limit = self.surviving(span)
            candidate = self.dissolve(span) if span.alive <= 2.0 * limit else None
            few = span.alive <= limit and self.usually_alive.get(span.last - span.first, 1.0) > 2.0 * limit
            if candidate is not None and (few or candidate.explained >= self.config.sure_blend):
                found.append(candidate)
        believed: list[_Dissolve] = []
        apart = self.config.look_around
        for candidate in sorted(found, key=lambda d: d.rank):
            first, last = candidate.cut.stop - apart, candidate.cut.start + apart
            if all(last <= other.cut.stop or other.cut.start <= first for other in believed):
                believed.append(candidate)
        kept = [dissolve.cut for dissolve in believed]
        self.explained = {self.extended(dissolve.cut, kept, found): dissolve.explained for dissolve in believed}
        return sorted(self.explained)

    @staticmethod
    def extended(cut: Cut, kept: list[Cut], found: list[_Dissolve]) -> Cut:
        """Return a dissolve as the spans saw it that hold the whole of it, and no other."""
        wider = [
            d.cut
            for d in found
            if d.is_whole
            and d.cut.stop <= cut.frame <= d.cut.start
            and d.cut.start - d.cut.stop <= 3 * (cut.start - cut.stop)
            and all(other == cut or other.start <= d.cut.stop or d.cut.start <= other.stop for other in kept)
        ]
        return min(wider, key=lambda c: c.start - c.stop, default=cut)

    def steps(self) -> list[int | None]:
        """Return from where corners are followed to each frame, as :func:`spans` takes it."""
        steps: list[int | None] = [None]
        last = 0
        limit = self.config.max_motion * max(self.frames[0].size)
        for t in range(1, len(self.frames)):
            if last == t - 1 and not self.broken[t]:
                fast = float(np.hypot(*self.motion[t][:, 2])) > limit
                steps.append(None if fast or not self.followed[t] else last)
                last = t
            elif last < t - 1 and self.connected(last, t)[0]:
                steps.append(last)
                last = t
            elif t - last <= self.config.look_around:
                steps.append(t)
            else:
                self.gaps.append(Span(max(0, last - 3), min(t + 3, len(self.frames) - 1), 0.0))
                steps.append(None)
                last = t
        return steps

    def dissolve(self, span: Span) -> _Dissolve | None:
        """Return the dissolve that lies between two frames, if what is between them looks like one."""
        a, b = span.first, span.last
        if self.connected(a, b)[0]:
            return None
        shares, explained, gained = self.blend(a, b)
        # A flash within is neither side.
        shares = cv2.medianBlur(shares.astype(np.float32)[None], 5)[0].astype(np.float64)
        numbers = np.arange(a + 1, b)
        mixed = (shares > 0.1) & (shares < 0.9)
        if shares[0] > 0.4 or shares[-1] < 0.6 or mixed.sum() < 2:
            return None
        # The ends are blends as well where the dissolve is longer than the span: its rate tells how far it goes.
        rate, offset = np.polyfit(numbers[mixed], shares[mixed], 1)
        if rate <= 0.0:
            return None
        stop = int(np.clip(np.ceil((_PURE - offset) / rate), a + 1, b))
        start = int(np.clip(np.floor((1.0 - _PURE - offset) / rate) + 1, stop, b))
        if stop == a + 1 and start >= b - 1:
            return None  # ordinary motion fades from one end of a span to the other like this
        if start > stop and gained[stop - a - 1 : start - a - 1].max() < self.config.min_blend_gain:
            return None
        is_whole = bool(shares[1] < 0.1 and shares[-2] > 0.9 and stop > a + 1 and start < b)
        off_center = abs(stop + start - a - b) / (b - a)
        quality = float(explained[mixed].mean())
        # What moves between frames is followed by one affine motion, the less well the longer the span is.
        if quality < self.over(self.config.min_explained, span):
            return None
        return _Dissolve(Cut(stop, start), is_whole, quality, ((start - stop) * (1.0 if is_whole else 1.5), off_center))

    def accumulated(self, a: int, b: int) -> FloatArray:
        """Return the (2, 3) motion of pixels from one frame to a later one, step by step."""
        total = np.eye(3)
        for t in range(a + 1, b + 1):
            total = np.vstack((self.motion[t], [0.0, 0.0, 1.0])) @ total
        return total[:2]

    def blend(self, a: int, b: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fit the frames between two as blends of them.

        Returns:
            shares: (b - a - 1,) of the second in each, 0 to 1.
            explained: (b - a - 1,) part of its variance that the blend explains.
            gained: (b - a - 1,) how much more of it that is than one of the two explains.
        """
        shares, explained, gained = [], [], []
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
                gained.append(0.0)
                continue
            columns = np.stack((first - first.mean(), second - second.mean()), axis=1)
            right = middle - middle.mean()
            weights = np.linalg.lstsq(columns, right, rcond=None)[0]
            rest = right - columns @ weights
            alpha, beta = np.maximum(weights, 0.0)
            shares.append(beta / max(alpha + beta, 1e-9))
            variance = max(float(right @ right), 1e-9)
            explained.append(1.0 - float(rest @ rest) / variance)
            alone = (columns.T @ right) ** 2 / np.maximum((columns**2).sum(axis=0), 1e-9) / variance
            gained.append(explained[-1] - float(alone.max()))
        return np.array(shares), np.array(explained), np.array(gained)


def merged(cuts: list[Cut], distance: int) -> list[Cut]:
    """Join cuts that leave no shot of ``distance`` frames between them."""
    result: list[Cut] = []
    for cut in sorted(cuts):
        if result and cut.stop - result[-1].start < distance:
            result[-1] = Cut(result[-1].stop, max(cut.start, result[-1].start))
        else:
            result.append(cut)
    return result
