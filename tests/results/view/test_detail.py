"""Level of detail in the page, on a clock and a renderer that are made up: the script sees calls and times only."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import pytest
from viewing_samples import browser_page

pytest.importorskip("playwright")

STAGE = """<!doctype html><title>stage</title><script>
// A renderer that takes BASE ms for a picture, EACH for a point and FILL for a pixel of it, and a clock that it moves.
let now = 1000, frames = [], scale = 0, spent = 0, sizes = [];
const kind = location.hash.slice(1).split(","), [name, BASE, EACH, FILL] = [kind[0], ...kind.slice(1).map(Number)];
performance.now = () => now;
window.requestAnimationFrame = (go) => frames.push(go);
const gl = WebGL2RenderingContext.prototype;
gl.uniform1f = (place, value) => { scale = value; };
gl.uniformMatrix4fv = gl.useProgram = () => {};
gl.getUniformLocation = (owner, called) => ({ called });
gl.getParameter = () => name;
gl.drawArrays = (mode, first, count) => { sizes.push(scale / 5); spent += count * (EACH + FILL * (scale / 5) ** 2); };
</script><script>SCRIPT</script><script>
const context = document.createElement("canvas").getContext("webgl2", { antialias: true });
const program = {}, place = (called) => context.getUniformLocation(program, called);
const places = { scale: place("scale"), view: place("modelViewMatrix"), projection: place("projectionMatrix") };
const view = new Float32Array([1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,-5,1]), projection = new Float32Array(16).fill(0);
projection[0] = projection[5] = 1;
const tick = () => { for (const go of frames.splice(0)) go(now); };
// What viser shows to its own tests: what came from the server, and how a picture is asked for.
const viser = { messageQueue: [], requestRender() {} };
const listened = () => { window.__viserMutable = viser; tick(); };
const message = (...types) => { viser.messageQueue.push(...types.map((type) => ({ type }))); viser.requestRender(); };
// Draw a cloud of 1.6 million points of a pixel each, milliseconds after the picture before; return what was drawn.
function picture(after = 0) {
  if (after) { now += after; tick(); }
  spent = BASE; sizes = [];
  if (viser.messageQueue.splice(0).length) viser.requestRender();
  context.useProgram(program);
  context.uniformMatrix4fv(places.view, false, view);
  context.uniformMatrix4fv(places.projection, false, projection);
  for (let chunk = 0; chunk < 32; chunk++) {
    context.uniform1f(places.scale, 5);
    context.drawArrays(context.POINTS, 0, 50000);
  }
  now += Math.max(spent, 16);
  tick();
  return { drawn: window.uni4dDetail.drawn, ms: Math.max(spent, 16), size: Math.max(...sizes) };
}
const turn = (count) => { let last; for (let k = 0; k < count; k++) last = picture(); return last; };
const drawing = (go) => { const before = window.uni4dDetail.frames; go(); return window.uni4dDetail.frames - before; };
</script>"""

GPU = "NVIDIA,2,1e-6,1e-6"
SOFTWARE = "SwiftShader,10,4e-4,5e-5"
SLOW_SOFTWARE = "SwiftShader,14,1e-3,4e-5"
ALL = 1_600_000


def stage(page: Any, renderer: str) -> None:
    script = (files("uni4d_fg.results.view") / "detail.js").read_text(encoding="utf-8")
    page.route(
        "http://stage/", lambda route: route.fulfill(body=STAGE.replace("SCRIPT", script), content_type="text/html")
    )
    page.goto("about:blank")
    page.goto(f"http://stage/#{renderer}")


def test_a_graphics_card_draws_everything_all_the_time() -> None:
    with browser_page() as page:
        stage(page, GPU)
        page.evaluate("turn(60)")
        for _ in range(3):
            assert page.evaluate("turn(20)")["drawn"] == pytest.approx(ALL)
            assert page.evaluate("picture(1000)")["drawn"] == pytest.approx(ALL)


def test_software_aims_at_pictures_that_a_key_does_not_wait_long_for() -> None:
    with browser_page() as page:
        stage(page, SOFTWARE)
        page.evaluate("turn(60)")
        moving = page.evaluate("turn(20)")
        assert 22.0 < moving["ms"] < 32.0
        assert moving["drawn"] >= 6000


def test_where_the_fewest_points_take_too_long_they_are_smaller() -> None:
    with browser_page() as page:
        stage(page, SLOW_SOFTWARE)
        page.evaluate("turn(80)")
        moving = page.evaluate("turn(20)")
        # Points that touch would be 16 px wide and take 14 + 6 + 61 ms.
        assert moving["drawn"] == pytest.approx(6000, rel=0.02)
        assert 5.9 <= moving["size"] < 9.0
        assert moving["ms"] < 33.0


def test_a_picture_that_stands_still_gets_more_and_one_after_a_key_less() -> None:
    with browser_page() as page:
        stage(page, SLOW_SOFTWARE)
        moving = page.evaluate("turn(80)")
        still = [page.evaluate("picture(1000)")["drawn"] for _ in range(4)]
        assert still[0] > 6 * moving["drawn"]
        assert still == sorted(still)
        assert still[-1] == pytest.approx(still[-2])
        page.evaluate("now += 900")
        page.keyboard.press("ArrowRight")
        assert page.evaluate("picture(30)")["drawn"] == pytest.approx(moving["drawn"], rel=0.02)


def test_pictures_that_would_be_the_same_are_left_out_by_software_until_something_happens() -> None:
    def drawn(renderer: str, then: str, count: int) -> int:
        stage(page, renderer)
        page.evaluate("turn(80)")
        page.evaluate("for (let k = 0; k < 4; k++) picture(1000)")
        before = page.evaluate("window.uni4dDetail.frames")
        page.evaluate(f"for (let k = 0; k < {count}; k++) {then}")
        return int(page.evaluate("window.uni4dDetail.frames")) - int(before)

    with browser_page() as page:
        assert drawn(SLOW_SOFTWARE, "picture(1000)", 30) == 3
        assert drawn(GPU, "picture(1000)", 30) == 30
        # What the server sends is followed by a few pictures at once: all but the first are drawn, and quickly.
        assert drawn(SLOW_SOFTWARE, "(picture(1000), turn(4))", 1) == 4
        assert page.evaluate("window.uni4dDetail.drawn") < 7000
        assert drawn(SLOW_SOFTWARE, "(context.canvas.width += 10, picture(1000))", 5) == 5
        stage(page, SLOW_SOFTWARE)
        page.evaluate("turn(80); for (let k = 0; k < 6; k++) picture(1000)")
        page.evaluate("window.uni4dDetail.everything = true")
        assert page.evaluate("(picture(1000), spent)") > 1000.0
        page.evaluate("window.uni4dDetail.everything = false")
        before = page.evaluate("window.uni4dDetail.frames")
        page.evaluate("now += 700")
        page.keyboard.press("ArrowRight")
        page.evaluate("picture(5)")
        assert page.evaluate("window.uni4dDetail.frames") == before + 1


SWITCH = 'message("SetSceneNodeVisibilityMessage", "SetSceneNodeVisibilityMessage", "GuiUpdateMessage")'


def listening_stage(page: Any, renderer: str, learn: int = 80) -> None:
    stage(page, renderer)
    page.evaluate(f"turn({learn}); listened(); picture(); picture(400)")


def test_a_switch_is_one_picture_by_software_and_the_full_one_follows() -> None:
    with browser_page() as page:
        listening_stage(page, SLOW_SOFTWARE)
        for _ in range(3):
            page.evaluate(f"{SWITCH}; picture()")
            moving = page.evaluate("window.uni4dDetail.drawn")
            assert moving == pytest.approx(6000, rel=0.02)
            assert page.evaluate("window.uni4dDetail.moving") is True
            # viser draws for a quarter of a second, and once a second.
            assert page.evaluate("drawing(() => turn(16))") == 0
            assert page.evaluate("drawing(() => picture(400))") == 0
            still = [page.evaluate("picture(1000)")["drawn"] for _ in range(3)]
            assert still[0] > 6 * moving
            assert still == sorted(still)
            assert still[-1] >= 20 * moving
            assert page.evaluate("window.uni4dDetail.moving") is False


def test_a_key_waits_for_no_picture_that_would_be_the_same() -> None:
    with browser_page() as page:
        listening_stage(page, SLOW_SOFTWARE)
        page.evaluate(f"{SWITCH}; turn(2)")
        page.keyboard.press("ArrowRight")
        assert page.evaluate("drawing(() => turn(5))") == 0
        assert page.evaluate(f"drawing(() => {{ {SWITCH}; turn(5); }})") == 1


def test_what_may_take_several_pictures_gets_them() -> None:
    def drawn(then: str) -> int:
        listening_stage(page, SLOW_SOFTWARE)
        return int(page.evaluate(f"drawing(() => {{ {then}; turn(5); }})"))

    with browser_page() as page:
        assert drawn(SWITCH) == 1
        assert drawn('message("SetSceneNodeVisibilityMessage", "SceneNodeUpdateMessage")') == 5
        # Without a message: what viser moves by itself, like the camera.
        assert drawn("viser.requestRender()") == 5
        # A cloud that comes a picture late, as no one said.
        assert drawn(f"{SWITCH}; turn(3); context.drawArrays(context.POINTS, 0, 10); tick()") == 2
        page.evaluate("now += 1000")
        page.mouse.move(10, 10)
        page.mouse.down()
        page.mouse.move(20, 20)
        assert page.evaluate("drawing(() => turn(5))") == 5


def test_no_picture_is_left_out_before_it_is_known_how_long_they_take_nor_by_a_graphics_card() -> None:
    with browser_page() as page:
        listening_stage(page, SLOW_SOFTWARE, learn=1)
        assert page.evaluate(f"drawing(() => {{ {SWITCH}; turn(5); }})") == 5
        listening_stage(page, GPU)
        assert page.evaluate(f"drawing(() => {{ {SWITCH}; turn(5); }})") == 5
        assert page.evaluate("window.uni4dDetail.drawn") == pytest.approx(ALL)
