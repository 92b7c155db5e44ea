"""Line charts as inline SVG that take their colors from the page."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uni4d_fg.results.report.markup import Markup, element, number

_WIDTH, _HEIGHT = 440, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 12, 14, 42
_DASHES = (None, "6 3", "2 3", "8 3 2 3", "1 4", "10 4")
_MAX_POINTS = 400
_LOG_MARGIN = math.log10(1.1)
_LARGEST, _SMALLEST = 1e300, 1e-300
"""Values beyond are left out: the axes' arithmetic would leave the range of numbers."""


@dataclass(frozen=True)
class Line:
    """One curve; y may hold NaN, where it is broken, as it is at numbers that cannot be drawn."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


def line_chart(
    identifier: str, title: str, lines: Sequence[Line], *, x_label: str, y_label: str, log: bool = False
) -> Markup:
    """Draw curves over a common x axis, told apart by color and by dashes.

    Args:
        identifier: Unique in the page; ids in the chart begin with it.
        title: Read out in place of the picture; the range of each curve follows it.
        lines: The curves.
        x_label: Name of the x axis.
        y_label: Name of the y axis, with its unit.
        log: Logarithmic y axis; values that are not positive are left out.
    """
    curves = [_clean(line, log) for line in lines]
    xs = np.concatenate([x for x, _ in curves]) if curves else np.zeros(0)
    ys = np.concatenate([y for _, y in curves]) if curves else np.zeros(0)
    ys = ys[np.isfinite(ys)]
    if not ys.size:
        return element("p", f"{title}: nothing to draw.", class_="muted")
    x_low, x_high = _widen(float(xs.min()), float(xs.max()))
    if log:
        y_low, y_high = _widen(math.log10(ys.min()) - _LOG_MARGIN, math.log10(ys.max()) + _LOG_MARGIN)
        ticks = [(math.log10(value), value) for value in _log_ticks(10**y_low, 10**y_high)]
    else:
        y_low, y_high = _widen(1.05 * min(0.0, float(ys.min())), 1.05 * max(0.0, float(ys.max())))
        ticks = [(value, value) for value in nice_ticks(y_low, y_high)]

    def at_x(value: float) -> float:
        return _LEFT + (value - x_low) / (x_high - x_low) * (_WIDTH - _LEFT - _RIGHT)

    def at_y(value: float) -> float:
        return _HEIGHT - _BOTTOM - (value - y_low) / (y_high - y_low) * (_HEIGHT - _TOP - _BOTTOM)

    parts: list[Markup] = []
    for level, value in ticks:
        y = at_y(level)
        parts.append(element("line", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=f"{y:.1f}", y2=f"{y:.1f}", class_="grid"))
        parts.append(element("text", number(value), x=_LEFT - 6, y=f"{y + 4:.1f}", text_anchor="end", class_="tick"))
    for value in nice_ticks(x_low, x_high, whole=True):
        place: dict[str, str | int] = {"x": f"{at_x(value):.1f}", "y": _HEIGHT - _BOTTOM + 16}
        parts.append(element("text", f"{value:.4g}", **place, text_anchor="middle", class_="tick"))
    parts.append(element("text", x_label, x=(_LEFT + _WIDTH - _RIGHT) / 2, y=_HEIGHT - 6, text_anchor="middle"))
    parts.append(
        element(
            "text",
            y_label,
            x=12,
            y=(_TOP + _HEIGHT - _BOTTOM) / 2,
            text_anchor="middle",
            transform=f"rotate(-90 12 {(_TOP + _HEIGHT - _BOTTOM) / 2})",
        )
    )
    for index, (across, up) in enumerate(curves):
        levels = np.log10(up) if log else up
        path = _path([(at_x(a), at_y(b)) for a, b in zip(across.tolist(), levels.tolist(), strict=True)])
        parts.append(element("path", d=path, class_="line", **_look(index)))
    described = f"{title}. " + " ".join(_describe(line.name, y) for line, (_, y) in zip(lines, curves, strict=True))
    chart = svg(identifier, title, described, _WIDTH, _HEIGHT, parts)
    return element("div", chart, legend([line.name for line in lines])) if len(lines) > 1 else chart


def svg(identifier: str, title: str, description: str, width: int, height: int, parts: Sequence[Markup]) -> Markup:
    """Return a drawing with a title and a description for those who cannot see it."""
    return element(
        "svg",
        element("title", title, id=f"{identifier}-name"),
        element("desc", description, id=f"{identifier}-text"),
        *parts,
        viewBox=f"0 0 {width} {height}", role="img", aria_labelledby=f"{identifier}-name {identifier}-text",
    )  # fmt: skip


def legend(names: Sequence[str]) -> Markup:
    """Return the names of curves beside a piece of each."""
    entries = []
    for index, name in enumerate(names):
        sample = element("line", x1=0, x2=29, y1=6, y2=6, class_="line", **_look(index))
        entries.append(element("li", element("svg", sample, viewBox="0 0 29 12", aria_hidden="true"), name))
    return element("ul", *entries, class_="legend")


def nice_ticks(low: float, high: float, *, count: int = 5, whole: bool = False) -> list[float]:
    """Return about ``count`` round numbers within a range; whole ones if asked for; none where digits do not reach."""
    if not max(1e-12 * max(abs(low), abs(high)), sys.float_info.min) < high - low < math.inf:
        return []
    step = 10.0 ** math.floor(math.log10((high - low) / count))
    for factor in (1, 2, 5, 10):
        if (high - low) / (factor * step) <= count:
            step *= factor
            break
    if whole:
        step = max(1.0, round(step))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for mantissas in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)):
        found = [m * 10.0**e for e in decades for m in mantissas if low <= m * 10.0**e <= high]
        if len(found) >= 3:
            return found[:: max(1, len(found) // 6)]
    return nice_ticks(low, high, count=4)


def _clean(line: Line, log: bool) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.asarray(line.x, dtype=np.float64), np.array(line.y, dtype=np.float64)
    step = max(1, -(-len(x) // _MAX_POINTS))
    x, y = x[::step], y[::step]
    shown = np.abs(x) < _LARGEST  # False for NaN
    x, y = x[shown], y[shown]
    y[~(np.abs(y) < _LARGEST) | (log & (y < _SMALLEST))] = np.nan
    return x, y


def _widen(low: float, high: float) -> tuple[float, float]:
    """Return a range with room for ticks, also where all values are alike up to their last digits."""
    room = max(abs(low), abs(high)) * 1e-6
    if high - low > room:
        return low, high
    return low - max(0.5, room), high + max(0.5, room)


def _path(points: list[tuple[float, float]]) -> str:
    out, pen = [], "M"
    for x, y in points:
        if not math.isfinite(y):
            pen = "M"
            continue
        out.append(f"{pen}{x:.1f} {y:.1f}")
        pen = "L"
    # A single point would not be seen; a line of no length with round ends is.
    return "".join(out) + ("h0" if len(out) == 1 else "")


def _look(index: int) -> dict[str, str | None]:
    return {"stroke": f"var(--c{index % 6 + 1})", "stroke_dasharray": _DASHES[index % len(_DASHES)]}


def _describe(name: str, y: np.ndarray) -> str:
    known = y[np.isfinite(y)]
    if not known.size:
        return f"{name}: no values."
    return f"{name}: from {known[0]:.4g} to {known[-1]:.4g}, lowest {known.min():.4g}, highest {known.max():.4g}."
