from __future__ import annotations

from pathlib import Path

import pytest
from viewing_samples import browser_page, opened

from uni4d_fg.results.report.build import write_report


@pytest.fixture(scope="module")
def written(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(opened(finished_run), path)
    return path


def test_a_browser_shows_it_without_the_network_on_a_phone_and_in_the_dark(written: Path) -> None:
    with browser_page(viewport={"width": 390, "height": 800}, color_scheme="dark") as page:
        requested: list[str] = []
        said: list[str] = []
        page.on("request", lambda request: requested.append(request.url))
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(written.as_uri())
        assert [url for url in requested if not url.startswith("data:")] == [written.as_uri()]
        assert said == []
        assert page.title() == "room: reconstruction report"
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        sizes = page.evaluate("[...document.images].map(image => image.complete ? image.naturalWidth : 0)")
        assert len(sizes) >= 28
        assert min(sizes) > 0
        charts = page.evaluate(
            "[...document.querySelectorAll('svg[role=img]')].map(svg => svg.getBoundingClientRect().height)"
        )
        assert len(charts) >= 8
        assert min(charts) > 100
        background = "getComputedStyle(document.body).backgroundColor"
        assert page.evaluate(background) == "rgb(21, 24, 28)"
        page.emulate_media(color_scheme="light")
        assert page.evaluate(background) == "rgb(255, 255, 255)"
        page.emulate_media(media="print", color_scheme="dark")
        assert page.evaluate(background) == "rgb(255, 255, 255)"
        assert not page.locator("nav").is_visible()
        page.emulate_media(media="screen")
        page.get_by_role("link", name="Accuracy").click()
        assert page.evaluate("location.hash") == "#accuracy"
