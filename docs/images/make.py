"""Make the pictures of the README and of the documentation anew, from a synthetic scene.

    python docs/images/make.py [--scratch FOLDER] [--viewer]

The scene is made and reconstructed in the scratch folder (what is there already is used), and the pictures are written
beside this file: `video_and_result.gif`, `scene.jpg`, `depth.jpg`; with `--viewer` also `viewer.jpg` and `phone.jpg`,
which need playwright and chromium.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from uni4d_fg.cli.runs import stored_input
from uni4d_fg.results.film.frames import Film, FilmClouds
from uni4d_fg.results.film.paths import FilmView
from uni4d_fg.results.run import Run

HERE = Path(__file__).resolve().parent
SCENE = ["--frames", "48", "--width", "480", "--height", "360", "--set", "focal=450"]
GIF_HEIGHT, GIF_STEP, GIF_RATE, GIF_COLORS = 200, 2, 8, 64
PORT = 8767
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def program(*words: str) -> None:
    """Run a command of the project."""
    subprocess.run([sys.executable, "-m", "uni4d_fg.cli.entry", *words], check=True)


def made_run(scratch: Path) -> Path:
    """Make the scene and its reconstruction, unless they are there."""
    if not (scratch / "run" / "summary.json").is_file():
        program("synthesize", str(scratch / "scene"), *SCENE)
        program("reconstruct", str(scratch / "scene"), "--out", str(scratch / "run"))
    return scratch / "run"


def save_gif(run: Run, path: Path) -> None:
    """Write the video beside the reconstruction, seen from a camera that swings around it, as an endless film."""
    film = Film(FilmClouds(run), FilmView.side_by_side, GIF_HEIGHT)
    numbers = range(0, run.num_frames, GIF_STEP)
    pictures = [Image.fromarray(film.picture(k, k / run.num_frames)) for k in numbers]
    # One palette for all frames: pixels that stay the same then cost nothing.
    strip = Image.fromarray(np.concatenate([np.asarray(p) for p in pictures[::6]]))
    palette = strip.quantize(GIF_COLORS, method=Image.Quantize.MEDIANCUT)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=1000 // GIF_RATE, loop=0, optimize=True)


def save_jpeg(source: Path, target: Path, width: int) -> None:
    """Copy a picture as JPEG, no wider than asked for."""
    image = cv2.imread(str(source))
    if image.shape[1] > width:
        height = round(image.shape[0] * width / image.shape[1])
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), image, [cv2.IMWRITE_JPEG_QUALITY, 85])


def viewer_pictures(run: Path, folder: Path, *, frame: int = 20, patience_s: float = 600.0) -> None:
    """Write what the viewer shows in a browser at the size of a desktop and at that of a phone."""
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "uni4d_fg.cli.entry", "view", str(run), "--port", str(PORT)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    try:
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
            for name, (width, height) in {"viewer": (1280, 720), "phone": (390, 844)}.items():
                page = browser.new_context(viewport={"width": width, "height": height}).new_page()
                page.set_default_timeout(1000 * patience_s)
                for _ in range(200):
                    try:
                        page.goto(f"http://127.0.0.1:{PORT}")
                        break
                    except Exception:
                        time.sleep(0.5)
                page.wait_for_function("window.uni4dDetail && window.uni4dDetail.wanted > 200000")
                # The note that there is no graphics card; a click by the mouse would wait for a picture at rest.
                page.evaluate(
                    "document.querySelectorAll('.mantine-Notification-closeButton').forEach((b) => b.click())"
                )
                for _ in range(frame):
                    page.keyboard.press("ArrowRight")
                page.wait_for_function(f"document.body.textContent.includes('frame {frame} of')")
                # As a machine with a graphics card shows it: every point, when the picture stands still.
                page.evaluate("window.uni4dDetail.everything = true")
                time.sleep(20.0)
                page.screenshot(path=str(folder / f"{name}.png"))
                page.close()
            browser.close()
    finally:
        server.terminate()
        server.wait()
    for name, width in (("viewer", 1280), ("phone", 390)):
        save_jpeg(folder / f"{name}.png", HERE / f"{name}.jpg", width)


def main() -> None:
    """Make them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scratch", type=Path, help="where the scene and the run are made, and kept")
    parser.add_argument("--viewer", action="store_true", help="pictures of the viewer too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        scratch = arguments.scratch or Path(temporary)
        folder = made_run(scratch)
        run = Run(folder, lambda: stored_input(folder).read())
        save_gif(run, HERE / "video_and_result.gif")
        save_jpeg(run.folder.scene_picture, HERE / "scene.jpg", 1200)
        save_jpeg(run.folder.depth_picture, HERE / "depth.jpg", 1200)
        if arguments.viewer:
            viewer_pictures(folder, scratch)
    for path in sorted(HERE.glob("*.*")):
        print(f"{path.stat().st_size / 1000:7.0f} kB  {path.name}")


if __name__ == "__main__":
    main()
