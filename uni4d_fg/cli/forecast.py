"""How long a whole run will still take: expected shares of its tasks, corrected by what they really took."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from uni4d_fg.progress import Reporter

if TYPE_CHECKING:
    from uni4d_fg.config.models import Config
    from uni4d_fg.cues.plan import CuePlan

_FIRST_TELLING = 0.06
"""Part of the work that must be done before a time is told."""
_ALMOST = 0.95


@dataclass(frozen=True)
class Share:
    """A task of a run, and what it is expected to take."""

    task: str
    """As it is told to a reporter."""
    seconds: float
    """On the machine where the costs were measured: only ratios count."""


@dataclass
class Forecast:
    """Follows the tasks of a run.

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
    _part: float = 0.0
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
        for number in range(self._next, len(self.shares)):
            if self.shares[number].task == task:
                self._current, self._next = self.shares[number], number + 1
                return

    def advance(self, part: float) -> None:
        """Say which part of the current task is done."""
        self._part = min(max(part, 0.0), 1.0)

    def end(self) -> None:
        """Say that the current task is finished."""
        if self._current is not None:
            self._expected += self._current.seconds
            self._taken += self.clock() - self._began
        self._current = None

    def state(self) -> tuple[float, float | None]:
        """Return the part of the work that is done, and the seconds that are left; None while nobody can know."""
        rest = sum(share.seconds for share in self.shares[self._next :])
        done, taken, here = self._expected, self._taken, 0.0
        if self._current is not None:
            inside = self.clock() - self._began
            taken += inside
            here = self._current.seconds * self._inside(inside)
            rest += self._current.seconds - here
        done += here
        whole = done + rest
        if whole <= 0.0:
            return 0.0, None
        part = done / whole
        return part, (rest * taken / done if part >= _FIRST_TELLING else None)

    def _inside(self, seconds: float) -> float:
        """Return the part of the current task that is done: as it says, or by the pace of those before it."""
        if self._measured:
            return self._part
        assert self._current is not None
        pace = self._taken / self._expected if self._expected else 1.0
        return min(seconds / max(pace * self._current.seconds, 1e-9), _ALMOST)


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
    num_frames: int, image_size: tuple[int, int], config: Config, plan: CuePlan, *, has_tracks: bool
) -> list[Share]:
    """Return the tasks of a reconstruction.

    The costs were measured on videos of 10 to 60 frames of 0.08 to 0.3 megapixels; they are per megapixel of the whole
    video, beside a constant. How many points there are is not known before.

    Args:
        num_frames: T.
        image_size: (height, width), px.
        config: Which stages there are.
        plan: Which cues are made.
        has_tracks: The video brings tracks.
    """
    size = num_frames * image_size[0] * image_size[1] / 1e6
    tracking = 0.1 + 0.43 * size
    shares: list[Share] = []

    def add(task: str, constant: float, per_megapixel: float) -> None:
        shares.append(Share(task, constant + per_megapixel * size))

    moved = plan.depth == "geometry"
    if not plan.is_given:
        if not has_tracks:
            shares.append(Share("tracks", tracking))
        if moved:
            _motion(add)
        if plan.masks == "motion":
            add("motion of tracks", 0.5, 0.8)
            add("motion masks", 0.2, 0.3)
            add("masks to disk", 0.1, 0.02)
            if moved:
                _motion(add)
    known = has_tracks or not plan.is_given
    shares.append(Share("tracks", 0.1 + 0.03 * size if known else tracking))
    add("lens", 1.8, 0.02)
    add("camera init", 0.2, 0.01)
    add("bundle adjustment", 1.3, 0.46)
    add("nonrigid", 0.3, 0.12)
    if config.joint.enabled:
        add("joint", 0.5, 0.6)
    add("fusion", 1.0, 0.4)
    add("clouds and pictures", 3.0, 0.2)
    return shares


def _motion(add: Callable[[str, float, float], None]) -> None:
    """Add the tasks of depth from camera motion."""
    add("structure from motion", 1.0, 2.5)
    add("depth of moving things", 0.1, 0.2)
    add("depth maps", 0.1, 0.15)
