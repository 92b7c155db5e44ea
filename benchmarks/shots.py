"""Cuts that are found: precision and recall on joined clips with traps.

    UNI4D_FG_DATA=/path/to/sequences python benchmarks/shots.py [--clips 40] [--seed 0] [--show]

Each clip joins two to four parts of kitchen, kitchen_dog, lady_running and synthetic scenes (upright, mirrored or
upside down, so that neighbors never show the same place), by hard cuts or dissolves of 4 to 13 frames. In the middle of
the parts, outside the dissolves, there are traps: flashes of one to three frames, changes of exposure, whip pans (a
crop that is swept over the image, or a camera that is turned in the synthetic room, both with motion blur; no flash
with a whip pan). A hard cut counts as found at its frame exactly, a dissolve where the cut lies within its frames.
Without UNI4D_FG_DATA the parts are synthetic alone.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from uni4d_fg.arrays import ImageArray
from uni4d_fg.config.shots import ShotsConfig
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.shots.cuts import find_cuts

WIDTH, HEIGHT = 240, 180
CLIPS = 40


@dataclass(frozen=True)
class Change:
    """A true cut: the frames that are neither of the shot before nor of the one after."""

    stop: int
    start: int

    @property
    def is_hard(self) -> bool:
        """Whether no frame lies between the shots."""
        return self.stop == self.start


def fitted(image: ImageArray, width: int = WIDTH, height: int = HEIGHT) -> ImageArray:
    """Return the middle of an image in the shape and size of the clips."""
    tall, wide = image.shape[:2]
    crop_w = min(wide, round(tall * width / height))
    crop_h = min(tall, round(wide * height / width))
    x, y = (wide - crop_w) // 2, (tall - crop_h) // 2
    return cv2.resize(image[y : y + crop_h, x : x + crop_w], (width, height), interpolation=cv2.INTER_AREA)


def synthetic(path: str, objects: str, frames: int = 60) -> ImageArray:
    from uni4d_fg.frontend.synthetic import make_synthetic_sequence

    config = SyntheticSceneConfig(
        num_frames=frames, width=WIDTH, height=HEIGHT, focal=225.0, path=path, objects=objects, grid_columns=4,
        grid_rows=4,
    )  # fmt: skip
    return np.stack(list(make_synthetic_sequence(config).images))


def whip(frames: int = 34, still: int = 14, degrees: float = 75.0, samples: int = 6) -> ImageArray:
    """Return a camera that rests, turns by ``degrees`` within the frames between, and rests, with motion blur."""
    from uni4d_fg.frontend.synthetic.camera_path import camera_path
    from uni4d_fg.frontend.synthetic.raycast import RayCaster
    from uni4d_fg.frontend.synthetic.render import render_frame
    from uni4d_fg.frontend.synthetic.scene import make_scene

    scene = make_scene("both", 1)
    times = np.arange(frames) / 15.0
    poses = camera_path("handheld", times, 0.42)
    intrinsics = np.array([225.0, 225.0, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)])
    images = []
    for t in range(frames):
        vertices = scene.vertices(times[t])
        caster = RayCaster(vertices, scene.triangles)

        def turned(at: float, t: int = t) -> np.ndarray:
            part = np.clip((at - still) / (frames - 2 * still), 0.0, 1.0)
            angle = np.radians(degrees) * part
            rotation = np.eye(4)
            rotation[:3, :3] = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
            return poses[t] @ rotation

        moves = still - 1 <= t <= frames - still
        sub = [t + 0.5 * k / samples for k in range(samples)] if moves else [float(t)]
        shot = [render_frame(scene, vertices, caster, turned(at), intrinsics, (HEIGHT, WIDTH)).image for at in sub]
        images.append(np.mean([image for image in shot if image is not None], axis=0).astype(np.uint8))
    return np.stack(images)


def sources(root: Path | None) -> dict[str, ImageArray]:
    """Return (T, H, W, 3) frames by name; names that share what is before the point show the same place."""
    found = {
        "room.handheld": synthetic("handheld", "both"),
        "room.forward": synthetic("forward", "none"),
        "room.whip": whip(),
    }
    for name in ("kitchen", "kitchen_dog", "lady_running"):
        if root is not None and (root / name).is_dir():
            place = "kitchen" if name.startswith("kitchen") else "lady"
            found[f"{place}.{name}"] = np.stack([fitted(image, 360, 270) for image in open_video(root / name).images])
    return found


def part(frames: ImageArray, name: str, rng: np.random.Generator) -> ImageArray:
    """Return a part of a source with traps in it, (N, HEIGHT, WIDTH, 3)."""
    count = int(rng.integers(18, 41))
    if name.endswith("whip"):
        begin, count = 0, len(frames)
    else:
        begin = int(rng.integers(0, max(1, len(frames) - count)))
    frames = frames[begin : begin + count]
    pans = name.endswith("whip")
    if frames.shape[2] > WIDTH:
        pans = rng.random() < 0.4
        frames = swept(frames, rng) if pans else np.stack([fitted(frame) for frame in frames])
    frames = exposed(frames, rng) if rng.random() < 0.35 else frames
    return frames if pans or rng.random() < 0.4 else flashed(frames, rng)


def swept(frames: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Return a crop that rests at one side and is swept to the other within 3 to 5 frames, with motion blur."""
    count, tall, wide = frames.shape[:3]
    steps = int(rng.integers(3, 6))
    begin = int(rng.integers(count // 3, max(2 * count // 3 - steps, count // 3) + 1))
    room_x, room_y = wide - WIDTH, tall - HEIGHT
    y = int(rng.integers(0, room_y + 1))
    left = rng.random() < 0.5
    out = []
    for t in range(count):
        shots = []
        for k in range(6):
            at = np.clip((t + 0.5 * k / 6 - begin) / steps, 0.0, 1.0)
            x = round(room_x * (1 - at if left else at))
            shots.append(frames[t, y : y + HEIGHT, x : x + WIDTH])
        out.append(np.mean(shots, axis=0).astype(np.uint8))
    return np.stack(out)


def exposed(frames: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Return frames whose exposure changes, at once or over ten frames."""
    at, length = rng.integers(len(frames) // 3, 2 * len(frames) // 3), rng.choice([1, 10])
    gain = np.exp(np.clip((np.arange(len(frames)) - at) / length, 0, 1) * rng.choice([-0.8, 0.6]))
    return np.clip(frames * gain[:, None, None, None], 0, 255).astype(np.uint8)


def flashed(frames: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Return frames with flashes, of which some saturate the image."""
    out = frames.astype(np.float64)
    for _ in range(int(rng.integers(1, 3))):
        length = int(rng.integers(1, 4))
        at = int(rng.integers(len(frames) // 3, 2 * len(frames) // 3 - length + 1))
        out[at : at + length] = out[at : at + length] * rng.uniform(1.2, 2.5) + rng.uniform(60, 220)
    return np.clip(out, 0, 255).astype(np.uint8)


def joined(parts: list[ImageArray], lengths: list[int]) -> tuple[ImageArray, list[Change]]:
    """Join parts; between two of them lies a dissolve of that many frames, or at 0 a hard cut."""
    clip, changes = parts[0], []
    for following, length in zip(parts[1:], lengths, strict=True):
        stop = len(clip) - length
        alpha = (np.arange(1, length + 1) / (length + 1))[:, None, None, None]
        between = (1 - alpha) * clip[stop:] + alpha * following[:length]
        changes.append(Change(stop, stop + length))
        clip = np.concatenate((clip[:stop], between.astype(np.uint8), following[length:]))
    return clip, changes


def make_clip(found: dict[str, ImageArray], seed: int) -> tuple[ImageArray, list[Change], list[str]]:
    """Return one joined clip, its true cuts, and what its parts are."""
    rng = np.random.default_rng(seed)
    names: list[str] = []
    parts: list[ImageArray] = []
    looks: list[tuple[str, int]] = []
    for _ in range(int(rng.integers(2, 5))):
        while True:
            name, turn = str(rng.choice(sorted(found))), int(rng.integers(0, 3))
            look = (name.split(".")[0], turn)
            if not looks or looks[-1] != look:
                break
        frames = found[name]
        frames = frames if turn == 0 else frames[:, :, ::-1] if turn == 1 else frames[:, ::-1]
        names.append(f"{name}{('', '|', '-')[turn]}")
        looks.append(look)
        parts.append(part(frames, name, rng))
    lengths = [int(rng.choice([0, 0, 4, 8, 12, 16, 24])) for _ in parts[1:]]
    room = [min(len(a), len(b)) // 3 for a, b in pairwise(parts)]
    lengths = [min(length, most) for length, most in zip(lengths, room, strict=True)]
    return *joined(parts, lengths), names


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=CLIPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--show", action="store_true", help="print every cut that is missed or wrong")
    arguments = parser.parse_args()
    data = os.environ.get("UNI4D_FG_DATA")
    found = sources(Path(data) if data else None)
    config = ShotsConfig()
    true, hit = {"hard": 0, "dissolve": 0}, {"hard": 0, "dissolve": 0}
    wrong, frames, seconds = 0, 0, 0.0
    for seed in range(arguments.seed, arguments.seed + arguments.clips):
        clip, changes, names = make_clip(found, seed)
        began = time.perf_counter()
        cuts = find_cuts(ArrayFrames(clip), config)
        seconds += time.perf_counter() - began
        frames += len(clip)
        left = list(cuts)
        missed = []
        for change in changes:
            kind = "hard" if change.is_hard else "dissolve"
            true[kind] += 1
            near = [c for c in left if change.stop <= c.frame <= change.start]
            if near:
                hit[kind] += 1
                left.remove(near[0])
            else:
                missed.append(change)
        wrong += len(left)
        if arguments.show and (left or missed):
            print(f"{seed}: {names} true {[(c.stop, c.start) for c in changes]} missed "
                  f"{[(c.stop, c.start) for c in missed]} wrong {[(c.stop, c.start) for c in left]}")  # fmt: skip
    hits = sum(hit.values())
    print("| cuts | true | found | recall |\n|---|---|---|---|")
    for kind in true:
        print(f"| {kind} | {true[kind]} | {hit[kind]} | {hit[kind] / max(true[kind], 1):.3f} |")
    print(f"| all | {sum(true.values())} | {hits} | {hits / max(sum(true.values()), 1):.3f} |")
    print(f"\nprecision {hits / max(hits + wrong, 1):.3f} ({wrong} wrong); {1e3 * seconds / frames:.2f} ms a frame")


if __name__ == "__main__":
    main()
