"""The viewer's server, with and without a browser."""

from __future__ import annotations

import dataclasses
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viewing_samples import NUM_FRAMES, browser_page, copied, free_port, opened

from uni4d_fg import optional
from uni4d_fg.cli import main
from uni4d_fg.errors import ConfigError, InputError, MissingDependencyError
from uni4d_fg.results.clouds import read_ply
from uni4d_fg.results.view import viewer as viewer_module
from uni4d_fg.results.view.content import Limits, RunClouds
from uni4d_fg.results.view.panel import Panel
from uni4d_fg.results.view.server import check_address, is_own_page, viewer_server
from uni4d_fg.results.view.shown import Shown
from uni4d_fg.results.view.viewer import Viewer

pytest.importorskip("viser", reason="viser is not installed: pip install 'uni4d-fg[view]'")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def test_a_port_in_use_is_one_clear_error(finished_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match="--port"):
            check_address("127.0.0.1", port)
        assert main.run(["view", str(finished_run), "--port", str(port)]) == ConfigError.exit_code
        error = capsys.readouterr().err
        assert error.startswith(f"error: cannot serve at 127.0.0.1:{port}: Address already in use")
        assert error.count("\n") == 1
    with pytest.raises(ConfigError, match="no-such-host"):
        check_address("no-such-host.invalid", free_port())


def test_a_missing_extra_is_one_clear_sentence(finished_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> object:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(optional.importlib, "import_module", missing)
    with (
        pytest.raises(MissingDependencyError, match=r"pip install 'uni4d-fg\[view\]'"),
        viewer_server("127.0.0.1", free_port(), "x"),
    ):
        pass


@pytest.mark.parametrize("verb", ["view", "report"])
def test_what_is_no_run_is_refused_before_anything_is_started(
    verb: str, finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused = [(tmp_path / "nosuch", "no such folder"), (tmp_path, "holds no run")]
    if verb == "report":
        # The viewer shows what a run that is not finished has.
        copy = copied(finished_run, tmp_path)
        (copy / "summary.json").unlink()
        refused.append((copy, "--resume"))
    for folder, text in refused:
        assert main.run([verb, str(folder)]) == 3
        out, error = capsys.readouterr()
        assert out == ""
        assert text in error
        assert error.count("\n") == 1


def handle(server: Any, name: str) -> Any:
    """The node of the scene of this name."""
    return server.scene._handle_from_node_name[name]


def visible(server: Any, prefix: str) -> list[str]:
    """Names of the visible nodes directly below a node."""
    nodes = server.scene._handle_from_node_name.items()
    return sorted(
        name.removeprefix(prefix) for name, node in nodes
        if name.startswith(prefix) and "/" not in name.removeprefix(prefix) and node.visible
    )  # fmt: skip


def test_the_panel_drives_the_scene(finished_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    run = opened(finished_run)
    with viewer_server("127.0.0.1", port, "a run") as server:
        viewer = Viewer(server, run)
        panel = viewer.panel
        assert b"<html" in urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10).read()[:2000]
        panel.frame.value = 5
        viewer.refresh()
        assert "frame 5" in panel.facts.content
        heads = run.reconstruction.dynamic_points[:, 5]
        assert len(handle(server, "/moving/points/00005/all").points) == np.isfinite(heads).all(axis=1).sum()
        assert len(handle(server, "/static/landmarks/points").points) == len(run.reconstruction.landmarks)
        assert not handle(server, "/static/landmarks").visible
        panel.color.value = "residual"
        viewer.refresh()
        assert "reprojection error" in panel.legend.content
        assert handle(server, "/static/landmarks").visible
        ticks = iter(range(10))
        panel.play.value = True
        panel.frames_per_second.value = 60
        viewer.run_until(lambda: next(ticks) == 9)
        assert panel.frame.value == (5 + 9) % run.num_frames
        viewer.step(0)
        assert not panel.play.value
        viewer.step(-2)
        assert panel.frame.value == (5 + 9 - 2) % run.num_frames
    assert capsys.readouterr().out == ""


def test_everything_is_sent_once_and_frames_only_show_and_hide(finished_run: Path) -> None:
    run = opened(finished_run)
    with viewer_server("127.0.0.1", free_port(), "a run") as server:
        viewer = Viewer(server, run)
        viewer.load()
        dense = RunClouds(run, Limits()).dense_static()
        assert dense is not None
        names = server.scene._handle_from_node_name
        chunks = [node for name, node in names.items() if re.fullmatch(r"/static/cloud/\d+/\d+", name)]
        assert sum(len(node.points) for node in chunks) == len(dense.points)
        for frame in range(NUM_FRAMES):
            assert f"/cameras/current/{frame:05d}" in names
        before, sent = set(names), []
        queue = server._websock_server.queue_message
        server._websock_server.queue_message = lambda message: (sent.append(message), queue(message))[1]
        viewer.step(3)
        server._websock_server.queue_message = queue
        assert set(names) == before
        kinds = {type(message).__name__ for message in sent}
        assert kinds <= {"SetSceneNodeVisibilityMessage", "GuiUpdateMessage"}
        assert visible(server, "/moving/cloud/") == visible(server, "/moving/points/") == ["00003"]
        assert visible(server, "/moving/steps/") == ["00000", "00001", "00002", "00003"]
        viewer.panel.history.value, viewer.panel.trail.value = 1, 2
        viewer.refresh()
        assert visible(server, "/moving/cloud/") == visible(server, "/moving/steps/") == ["00002", "00003"]


def test_a_part_of_the_cloud_comes_first_and_the_rest_when_a_browser_has_drawn_it(
    finished_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer_module, "FIRST_POINTS", 300)
    monkeypatch.setattr(viewer_module, "_HEAD_START_SECONDS", (0.0, 0.1))

    def static_points() -> int:
        nodes = server.scene._handle_from_node_name.items()
        return sum(len(node.points) for name, node in nodes if re.fullmatch(r"/static/cloud/\d+/\d+", name))

    with viewer_server("127.0.0.1", free_port(), "a run") as server:
        run = opened(finished_run).with_parts(sequence=InputError("moved away"))
        viewer = Viewer(server, run)
        assert static_points() == 300
        loading = threading.Thread(target=viewer.load_when_seen, daemon=True)
        loading.start()
        time.sleep(0.3)
        assert static_points() == 300
        viewer._welcome(SimpleNamespace(camera=SimpleNamespace(aspect=1.5)))
        loading.join(60.0)
        assert static_points() == len(read_ply(run.folder.static_cloud)[0]) > 300


def test_a_frame_that_stands_still_is_filled_in(finished_run: Path) -> None:
    run = opened(finished_run)
    with viewer_server("127.0.0.1", free_port(), "a run") as server:
        viewer = Viewer(server, run)
        end = time.monotonic() + 1.0
        viewer.run_until(lambda: time.monotonic() > end)
        assert handle(server, "/moving/full").visible
        assert len(visible(server, "/moving/full/00000/")) >= 1
        viewer.step(1)
        assert not handle(server, "/moving/full").visible


def test_colors_are_sent_without_positions(finished_run: Path) -> None:
    run = opened(finished_run)
    with viewer_server("127.0.0.1", free_port(), "a run") as server:
        viewer = Viewer(server, run)
        viewer.load()
        chunk = next(
            n for name, n in server.scene._handle_from_node_name.items() if name.startswith("/moving/cloud/00002/")
        )
        points, colors = chunk.points, chunk.colors.copy()
        viewer.panel.color.value = "instance"
        viewer.refresh()
        assert chunk.points is points
        assert (chunk.colors != colors).any()


def test_axes_of_rigid_objects_follow_the_frame(finished_run: Path) -> None:
    run = opened(finished_run)
    frames = run.num_frames
    poses = np.tile(np.eye(4), (1, frames, 1, 1))
    poses[0, :, 0, 3] = np.arange(frames)
    poses[0, 0] = np.nan
    changed = dataclasses.replace(
        run.reconstruction, object_instance=np.array([3], np.int32), object_world_T_object=poses
    )
    with viewer_server("127.0.0.1", free_port(), "a run") as server:
        assert not Viewer(server, run).panel.objects.visible
    with viewer_server("127.0.0.1", free_port(), "a run") as server:
        viewer = Viewer(server, run.with_parts(reconstruction=changed))
        node = handle(server, "/moving/object_3")
        assert viewer.panel.objects.visible
        assert not node.visible
        viewer.panel.frame.value = 5
        viewer.refresh()
        node = server.scene._handle_from_node_name["/moving/object_3"]
        assert node.visible
        np.testing.assert_allclose(node.position, [5.0, 0.0, 0.0])
        viewer.panel.objects.value = False
        viewer.refresh()
        assert not server.scene._handle_from_node_name["/moving/object_3"].visible


def test_it_serves_this_machine_only_and_ctrl_c_ends_it_with_0(finished_run: Path) -> None:
    port = free_port()
    command = [sys.executable, "-m", "uni4d_fg.cli.main", "view", str(finished_run), "--port", str(port)]
    # As a shell starts a background job: deaf to Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == f"room: http://127.0.0.1:{port} (Ctrl-C ends)\n"
        assert urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10).status == 200
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, out, error) == (0, "", "")


def picture(page: object) -> np.ndarray:
    import cv2

    data = np.frombuffer(page.screenshot(), np.uint8)  # type: ignore[attr-defined]
    # The panel at the right changes by itself.
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[:, :440].astype(np.int64)


def test_a_browser_shows_the_scene_and_follows_the_slider(finished_run: Path) -> None:
    port = free_port()
    with (
        viewer_server("127.0.0.1", port, "a run") as server,
        browser_page(viewport={"width": 800, "height": 480}) as page,
    ):
        viewer = Viewer(server, opened(finished_run))
        requested: list[str] = []
        errors: list[str] = []
        page.on("request", lambda request: requested.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://127.0.0.1:{port}")
        page.get_by_text("Frames per second").wait_for(timeout=60_000)
        deadline = time.monotonic() + 40.0
        while picture(page).std() < 10.0 and time.monotonic() < deadline:
            time.sleep(0.3)
        first = picture(page)
        assert first.std() > 10.0
        largest = "[...document.querySelectorAll('canvas')].sort((a, b) => b.width - a.width)[0]"
        # Software draws it here: smooth edges would take most of its time.
        assert page.evaluate(f"{largest}.getContext('webgl2').getContextAttributes().antialias") is False
        # viser's shader still has the words that make its points circles by three powers a pixel.
        assert page.evaluate("window.uni4dDetail.circles") > 0
        box = page.get_by_role("textbox").locator("visible=true").first
        box.fill("6")
        box.press("Enter")
        page.get_by_text("frame 6").wait_for(timeout=30_000)
        assert int(viewer.panel.frame.value) == 6
        while (np.abs(picture(page) - first).max(axis=2) > 40).mean() < 0.002 and time.monotonic() < deadline + 5.0:
            time.sleep(0.3)
        assert (np.abs(picture(page) - first).max(axis=2) > 40).mean() > 0.002
    assert errors == []
    outside = [url for url in requested if not url.startswith((f"http://127.0.0.1:{port}", "data:", "blob:"))]
    assert outside == []


def test_a_phone_shows_the_scene_first_and_the_panel_when_asked() -> None:
    port = free_port()
    phone = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True}
    with viewer_server("127.0.0.1", port, "a run") as server, browser_page(**phone) as page:
        Panel(server, 5, "a run", 15.0, Shown())
        page.set_default_timeout(120_000)
        page.goto(f"http://127.0.0.1:{port}")
        control = page.get_by_text("Frames per second")
        control.wait_for(state="attached")
        # Closed it is as high as its handle. Its content may stay there, clipped: the page only takes that out when a
        # picture comes at the end of the motion.
        sheet = """document.querySelector('div[style*="max-height: 60%"]')"""
        page.wait_for_function(f"{sheet}.offsetHeight < 0.1 * innerHeight")
        time.sleep(1.0)  # nothing opens it again
        handle = page.locator('div[style*="cursor: pointer"]').first
        box = handle.bounding_box()
        assert box is not None
        assert box["y"] > 0.9 * 844
        handle.click()
        page.wait_for_function(f"{sheet}.offsetHeight > 0.2 * innerHeight")
        control.wait_for(state="visible")


def test_notes_reach_the_panel(finished_run: Path, tmp_path: Path) -> None:
    copy = copied(finished_run, tmp_path)
    summary = json.loads((copy / "summary.json").read_text())
    (copy / "summary.json").write_text(json.dumps({**summary, "warnings": ["the camera hardly moves"]}))
    (copy / "labels.npz").unlink()
    with viewer_server("127.0.0.1", free_port(), "a run") as server:
        notes = Viewer(server, opened(copy)).panel.notes.content
    assert "the camera hardly moves" in notes
    assert "labels.npz" in notes


def test_a_connection_that_asks_for_nothing_prints_nothing(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    with viewer_server("127.0.0.1", port, "a run"):
        for sent in (b"", b"GET / HT", b"nonsense\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", port), timeout=5.0) as connection:
                connection.sendall(sent)
        time.sleep(0.5)
    assert caplog.records == []


HOSTILE = (
    "<iframe srcdoc=\"<script>parent.document.title='taken'</script>\"></iframe>"
    '<img src=x onerror="alert(1)">{alert(1)}'
)


def test_text_of_a_run_folder_is_no_markup(finished_run: Path, tmp_path: Path) -> None:
    copy = copied(finished_run, tmp_path)
    summary = json.loads((copy / "summary.json").read_text())
    summary["sequence"]["name"] = HOSTILE
    (copy / "summary.json").write_text(json.dumps({**summary, "warnings": [HOSTILE]}))
    port = free_port()
    with viewer_server("127.0.0.1", port, HOSTILE) as server, browser_page() as page:
        panel = Viewer(server, opened(copy)).panel
        assert "<iframe" not in panel.notes.content
        assert "&lt;iframe" in panel.notes.content
        assert not any(type(handle).__name__ == "GuiMarkdownHandle" for handle in vars(panel).values())
        page.goto(f"http://127.0.0.1:{port}")
        page.get_by_text("Frames per second").wait_for(timeout=60_000)
        page.get_by_text("iframe srcdoc").first.wait_for(timeout=30_000)
        assert page.locator("iframe").count() == 0
        assert page.locator("img[src=x]").count() == 0
        assert page.title() != "taken"


@pytest.mark.parametrize(
    ("host", "asked", "origin", "own"),
    [
        ("127.0.0.1", "127.0.0.1:8080", None, True),
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:8080", True),
        ("127.0.0.1", "localhost:8080", "http://localhost:8080", True),
        ("::1", "[::1]:8080", "http://[::1]:8080", True),
        ("127.0.0.1", "127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:9090", False),
        ("127.0.0.1", "127.0.0.1:8080", "null", False),
        ("127.0.0.1", "evil.example:8080", "http://evil.example:8080", False),
        ("127.0.0.1", None, None, False),
        ("0.0.0.0", "lab.example:8080", "http://lab.example:8080", True),
        ("0.0.0.0", "lab.example:8080", "http://evil.example", False),
    ],
)
def test_only_the_own_page_may_use_the_server(host: str, asked: str | None, origin: str | None, own: bool) -> None:
    assert is_own_page(host, asked, origin) is own


def test_the_server_refuses_other_origins() -> None:
    from websockets.asyncio import server as websockets_server
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    before, port = websockets_server.serve, free_port()
    with viewer_server("127.0.0.1", port, "a run"):
        assert websockets_server.serve is before
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://127.0.0.1:{port}", origin="http://evil.example")
        assert refused.value.response.status_code == 403
        with connect(f"ws://127.0.0.1:{port}", origin=f"http://127.0.0.1:{port}"):
            pass
        page = urllib.request.Request(f"http://127.0.0.1:{port}", headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(page, timeout=10)
