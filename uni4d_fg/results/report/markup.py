"""HTML from Python values: everything that is not markup already is escaped."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

import cv2
import numpy as np

from uni4d_fg.arrays import ImageArray

_VOID = frozenset({"img", "br", "meta", "hr"})
_LONG_TABLE = 9
"""Rows; a longer table is folded."""


class Markup(str):
    """Text that is HTML and must not be escaped."""

    __slots__ = ()


def element(name: str, /, *children: str, **attributes: str | int | float | None) -> Markup:
    """Return an element. Children that are not :class:`Markup` are escaped.

    Names of attributes lose a trailing underscore (``class_``); other underscores become hyphens. None is left out.
    """
    text = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{text}>")
    return Markup(f"<{name}{text}>{join(children)}</{name}>")


def join(children: Iterable[str]) -> Markup:
    """Return children one after the other, escaped where they are plain text."""
    return Markup("".join(child if isinstance(child, Markup) else escape(child) for child in children))


def section(identifier: str, title: str, *children: str) -> Markup:
    """Return a section with a heading of the second level."""
    heading = element("h2", title, id=f"{identifier}-title")
    return element("section", heading, *children, id=identifier, aria_labelledby=f"{identifier}-title")


def bullets(items: Iterable[str], **attributes: str) -> Markup:
    """Return an unordered list."""
    return element("ul", *(element("li", item) for item in items), **attributes)


def table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """Return a table that scrolls sideways on a narrow screen; the first cell of a row is its heading.

    A long one is folded behind its caption.
    """
    head = element("tr", *(element("th", cell, scope="col") for cell in header))
    body = [
        element("tr", element("th", row[0], scope="row"), *(element("td", cell) for cell in row[1:])) for row in rows
    ]
    content = element("table", element("caption", caption), element("thead", head), element("tbody", *body))
    scrolled = element("div", content, class_="scroll", tabindex=0, role="region", aria_label=caption)
    return fold(f"{caption} ({len(body)} rows)", scrolled) if len(body) > _LONG_TABLE else scrolled


def fold(summary: str, *content: str) -> Markup:
    """Return content behind a line that opens it."""
    return element("details", element("summary", summary), *content)


def swatches(entries: Iterable[tuple[str, Sequence[int]]]) -> Markup:
    """Return a legend: texts, each beside its color (RGB)."""
    items = []
    for text, color in entries:
        style = "background:#{:02x}{:02x}{:02x}".format(*color)
        items.append(element("li", element("span", class_="swatch", style=style, aria_hidden="true"), text))
    return element("ul", *items, class_="legend")


def figure(content: str, caption: str) -> Markup:
    """Return a figure with a caption."""
    return element("figure", content, element("figcaption", caption))


def picture(image: ImageArray, alternative: str, *, quality: int = 82) -> Markup:
    """Return an image (H, W, 3), RGB, as an element that holds its own data (JPEG)."""
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded")
    text = base64.b64encode(data.tobytes()).decode("ascii")
    height, width = image.shape[:2]
    return element("img", src=f"data:image/jpeg;base64,{text}", alt=alternative, width=width, height=height)


def color_bar(gradient: str, low: str, high: str, label: str) -> Markup:
    """Return a color bar: a CSS gradient between two labelled ends."""
    return element(
        "div",
        element("span", f"{label}: {low}"),
        element("span", class_="bar", style=f"background:{gradient}", aria_hidden="true"),
        element("span", high),
        class_="colorbar",
    )


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with so many significant digits, large ones as whole numbers; a dash for none."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:,.0f}" if 1e4 <= abs(value) < 1e10 else f"{value:.{digits}g}"
