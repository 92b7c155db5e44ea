"""The viewer's page: viser's own, with the project's scripts before it."""

from __future__ import annotations

import gzip
from importlib.resources import files
from typing import Any

_BEGIN = "<head>"
_SCRIPTS = ("software.js", "detail.js", "page.js")
"""In this order: what detail.js counts as drawn is what viser asks for, not what software.js makes of it."""


def with_scripts(page: str) -> str:
    """Return an HTML page in whose head the scripts for lines, level of detail, keys and phones come first.

    Nothing of a run is in them. A page without a head is returned as it is.
    """
    folder = files("uni4d_fg.results.view")
    scripts = "".join(f"<script>{(folder / name).read_text(encoding='utf-8')}</script>" for name in _SCRIPTS)
    return page.replace(_BEGIN, _BEGIN + scripts, 1)


def answer_with_scripts(response: Any) -> Any:
    """Return an answer of viser's web server with the scripts in it, if it is an HTML page.

    Args:
        response: ``websockets.http11.Response``, or None for requests that are no page.
    """
    if response is None or "text/html" not in response.headers.get("Content-Type", ""):
        return response
    zipped = response.headers.get("Content-Encoding") == "gzip"
    page = with_scripts((gzip.decompress(response.body) if zipped else response.body).decode("utf-8")).encode("utf-8")
    response.body = gzip.compress(page, 5) if zipped else page
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response
