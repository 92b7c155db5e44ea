"""How long a whole run will still take: expected shares of its tasks, corrected by what they really took."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from uni4d_fg.progress import Reporter

if TYPE_CHECKING:
    from uni4d_fg.config.models import Config
    from uni4d_fg.cues.plan import CuePlan
    from uni4d_fg.frontend.track_model import Tracks

_FIRST_TELLING = 0.06
"""Part of the work that must be done before a time is told."""
_ALMOST = 0.95
_TRUSTED = 0.3
"""Of a task that says how far it is: the part from which on its own pace alone says how long it will take."""


@dataclass(frozen=True)
class Share:
    """A task of a run, and what it is expected to take."""

    task: str
    """As it is told to a reporter."""
    seconds: float
    """On the machine where the costs were measured: only ratios count."""


@dataclass
class Forecast:
    """Follows the tasks of a run. What passes between two tasks is counted as the second one's.

    Args:
        shares: Tasks in the order in which they come; those that are left out, or come that are not among them, do no
            harm.
        clock: Seconds, only ever growing.
    """

    shares: Sequence[Share]
    clock: Callable[[], float] = time.monotonic
    _next: int = 0
    """Shares before it are done, left out, or going on."""
    _current: Share | None = None
    _began: float = 0.0
    """When the current task began."""
    _going: bool = False
    """Whether a task is going on, be it among the shares or not."""
    _since: float | None = None
    """When the last task ended; None before the first."""
    _part: float = 0.0
    """As the current task says."""
    _first: tuple[float, float] | None = None
    """The part that the current task told first, and when: what came before is preparation."""
    _measured: bool = False
    """Whether the current task says how far it is."""
    _expected: float = field(default=0.0)
    """Of the tasks that are finished."""
    _taken: float = field(default=0.0)
    """By the tasks that are finished and among the shares."""

    def begin(self, task: str, total: int | None) -> None:
        """Say that a task begins."""
        self.end()
        self._began, self._part, self._measured = self.clock(), 0.0, bool(total)
        self._since = self._began if self._since is None else self._since
        self._going = True
        self._first = None
        for number in range(self._next, len(self.shares)):
            if self.shares[number].task == task:
                self._current, self._next = self.shares[number], number + 1
                return

    def advance(self, part: float) -> None:
        """Say which part of the current task is done."""
        self._part = min(max(part, 0.0), 1.0)
        self._first = self._first or (self._part, self.clock())

    def end(self) -> None:
        """Say that the current task is finished."""
        if self._current is not None:
            self._expected += self._current.seconds
            self._taken += self._passed()
            self._current = None
        if self._going:
            self._since = self.clock()
        self._going = False

    def state(self) -> tuple[float, float | None]:
        """Return the part of the work that is done, and the seconds that are left; None while nobody can know."""
        rest = sum(share.seconds for share in self.shares[self._next :])
        current = 0.0 if self._current is None else self._current.seconds
        inside = self._inside()
        done = self._expected + inside * current
        whole = self._expected + current + rest
        if whole <= 0.0 or done < _FIRST_TELLING * whole:
            return (done / whole if whole > 0.0 else 0.0), None
        pace = self._pace()
        return done / whole, pace * rest + self._left_here(pace * current, inside)

    def _passed(self) -> float:
        """Return the seconds of the current task, with those before it that are counted as its own."""
        return self.clock() - (self._began if self._since is None else self._since)

    def _pace(self) -> float:
        """Return the seconds that an expected second takes: by what is finished, and what a task says is."""
        expected, taken = self._expected, self._taken
        if self._measured and self._current is not None and self._first is not None:
            part, began = self._first if self._expected else (0.0, self._began)
            expected += (self._part - part) * self._current.seconds
            taken += self.clock() - began
        return taken / expected if expected > 0.0 else 1.0

    def _inside(self) -> float:
        """Return the part of the current task that is done: as it says, or by the pace of those before it."""
        if self._current is None:
            return 0.0
        if self._measured:
            return self._part
        pace = self._taken / self._expected if self._expected else 1.0
        return min(self._passed() / max(pace * self._current.seconds, 1e-9), _ALMOST)

    def _left_here(self, expected: float, inside: float) -> float:
        """Return the seconds that the current task will still take: more and more by its own pace, where it has one.

        Args:
            expected: Seconds of the whole task, by the pace of all.
            inside: Part of it that is done.
        """
        left = (1.0 - inside) * expected
        if not self._measured or self._first is None or self._part <= self._first[0]:
            return left
        part, began = self._first
        own = (self.clock() - began) * (1.0 - self._part) / (self._part - part)
        weight = min(self._part / _TRUSTED, 1.0)
        return weight * own + (1.0 - weight) * left


@dataclass
class ForecastReporter:
    """Tells another reporter what it is told, and a forecast as well."""

    inner: Reporter
    forecast: Forecast
    show: Callable[[], None] = lambda: None
    """Called whenever the forecast may have changed."""
    _total: int | None = None

    def begin(self, task: str, total: int | None) -> None:
        """A task starts."""
        self._total = total
        self.forecast.begin(task, total)
        self.inner.begin(task, total)
        self.show()

    def advance(self, done: int, text: str = "") -> None:
        """Work of the current task is done."""
        if self._total:
            self.forecast.advance(done / self._total)
        self.inner.advance(done, text)
        self.show()

    def end(self, text: str = "") -> None:
        """The current task is finished."""
        self.forecast.end()
        self.inner.end(text)
        self.show()


def expected_shares(
    num_frames: int, image_size: tuple[int, int], config: Config, plan: CuePlan, tracks: Tracks | None
) -> list[Share]:
    """Return the tasks of a reconstruction.

    The costs are seconds on two cores of videos of 24 to 60 frames of 0.08 to 0.3 megapixels: a constant, and so much
    per megapixel of the whole video. How many points there are is not known before, nor whether a depth cue is so wrong
    that depth is matched between frames, which makes fusion three to four times as long: what is expected with
    a given one is off by about the same factor for the whole run, too little if it is bad and too much if it is good.

    Args:
        num_frames: T.
        image_size: (height, width), px.
        config: Which stages there are.
        plan: Which cues are made.
        tracks: Those that the video brings.
    """
    from uni4d_fg.pipeline.lens import is_readout_sought  # loads the solvers

    size = num_frames * image_size[0] * image_size[1] / 1e6
    tracking = 0.55 + 0.2 * size
    shares: list[Share] = []

    def add(task: str, constant: float, per_megapixel: float) -> None:
        shares.append(Share(task, constant + per_megapixel * size))

    moved = plan.depth == "geometry"
    if not plan.is_given:
        if tracks is None:
            shares.append(Share("tracks", tracking))
        if moved:
            _motion(add)
        if plan.masks == "motion":
            add("motion of tracks", 0.8, 0.16)
            add("motion masks", 0.25, 0.28)
            add("masks to disk", 0.04, 0.01)
            if moved:
                _motion(add)
    known = tracks is not None or not plan.is_given
    shares.append(Share("tracks", 0.05 + 0.02 * size if known else tracking))
    if is_readout_sought(config):
        add("rolling shutter", 0.25 if moved else 0.48, 0.009)
    if not moved:  # of a camera that motion told, structure from motion has found the lens
        add("lens", 0.42, 0.016)
    add("camera init", 0.15, 0.0)
    if tracks is None:
        add("bundle adjustment", 0.6, 0.16)
    else:
        add("bundle adjustment", 0.1 + 6e-6 * float(np.count_nonzero(tracks.visible)), 0.0)
    add("nonrigid", 0.5, 0.03)
    if config.joint.enabled:
        add("joint", 0.5, 0.6)
    add("fusion", 3.4 + 0.01 * num_frames if moved else 2.1 + 0.013 * num_frames, 0.08 if moved else 0.105)
    add("clouds and pictures", 1.35, 0.035)
    return shares


def _motion(add: Callable[[str, float, float], None]) -> None:
    """Add the tasks of depth from camera motion."""
    add("starting views", 0.62, 0.028)
    add("structure from motion", 0.19, 0.031)
    add("camera refinement", 0.36, 0.02)
    add("focal lengths", 0.07, 0.008)
    add("depth of moving things", 0.22, 0.045)
    add("depth maps", 0.12, 0.045)
