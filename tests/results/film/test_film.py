"""Films and stills of a run."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from viewing_samples import NUM_FRAMES, copied, opened

from uni4d_fg.cli import main
from uni4d_fg.errors import Cancelled, ConfigError, InputError, OutputError
from uni4d_fg.results.film import video
from uni4d_fg.results.film.frames import FilmClouds, schedule
from uni4d_fg.results.film.paths import FilmView, camera_view, film_size, orbit_view
from uni4d_fg.results.film.render import FilmOptions, render_run
from uni4d_fg.results.measures import scene_depth
from uni4d_fg.results.pictures.splatting import render

SMALL = 64


def test_the_cameras_own_view_shows_the_video(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.sequence is not None
    for frame in (0, 5):
        view = camera_view(run.reconstruction, frame, run.reconstruction.image_size)
        np.testing.assert_allclose(view.intrinsics, run.reconstruction.intrinsics)
        picture, depth = render(view, *FilmClouds(run).at(frame), (0, 0, 0), smallest_px=0.0, edge_strength=0.0)
        seen = np.isfinite(depth)
        assert seen.mean() > 0.85
        image = run.sequence.images[frame]
        off, off_when_shifted = (
            np.median(np.abs(blurred(picture) - blurred(other)).mean(axis=2)[seen])
            for other in (image, np.roll(image, 5, axis=1))
        )
        assert off < 0.6 * off_when_shifted
        assert run.depth is not None
        # Discs hide a little of what is behind them, so that the nearest surface is a bit nearer.
        assert 0.95 < np.nanmedian(depth[seen] / run.depth[frame][seen]) < 1.005


def blurred(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2.0))


def test_a_view_of_another_size_shows_the_same(finished_run: Path) -> None:
    result = opened(finished_run).reconstruction
    height, width = result.image_size
    corners = np.array([[0.0, 0.0], [width - 1.0, height - 1.0]])
    view = camera_view(result, 2, (2 * height, 2 * width))
    fx, fy, cx, cy = view.intrinsics
    rays = (corners - result.intrinsics[2:]) / result.intrinsics[:2]
    # Pixel centers at whole numbers: pixel 0 of the small picture is the middle of pixels 0 and 1 of the large one.
    np.testing.assert_allclose(rays * [fx, fy] + [cx, cy], 2.0 * corners + 0.5)


def test_the_orbit_is_closed_and_looks_at_the_scene(finished_run: Path) -> None:
    run = opened(finished_run)
    result, depth = run.reconstruction, scene_depth(run.reconstruction)
    size = film_size(result, 91, FilmView.orbit)
    assert size == (90, 160)
    views = [orbit_view(result, depth, turn, size) for turn in (0.0, 0.25, 0.75, 1.0)]
    np.testing.assert_allclose(views[0].world_T_cam, views[-1].world_T_cam, atol=1e-9)
    left, right = views[1].world_T_cam[:3, 3], views[2].world_T_cam[:3, 3]
    assert np.linalg.norm(left - right) > 0.5 * depth
    landmarks = result.landmarks
    for view in views:
        uv, z = view.project(landmarks)
        inside = np.isfinite(z) & (uv >= 0).all(axis=1) & (uv < np.array(size[::-1])).all(axis=1)
        assert inside.mean() > 0.7


def test_a_film_is_long_enough_and_ends_where_it_begins() -> None:
    plan = list(schedule(8, 15.0))
    assert len(plan) == 64
    assert [frame for frame, _ in plan[:10]] == [0, 1, 2, 3, 4, 5, 6, 7, 0, 1]
    assert plan[0][1] == 0.0
    assert plan[-1][1] == pytest.approx(63 / 64)
    assert len(list(schedule(300, 15.0))) == 300


def read_film(path: Path) -> list[np.ndarray]:
    reader, pictures = cv2.VideoCapture(str(path)), []
    while True:
        there, picture = reader.read()
        if not there:
            return pictures
        pictures.append(picture[..., ::-1])


@pytest.mark.parametrize("program", ["none", "found"])
def test_films_and_stills_agree(
    finished_run: Path,
    tmp_path: Path,
    program: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if program == "none":
        monkeypatch.setattr(video, "find_ffmpeg", lambda: None)
    elif video.find_ffmpeg() is None:
        pytest.skip("no program for H.264: pip install imageio-ffmpeg")
    words = ["render", str(finished_run), "--out", str(tmp_path), "--view", "camera", "--height", str(SMALL), "--quiet"]
    assert main.run([*words, "--to", "mp4", "--to", "gif", "--to", "png", "--stills", "2"]) == 0
    assert capsys.readouterr().out.count("\n") == 4
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "camera.gif", "camera.mp4", "camera_00000.png", f"camera_{NUM_FRAMES - 1:05d}.png",
    ]  # fmt: skip
    film = read_film(tmp_path / "camera.mp4")
    assert len(film) == NUM_FRAMES
    gif = Image.open(tmp_path / "camera.gif")
    assert gif.n_frames == NUM_FRAMES
    assert gif.info["loop"] == 0
    for number in (0, NUM_FRAMES - 1):
        still = np.asarray(Image.open(tmp_path / f"camera_{number:05d}.png").convert("RGB")).astype(int)
        assert still.shape[0] == SMALL
        gif.seek(number)
        assert np.abs(film[number].astype(int) - still).mean() < 12.0
        assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - still).mean() < 12.0


def test_the_video_stands_beside_the_orbit(finished_run: Path, tmp_path: Path) -> None:
    run = opened(finished_run)
    assert run.sequence is not None
    options = FilmOptions([FilmView.side_by_side], ["png"], height=96, stills=1)
    (path,) = render_run(run, tmp_path, options)
    picture = np.asarray(Image.open(path)).astype(int)
    assert picture.shape == (96, 256, 3)
    assert np.abs(picture[:, :128] - run.sequence.images[0]).mean() < 1.0
    with pytest.raises(InputError, match="images"):
        render_run(run.with_parts(sequence=InputError("moved")), tmp_path / "x", options)


def test_what_cannot_be_rendered_leaves_nothing(finished_run: Path, tmp_path: Path) -> None:
    run = opened(finished_run)
    out = tmp_path / "films"
    with pytest.raises(Cancelled):
        render_run(run, out, FilmOptions(formats=["mp4", "gif"], height=SMALL), should_stop=lambda: True)
    assert list(out.iterdir()) == []
    with pytest.raises(ConfigError, match="webp"):
        render_run(run, out, FilmOptions(formats=["webp"]))
    copy = copied(finished_run, tmp_path)
    shutil.rmtree(copy / "clouds")
    with pytest.raises(InputError, match="no clouds"):
        render_run(opened(copy).with_parts(depth=None), out, FilmOptions(formats=["png"], height=SMALL))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        render_run(run, tmp_path / "file" / "x", FilmOptions(formats=["png"], height=SMALL, stills=1))


def test_h264_is_what_browsers_play(tmp_path: Path) -> None:
    program = video.find_ffmpeg()
    if program is None:
        pytest.skip("no program for H.264: pip install imageio-ffmpeg")
    with video.open_mp4(tmp_path / "a.mp4", (32, 48), 10.0) as film:
        for level in range(10):
            film.add(np.full((32, 48, 3), 20 * level, np.uint8))
    told = subprocess.run([program, "-i", str(tmp_path / "a.mp4")], capture_output=True, text=True, check=False).stderr
    assert "Video: h264" in told
    assert "yuv420p" in told
    assert "10 fps" in told
    # The index comes before the pictures, so that a browser plays while it loads.
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    with pytest.raises(OutputError, match="ffmpeg"), video.open_mp4(tmp_path / "b.mp4", (33, 47), 10.0) as film:
        film.add(np.zeros((33, 47, 3), np.uint8))
    assert not (tmp_path / "b.mp4").exists()


def test_a_film_that_the_disk_did_not_take_is_no_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV reports no failed write: the file is as long as there was space."""
    monkeypatch.setattr(video, "find_ffmpeg", lambda: None)
    noise = np.random.default_rng(0).integers(0, 256, (10, 64, 64, 3), np.uint8)

    class Cut:
        def __init__(self, *args: object) -> None:
            self._path, self._writer = Path(str(args[0])), writer(*args)

        def __getattr__(self, name: str) -> object:
            return getattr(self._writer, name)

        def release(self) -> None:
            self._writer.release()
            self._path.write_bytes(self._path.read_bytes()[:-2000])

    writer = cv2.VideoWriter
    Cut.fourcc = writer.fourcc  # type: ignore[attr-defined]
    monkeypatch.setattr(video.cv2, "VideoWriter", Cut)

    def write() -> None:
        with video.open_mp4(tmp_path / "a.mp4", (64, 64), 10.0) as film:
            for picture in noise:
                film.add(picture)

    with pytest.raises(OutputError, match=r"cannot write .*of 10 pictures can be read again; check free space"):
        write()
    assert not list(tmp_path.iterdir())
