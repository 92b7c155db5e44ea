"""The page that plays a run without a server."""

from __future__ import annotations

import json
import re
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from viewing_samples import NUM_FRAMES, browser_page, copied, opened

from uni4d_fg.cli import main
from uni4d_fg.errors import ConfigError
from uni4d_fg.results.view.share import MB, write_page

pytest.importorskip("viser", reason="viser is not installed: pip install 'uni4d-fg[view]'")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def test_the_page_keeps_its_size_and_leaves_out_points(finished_run: Path, tmp_path: Path) -> None:
    run = opened(finished_run)
    whole = write_page(run, tmp_path / "whole.html", 25.0)
    small = write_page(run, tmp_path / "small.html", 2.0)
    for page, limit in ((whole, 25.0), (small, 2.0)):
        assert page.path.stat().st_size <= limit * MB
        assert page.megabytes == pytest.approx(page.path.stat().st_size / MB)
        assert page.frames == NUM_FRAMES
    assert 0 < small.static_points <= whole.static_points
    assert small.static_points + small.moving_points <= whole.static_points + whole.moving_points
    with pytest.raises(ConfigError, match="max-mb") as refused:
        write_page(run, tmp_path / "none.html", 0.5)
    assert not (tmp_path / "none.html").exists()
    said = re.search(r"the page without any points takes (\S+) MB", str(refused.value))
    assert said is not None
    least = float(said.group(1))
    assert least < whole.megabytes < 2.0
    for limit in (least + 0.02, 0.5 * (least + whole.megabytes), 1.01 * whole.megabytes):
        page = write_page(run, tmp_path / "fits.html", limit)
        assert page.path.stat().st_size <= limit * MB
        assert page.landmarks == 0
    assert page.static_points + page.moving_points == whole.static_points + whole.moving_points


def test_landmarks_that_stand_in_for_clouds_are_counted(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run of ``stream`` has none; the page was said to show nothing."""
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    shutil.rmtree(run / "clouds")
    (run / "depth.npy").unlink()
    landmarks = len(opened(run).reconstruction.landmarks)
    assert 0 < landmarks < 60_000
    assert write_page(opened(run), tmp_path / "own.html").landmarks == landmarks
    assert main.run(["share", str(run), "--quiet"]) == 0
    assert f"{landmarks} landmarks in the place of a cloud" in capsys.readouterr().out
    assert write_page(opened(finished_run), tmp_path / "whole.html").landmarks == 0


def picture(page: object) -> np.ndarray:
    data = np.frombuffer(page.screenshot(timeout=90_000), np.uint8)  # type: ignore[attr-defined]
    # The bar below shows the time.
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[:-50].astype(np.int64)


def test_the_page_plays_from_disk_without_a_network(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = copied(finished_run, tmp_path)
    summary = json.loads((copy / "summary.json").read_text())
    summary["sequence"]["name"] = "<b>room</b>"
    (copy / "summary.json").write_text(json.dumps(summary))
    path = tmp_path / "page.html"
    words = ["share", str(copy), "--out", str(path), "--max-mb", "3", "--fps", "2", "--quiet"]
    assert main.run(words) == 0
    assert f"page: {path}, " in capsys.readouterr().out
    with browser_page(viewport={"width": 480, "height": 320}, offline=True) as page:
        requested: list[str] = []
        errors: list[str] = []
        page.on("request", lambda request: requested.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(path.as_uri())
        assert page.title() == "<b>room</b>"
        deadline = time.monotonic() + 60.0
        first = picture(page)
        while first.std() < 10.0 and time.monotonic() < deadline:
            time.sleep(0.3)
            first = picture(page)
        assert first.std() > 10.0
        changed = 0.0
        while changed < 0.002 and time.monotonic() < deadline:
            time.sleep(0.3)
            changed = float((np.abs(picture(page) - first).max(axis=2) > 40).mean())
        assert changed > 0.002
        assert page.evaluate("window.uni4dDetail.frames") > 2
    assert errors == []
    assert [url for url in requested if not url.startswith(("file:", "data:", "blob:"))] == []
