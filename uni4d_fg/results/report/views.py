"""The result in 3D: pictures from beside the cameras, at some times."""

from __future__ import annotations

from uni4d_fg.errors import Uni4dFgError
from uni4d_fg.results.film.frames import Film, FilmClouds
from uni4d_fg.results.film.paths import FilmView
from uni4d_fg.results.pictures.figure import spread_frames
from uni4d_fg.results.report.markup import Markup, element, figure, picture, section
from uni4d_fg.results.run import Run

_TITLE = "The result in 3D"
_HEIGHT = 360
_TURNS = (("behind the cameras", 0.0), ("one side", 0.25), ("above", 0.125), ("the other side", 0.75))
"""Where on the orbit of ``render`` the pictures are taken, and what that place is called."""


def scene_views(run: Run) -> Markup:
    """Return the section with views of the 4D cloud."""
    try:
        film = Film(FilmClouds(run), FilmView.orbit, _HEIGHT)
        frames = spread_frames(run.num_frames, len(_TURNS))
        shown = []
        for number, (name, turn) in enumerate(_TURNS):
            frame = frames[min(number, len(frames) - 1)]
            caption = f"frame {frame}, from {name}"
            image = film.picture(frame, turn)
            shown.append(figure(picture(image, f"View of the reconstructed scene: {caption}"), caption))
        points = len(film.clouds.static[0])
    except Uni4dFgError as error:
        return section("views", _TITLE, element("p", f"There is no view: {error}", class_="muted"))
    text = (
        f"The static cloud ({points:,} points) and what moves in the frame named, seen from places where no camera "
        "was. Dark gaps are what no frame saw."
    )
    return section(
        "views", _TITLE, element("p", text), element("div", *shown, class_="maps"),
        element("p", "Moving pictures: ", element("code", "uni4d-fg view"), ", ", element("code", "uni4d-fg render"),
                " and ", element("code", "uni4d-fg share"), ".", class_="muted"),
    )  # fmt: skip
