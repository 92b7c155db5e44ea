"""The page: what to distrust first, then what was run, the result, and how good it is."""

from __future__ import annotations

from pathlib import Path

from uni4d_fg.files import atomic_write_text
from uni4d_fg.results.report.accuracy import accuracy, evaluate
from uni4d_fg.results.report.cameras import trajectory, uncertainty
from uni4d_fg.results.report.certainty import certainty
from uni4d_fg.results.report.depth import depth_strips
from uni4d_fg.results.report.distrust import distrusted
from uni4d_fg.results.report.energy import energies
from uni4d_fg.results.report.markup import Markup, bullets, element, join
from uni4d_fg.results.report.masks import mask_strip
from uni4d_fg.results.report.observations import dropped, residual_maps
from uni4d_fg.results.report.overview import overview
from uni4d_fg.results.report.style import STYLE
from uni4d_fg.results.report.views import scene_views
from uni4d_fg.results.residuals import reprojection_residuals
from uni4d_fg.results.run import Run

_CONTENTS = {
    "certainty": "Certainty",
    "run": "What was run",
    "views": "3D views",
    "trajectory": "Trajectory",
    "masks": "Masks",
    "depth": "Depth",
    "residuals": "Residuals",
    "dropped": "Left out",
    "uncertainty": "Uncertainty",
    "energy": "Energy",
    "accuracy": "Accuracy",
}


def write_report(run: Run, path: Path) -> None:
    """Write the page about a run, whole or not at all.

    Args:
        run: The run.
        path: The ``.html`` file.

    Raises:
        InputError: If a frame of the sequence cannot be read.
        OutputError: If the file cannot be written.
    """
    atomic_write_text(path, report_page(run))


def report_page(run: Run) -> str:
    """Return the page about a run: HTML that needs no other file and no network.

    Raises:
        InputError: If a frame of the sequence cannot be read.
    """
    residuals = None if run.labelled is None else reprojection_residuals(run.reconstruction, run.labelled)
    links = (element("li", element("a", text, href=f"#{key}")) for key, text in _CONTENTS.items())
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", f"{run.name}: reconstruction report"),
        # The page can hold no request: not even a favicon is asked for.
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("style", Markup(STYLE)),
    )
    body = element(
        "body",
        element(
            "header",
            element("h1", f"Reconstruction of {run.name}"),
            element("p", f"{run.num_frames} frames, {len(run.reconstruction.landmarks)} static landmarks, "
                    f"{len(run.reconstruction.dynamic_points)} moving trajectories.", class_="muted"),
        ),
        element(
            "main",
            _distrust(distrusted(run, residuals), run.notes),
            element("nav", element("ul", *links), aria_label="Contents"),
            certainty(run),
            overview(run),
            scene_views(run),
            trajectory(run),
            mask_strip(run),
            depth_strips(run),
            residual_maps(run, residuals),
            dropped(run),
            uncertainty(run),
            energies(run),
            accuracy(evaluate(run)),
        ),
        element("footer", element("p", "Written by uni4d_fg. The page holds all its pictures.", class_="muted")),
    )  # fmt: skip
    return join([Markup("<!doctype html>\n"), element("html", head, body, lang="en")]) + "\n"


_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def _distrust(found: list[str], notes: tuple[str, ...]) -> Markup:
    """The box at the top."""
    missing = [element("p", "Not at hand: " + "; ".join(notes), class_="muted")] if notes else []
    if found:
        title = element("h2", "What to distrust", id="distrust-title")
        return element(
            "section", title, bullets(found), *missing, class_="distrust", id="distrust",
            aria_labelledby="distrust-title",
        )  # fmt: skip
    title = element("h2", "Nothing stood out", id="distrust-title")
    text = "No check of this page failed. That does not make the scale of the depth cue or the masks right."
    return element(
        "section", title, element("p", text), *missing, class_="distrust clear", id="distrust",
        aria_labelledby="distrust-title",
    )  # fmt: skip
