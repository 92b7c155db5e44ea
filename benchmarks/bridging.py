"""Points that are hidden for a while, as the built-in tracker finds them again: how many, how many rightly, what for.

    python benchmarks/bridging.py [--scene small|forward|large] [--occluder none|bar|discs] [--hidden 15] [--seeds 2]

A bar or textured discs pass in front of a rendered scene. Recall counts the static points that were followed rightly
up to the occluder and come back in sight within twenty frames, for at least six; a join is right if the point lies no
more than 2 px farther from the truth than before it was hidden. Cameras are solved with masks of the objects and the
occluder, without and with bridging.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import cv2
import numpy as np
from drift import Truth

from uni4d_fg.config.load import load_config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic.simulate import simulate
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver

SCENES = {
    "small": {},
    "forward": {"path": "forward", "objects": "none"},
    "large": {"height": 360, "width": 480, "focal": 450.0, "frame_rate": 30, "objects": "rigid"},
}
FRAMES = 60
OCCLUDER = 9
"""Mask id of the occluder."""
GRID = ["tracking.grid_columns=24", "tracking.grid_rows=18"]
LIMIT_FRAMES, LEAST_IN_SIGHT, TOLERANCE_PX = 20, 6, 2.0


def covered(kind: str, shape: tuple[int, int, int], hidden: int, rng: np.random.Generator) -> np.ndarray:
    """Return where (T, H, W) the occluder is, which hides what stands still for a number of frames."""
    frames, height, width = shape
    y, x = np.mgrid[:height, :width]
    result = np.zeros(shape, bool)
    if kind == "bar":
        speed = width / (frames - 10 - hidden)
        for t in range(frames):
            result[t] = (x < speed * (t - 5)) & (x >= speed * (t - 5 - hidden))
    elif kind == "discs":
        radius = 0.16 * height
        for _ in range(3):
            angle = rng.uniform(0, 2 * np.pi)
            step = 2.2 * radius / hidden * np.array([np.cos(angle), np.sin(angle)])
            middle = np.array([width, height]) * (0.5 + rng.uniform(-0.25, 0.25, 2))
            for t in range(frames):
                u, v = middle + step * (t - frames / 2)
                result[t] |= (x - u) ** 2 + (y - v) ** 2 < radius**2
    return result


@dataclass(frozen=True)
class Score:
    """Joins against the truth."""

    possible: int
    joined: int
    right: int

    def __str__(self) -> str:
        return (
            f"{self.possible} points seen again, {self.joined} joined, "
            f"recall {self.right / max(self.possible, 1):.2f}, precision {self.right / max(self.joined, 1):.3f}"
        )


def score(tracks: Tracks, truth: Truth, hides: np.ndarray) -> Score:
    """Count joins in both directions of time."""
    frames, height, width = hides.shape
    error = np.linalg.norm(tracks.uv - truth.uv, axis=2)
    pixel = np.rint(np.clip(np.nan_to_num(truth.uv, nan=-1.0), 0, [width - 1, height - 1])).astype(int)
    hidden = np.isfinite(truth.uv[..., 0]) & hides[np.arange(frames), pixel[..., 1], pixel[..., 0]]
    seen = truth.seen & ~hidden
    possible = joined = right = 0
    for k, query in enumerate(tracks.query_frame):
        for order in (np.arange(query, frames), np.arange(query, -1, -1)):
            first = int(hidden[k, order].argmax())
            # Three frames before, what is in front is not in the window yet.
            before = order[max(first - 3, 0)]
            good = first >= 5 and tracks.visible[k, before] and error[k, before] <= TOLERANCE_PX
            again = seen[k, order[first:]]
            if not (good and hidden[k, order[first]] and again.any()):
                continue
            begin = int(again.argmax())
            run = again[begin:]
            length = len(run) if run.all() else int(run.argmin())
            if length < LEAST_IN_SIGHT or begin > LIMIT_FRAMES:
                continue
            possible += 1
            place = order[first + begin : first + begin + length]
            found = place[tracks.visible[k, place]]
            if len(found):
                joined += 1
                right += bool(error[k, found[0]] <= error[k, before] + TOLERANCE_PX)
    return Score(possible, joined, right)


def ate_mm(sequence: Sequence, changes: list[str]) -> float:
    """Solve stages 1 and 2 with the sequence's tracks."""
    config = load_config(None, changes)
    assert sequence.tracks is not None
    assert sequence.ground_truth.world_T_cam is not None
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    solver = StaticSceneSolver(config, stage_runner(config), timestamps=sequence.timestamps)
    start = solver.initialize(labelled, sequence.intrinsics, free_intrinsics=True)
    scene = solver.adjust(labelled, start.cameras, sequence.intrinsics, Freedom(poses=True, intrinsics=True))
    return 1e3 * evaluate_trajectory(scene.cameras.world_T_cam, sequence.ground_truth.world_T_cam).ate_m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default="small")
    parser.add_argument("--occluder", choices=["none", "bar", "discs"], default="discs")
    parser.add_argument("--hidden", type=int, default=15)
    parser.add_argument("--seeds", type=int, default=2, help="of the discs' paths")
    parser.add_argument("--set", nargs="*", default=[], help="changes of the configuration")
    arguments = parser.parse_args()
    simulation = simulate(
        SyntheticSceneConfig(num_frames=FRAMES, grid_columns=2, grid_rows=2, **SCENES[arguments.scene])
    )
    scene = simulation.sequence
    for seed in range(arguments.seeds):
        rng = np.random.default_rng(seed)
        hides = covered(arguments.occluder, (FRAMES, *scene.image_size), arguments.hidden, rng)
        images, masks = np.stack(list(scene.images)), np.stack(list(scene.masks))
        noise = cv2.GaussianBlur(rng.uniform(0, 255, images.shape[1:3]), (0, 0), 2.5)
        front = np.clip(110 + 4 * (noise - noise.mean()), 0, 255).astype(np.uint8)
        for t in range(FRAMES):
            # What covers the scene carries its texture along.
            moved = np.roll(front, (2 * t, 5 * t), (0, 1))
            images[t][hides[t]] = moved[hides[t]][:, None]
            masks[t][hides[t]] = OCCLUDER
        for bridged in (False, True):
            changes = [*GRID, f"tracking.bridge_frames={25 if bridged else 0}", *arguments.set]
            began = time.process_time()
            tracks = track_grid(ArrayFrames(images), load_config(None, changes).tracking)
            seconds = time.process_time() - began
            found = score(tracks, Truth.of(tracks, scene, simulation.masks), hides)
            given = replace(scene, images=ArrayFrames(images), masks=ArrayFrames(masks), tracks=tracks)
            print(
                f"seed {seed}, {'with' if bridged else 'without'} bridging: {found}; tracking {seconds:.2f} s; "
                f"ATE {ate_mm(given, changes):.2f} mm",
                flush=True,
            )


if __name__ == "__main__":
    main()
