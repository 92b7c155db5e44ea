"""What the page's scripts take from viser, in a real browser: its lines, its keys, the names of its messages."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from viewing_samples import browser_page, free_port, opened

from uni4d_fg.results.view.server import viewer_server
from uni4d_fg.results.view.viewer import Viewer

pytest.importorskip("viser", reason="viser is not installed: pip install 'uni4d-fg[view]'")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

PATIENCE_S = 60.0


def open_page(page: Any, port: int) -> None:
    """Open the page and wait until it draws and listens to viser."""
    page.set_default_timeout(1000.0 * PATIENCE_S)
    page.goto(f"http://127.0.0.1:{port}")
    page.get_by_text("Frames per second").wait_for()
    page.wait_for_function("window.__viserMutable?.requestRender.listened && window.__viserMutable.camera")


def lines_only(viewer: Viewer) -> None:
    """Show the cameras and the trails of a frame in the middle."""
    for control in (viewer.panel.static, viewer.panel.moving, viewer.panel.full):
        control.value = False
    viewer.panel.frame.value = 5
    viewer.refresh()


def picture(page: Any) -> np.ndarray:
    """Whether each pixel left of the panel has something on it; (H, W)."""
    import cv2

    image = np.asarray(cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR))[200:, :440]
    return np.asarray(np.abs(image.astype(np.int64) - image[-5, 5]).max(axis=2) > 40)


def settled_picture(page: Any) -> np.ndarray:
    """Wait until two pictures, one after the other, are the same."""
    deadline, last = time.monotonic() + PATIENCE_S, picture(page)
    while time.monotonic() < deadline:
        time.sleep(1.5)
        now = picture(page)
        if now.any() and (now == last).all():
            break
        last = now
    return last


@pytest.mark.slow
def test_lines_look_as_viser_draws_them(finished_run: Path) -> None:
    import cv2

    port, found = free_port(), {}
    with viewer_server("127.0.0.1", port, "a run") as server:
        viewer = Viewer(server, opened(finished_run))
        viewer.load()
        lines_only(viewer)
        for own in (True, False):
            with browser_page(viewport={"width": 800, "height": 480}) as page:
                if not own:
                    page.add_init_script("window.uni4dSoftware = { shaders: 0, drawn: 0, behind: 0 }")
                open_page(page, port)
                page.evaluate("window.uni4dDetail.everything = true")
                found[own] = settled_picture(page)
                # Two kinds: of one color, and of colors of their own.
                assert page.evaluate("window.uni4dSoftware.shaders") == (2 if own else 0)
                assert (page.evaluate("window.uni4dSoftware.drawn") > 100) == own
                # No image is behind the scene, and none is drawn.
                assert (page.evaluate("window.uni4dSoftware.behind") > 0) == own
    ours, theirs = found[True], found[False]
    assert theirs.sum() > 500
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.1)
    wider = {own: cv2.dilate(seen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for own, seen in found.items()}
    assert (ours & ~wider[False]).sum() < 0.01 * ours.sum()
    assert (theirs & ~wider[True]).sum() < 0.01 * theirs.sum()


def test_an_arrow_goes_by_a_frame_and_leaves_the_view_alone(finished_run: Path) -> None:
    port = free_port()
    place = "window.__viserMutable.camera.position.toArray().concat(window.__viserMutable.camera.quaternion.toArray())"
    with (
        viewer_server("127.0.0.1", port, "a run") as server,
        browser_page(viewport={"width": 800, "height": 480}) as page,
    ):
        viewer = Viewer(server, opened(finished_run))
        viewer.load()
        # Nothing follows when the time stands still.
        viewer.panel.full.value = False
        viewer.refresh()
        open_page(page, port)
        time.sleep(1.0)  # the first view has been taken
        before = page.evaluate(place)
        page.evaluate(
            """() => {
                const queue = window.__viserMutable.messageQueue, push = queue.push;
                window.kinds = new Set();
                queue.push = (...messages) => {
                    for (const { type } of messages) window.kinds.add(type);
                    return push.apply(queue, messages);
                };
            }"""
        )
        page.keyboard.down("ArrowRight")
        page.get_by_text("frame 1 of").wait_for()
        time.sleep(0.5)
        np.testing.assert_allclose(page.evaluate(place), before, atol=1e-9)
        page.keyboard.up("ArrowRight")
        assert int(viewer.panel.frame.value) == 1
        kinds = page.evaluate("[...window.kinds]")
        assert set(kinds) == {"SetSceneNodeVisibilityMessage", "GuiUpdateMessage"}
        # The other two arrows are viser's.
        page.keyboard.down("ArrowUp")
        page.wait_for_function(f"Math.abs({place}[1] - {before[1]}) > 1e-3")
        page.keyboard.up("ArrowUp")


_WATCH = """
  const watch = () => {
    const panel = document.body && document.querySelector("#root > *");
    const visible = panel && getComputedStyle(panel).visibility === "visible";
    if (visible) window.panelSince ??= [performance.now(), window.uni4dDetail?.seen ?? null];
    setTimeout(watch, 5);
  };
  watch();
"""


@pytest.mark.parametrize("points_are_seen", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_panel_comes_with_the_first_points_or_after_three_seconds(
    finished_run: Path, points_are_seen: bool
) -> None:
    port = free_port()
    with viewer_server("127.0.0.1", port, "a run") as server:
        viewer = Viewer(server, opened(finished_run))
        viewer.load()
        with browser_page(viewport={"width": 800, "height": 480}) as page:
            if not points_are_seen:
                # The script that would tell finds its work done and does nothing.
                page.add_init_script("window.uni4dDetail = {}")
            page.add_init_script(_WATCH)
            page.set_default_timeout(1000.0 * PATIENCE_S)
            page.goto(f"http://127.0.0.1:{port}")
            page.get_by_text("Frames per second").wait_for()
            milliseconds, seen = page.evaluate("window.panelSince")
    assert seen is (True if points_are_seen else None) or milliseconds > 3000.0
    assert points_are_seen or milliseconds > 3000.0
