"""What Adam minimizes in every stage against the formulas of the paper and of its authors' program, written out here.

Nothing of the package computes what is expected: projection, lifting, relative poses, visibility and the neighbors of
as-rigid-as-possible are loops over tracks, frames and coordinates. The stages are those of the preset 'paper' with the
options of docs/paper.md. Where the preset has a formula of its own in either case, the scenes are such that it and the
other ones are the same: cameras turn about one axis, by angles that the program's dead zone lets through, guards of
denominators are as good as zero, all that moves is one instance, and every track starts in frame 0.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from stage_samples import K, hide, observe, shift, static_points

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, POSE
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.optim.adam.runner import AdamRunner
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, adjust_bundle
from uni4d_fg.slam.stages.camera_init import PairSource, window_stage
from uni4d_fg.slam.stages.energy import energy_of
from uni4d_fg.slam.stages.nonrigid import solve_nonrigid
from uni4d_fg.slam.stages.observations import observations_of
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise

FRAMES, TRACKS, NEIGHBORS, REL = 6, 14, 4, 1e-6
GUARDS = [
    f"{stage}.camera_motion.{guard}=1e-9"
    for stage in ("camera_init", "bundle_adjustment")
    for guard in ("rotation_floor_rad", "translation_floor_m")
]
ONE_STEP = [
    "solver=adam", "adam.precision=float64", "adam.reference_windows=false", "camera_init.max_tracks_per_pair=0",
    *(f"adam.{stage}.max_iterations=1" for stage in ("camera_init", "bundle_adjustment", "nonrigid")),
]  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """A choice of formulas, and the options that take the preset there."""

    text: bool
    """Plain sums, equation 4, and relative poses in axes of a camera; else nested means and axes of the world."""
    listed: bool
    """The neighbors of every track are listed, mutual ones twice; else every pair once."""

    @property
    def config(self) -> Config:
        """The preset with the variant's options."""
        options = []
        if self.text:
            options += [
                "normalization=sum", "camera_init.kernel={kind: quadratic}",
                "camera_init.camera_motion={rotation_weight: 0, translation_weight: 0}",
                "bundle_adjustment.camera_motion.translation_axes=camera",
            ]  # fmt: skip
        if self.listed:
            options.append("nonrigid.arap_mutual_pairs=twice")
        return load_config("paper", [*GUARDS, *ONE_STEP, *options])


VARIANTS = {
    "text": Variant(text=True, listed=False),
    "text, neighbors listed": Variant(text=True, listed=True),
    "program": Variant(text=False, listed=True),
    "program, pairs once": Variant(text=False, listed=False),
}
every_variant = pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS.keys())
every_scene = pytest.mark.parametrize("seed", range(3))


@dataclass
class Recorder:
    """Adam for one step; remembers where each stage began and what the loss was there."""

    config: Config
    rng: np.random.Generator
    began: dict[str, tuple[State, float]] = field(default_factory=dict)

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        # Lifted points have no reprojection error, which would hide the term.
        moved = {
            variable: array + self.rng.normal(scale=0.02, size=array.shape)
            for variable, array in state.arrays.items()
            if variable in (LANDMARK, DYNAMIC_POINT)
        }
        state = state.replace(moved)
        _, summary = AdamRunner(self.config.adam)(stage, state, hooks)
        self.began[stage.kind] = state, summary.iterations[0].energy
        return state, summary


def turning_cameras(rng: np.random.Generator) -> np.ndarray:
    """Poses (T, 4, 4) that turn about one axis by unequal angles and move anyhow."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    angle = 0.0
    for t, turn in enumerate(0.02 + 0.024 * rng.permutation(np.arange(1, FRAMES)), start=1):
        angle += turn
        poses[t, :3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        poses[t, :3, 3] = poses[t - 1, :3, 3] + rng.normal(scale=0.06, size=3)
    return poses


def pixel_of(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """pi_K(p, xi)."""
    x = pose[:3, :3].T @ (point - pose[:3, 3])
    return np.array([K[0] * x[0] / x[2] + K[2], K[1] * x[1] / x[2] + K[3]])


def lifted(pose: np.ndarray, pixel: np.ndarray, depth: float) -> np.ndarray:
    """pi_K^{-1}(z, D, xi)."""
    x = np.array([(pixel[0] - K[2]) / K[0], (pixel[1] - K[3]) / K[1], 1.0]) * depth
    return pose[:3, :3] @ x + pose[:3, 3]


def rad(rotation: np.ndarray) -> float:
    """Angle of a rotation matrix as the program has it."""
    return float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0 + 1e-4, 1.0 - 1e-4)))


def camera_motion_of_the_text(poses: np.ndarray) -> float:
    """Sum of E_rot and E_trans over relative poses xi_{t+1}^{-1} xi_t."""
    total = 0.0
    relative = [np.linalg.inv(poses[t + 1]) @ poses[t] for t in range(len(poses) - 1)]
    for before, after in itertools.pairwise(relative):
        angles = [float(np.arccos((np.trace(pose[:3, :3]) - 1.0) / 2.0)) for pose in (before, after)]
        total += 2.0 * abs(angles[1] - angles[0]) / (angles[0] + angles[1])
        a, b = before[:3, 3], after[:3, 3]
        total += 2.0 * np.linalg.norm(b - a) / (np.linalg.norm(a) + np.linalg.norm(b))
    return float(total)


def camera_motion_of_the_program(poses: np.ndarray) -> float:
    """Means of both over differences of centers and of the turns in the world, with clamps and the dead zone."""
    turns, steps = [], []
    for t in range(1, len(poses) - 1):
        first = poses[t, :3, :3] @ poses[t - 1, :3, :3].T
        second = poses[t + 1, :3, :3] @ poses[t, :3, :3].T
        change = rad(second @ first.T)
        assert change > 0.02, "the scene keeps out of the dead zone"
        turns.append(change / ((rad(first) + rad(second)) / 2.0 + 1e-12))
        a, b = poses[t, :3, 3] - poses[t - 1, :3, 3], poses[t + 1, :3, 3] - poses[t, :3, 3]
        steps.append(np.linalg.norm(b - a) / ((np.linalg.norm(a) + np.linalg.norm(b)) / 2.0 + 1e-12))
    return float(np.mean(turns) + np.mean(steps))


def camera_motion(variant: Variant, poses: np.ndarray) -> float:
    return camera_motion_of_the_text(poses) if variant.text else camera_motion_of_the_program(poses)


def reprojection(
    variant: Variant, labelled: LabelledTracks, poses: np.ndarray, points: dict[tuple[int, int], np.ndarray]
) -> float:
    """E_BA and E_NR, of the points by track and frame."""
    total = 0.0
    for t in range(FRAMES):
        visible = [k for k in range(TRACKS) if labelled.tracks.visible[k, t]]
        errors = [np.linalg.norm(labelled.tracks.uv[k, t] - pixel_of(poses[t], points[k, t])) for k in visible]
        total += np.sum(errors) if variant.text else np.sum(errors) / len(errors) / FRAMES
    return float(total)


def scene(rng: np.random.Generator, label: TrackLabel) -> tuple[np.ndarray, LabelledTracks]:
    """Poses, and noisy tracks with wrong depth, some hidden in some frames but the first."""
    poses, points = turning_cameras(rng), static_points(rng, TRACKS)
    if label is TrackLabel.DYNAMIC:
        points = points[:, None] + np.cumsum(rng.normal(scale=0.05, size=(TRACKS, FRAMES, 3)), axis=1)
    labelled = observe(points, poses, label, int(label is TrackLabel.DYNAMIC))
    labelled = shift(labelled, rng.normal(size=(TRACKS, FRAMES, 2)))
    wrong = rng.uniform(0.9, 1.1, labelled.depth.shape).astype(np.float32)
    frame = np.arange(FRAMES)
    hidden = (rng.random((TRACKS, FRAMES)) < 0.3) & (frame > 0) & (frame < 4)  # three frames see every track
    return poses, hide(replace(labelled, depth=labelled.depth * wrong), hidden)


@every_scene
@every_variant
def test_stage_1(variant: Variant, seed: int) -> None:
    rng, config = np.random.default_rng(seed), variant.config
    poses, labelled = scene(rng, TrackLabel.STATIC)
    frames = [1, 2, 3, 4, 5]
    state = State({POSE: poses, INTRINSICS: K[None]})
    stage = window_stage(
        np.array(frames), state, PairSource(labelled, 0), config.camera_init, free_intrinsics=False,
        energy=energy_of(config),
    )  # fmt: skip
    recorder = Recorder(config, rng)
    recorder(stage, state)
    pairs = []
    for i, j in itertools.permutations(frames, 2):
        errors = []
        for k in range(TRACKS):
            if labelled.tracks.visible[k, i] and labelled.tracks.visible[k, j]:
                point = lifted(poses[i], labelled.tracks.uv[k, i].astype(float), float(labelled.depth[k, i]))
                errors.append(np.linalg.norm(labelled.tracks.uv[k, j] - pixel_of(poses[j], point)))
        pairs.append(np.sum(np.square(errors)) if variant.text else np.mean(errors))
    # The kernel is half the square, and equation 4 has no E_cam.
    program = np.mean(pairs) + camera_motion_of_the_program(poses[frames])
    expected = 0.5 * np.sum(pairs) if variant.text else program
    assert recorder.began["camera_init"][1] == pytest.approx(float(expected), rel=REL)


@every_scene
@every_variant
def test_stage_2(variant: Variant, seed: int) -> None:
    rng, config = np.random.default_rng(seed), variant.config
    poses, labelled = scene(rng, TrackLabel.STATIC)
    recorder = Recorder(config, rng)
    adjust_bundle(
        observations_of(labelled, TrackLabel.STATIC), Cameras(poses, K, np.zeros(FRAMES)), K, config.bundle_adjustment,
        Freedom(poses=True, intrinsics=False), energy_of(config), run=recorder,
    )  # fmt: skip
    state, loss = recorder.began["bundle_adjustment"]
    tracks = state.numbers(LANDMARK)[:, 0].tolist()
    assert tracks == list(range(TRACKS))
    points = {(k, t): state[LANDMARK][k] for k in range(TRACKS) for t in range(FRAMES)}
    expected = reprojection(variant, labelled, state[POSE], points) + camera_motion(variant, state[POSE])
    assert loss == pytest.approx(expected, rel=REL)
    assert camera_motion(variant, state[POSE]) > 0.01 * expected


def neighbors(labelled: LabelledTracks, poses: np.ndarray) -> list[tuple[int, int]]:
    """Return the nearest ones of every track in frame 0, (track, neighbor), by all distances."""
    start = [
        lifted(poses[0], labelled.tracks.uv[k, 0].astype(float), float(labelled.depth[k, 0])) for k in range(TRACKS)
    ]
    found = []
    for k in range(TRACKS):
        distance = {m: float(np.linalg.norm(start[k] - start[m])) for m in range(TRACKS) if m != k}
        found += [(k, m) for m in sorted(distance, key=distance.__getitem__)[:NEIGHBORS]]
    return found


@every_scene
@every_variant
def test_stage_3(variant: Variant, seed: int) -> None:
    rng, config = np.random.default_rng(seed), variant.config
    poses, labelled = scene(rng, TrackLabel.DYNAMIC)
    recorder = Recorder(config, rng)
    solve_nonrigid(
        observations_of(labelled, TrackLabel.DYNAMIC), labelled.instance, Cameras(poses, K, np.zeros(FRAMES)),
        StaticNoise(0.5, 0.02), config.nonrigid, energy_of(config), run=recorder,
    )  # fmt: skip
    state, loss = recorder.began["nonrigid"]
    numbers = [(int(k), int(t)) for k, t in state.numbers(DYNAMIC_POINT)]
    points = dict(zip(numbers, state[DYNAMIC_POINT], strict=True))
    seen = labelled.tracks.visible
    assert set(points) == {(k, t) for k in range(TRACKS) for t in range(FRAMES) if seen[k, t]}
    pairs = neighbors(labelled, poses)
    listed_twice = sum(pair[::-1] in pairs for pair in pairs) // 2
    assert 0 < listed_twice < len(pairs) // 2
    if not variant.listed:
        pairs = sorted({(min(pair), max(pair)) for pair in pairs})
    steps, changes = [], []
    for t in range(FRAMES - 1):
        for k in range(TRACKS):
            if seen[k, t] and seen[k, t + 1]:
                steps.append(np.linalg.norm(points[k, t + 1] - points[k, t]))
        for k, m in pairs:
            if seen[k, t] and seen[k, t + 1] and seen[m, t] and seen[m, t + 1]:
                now, after = points[k, t] - points[m, t], points[k, t + 1] - points[m, t + 1]
                changes.append(abs(np.linalg.norm(now) - np.linalg.norm(after)))
    reduce = np.sum if variant.text else np.mean
    motion = 10.0 * float(reduce(steps)) + 100.0 * float(reduce(changes))
    expected = reprojection(variant, labelled, poses, points) + motion
    assert loss == pytest.approx(expected, rel=REL)
    assert 0.01 * expected < motion < 0.99 * expected


def test_the_variants_are_different_energies() -> None:
    """Else the tests above would not tell one from another."""
    rng = np.random.default_rng(0)
    poses, _ = scene(rng, TrackLabel.STATIC)
    text, program = (camera_motion(VARIANTS[name], poses) for name in ("text", "program"))
    assert abs(text / (FRAMES - 2) / program - 1.0) > 1e-3
    configs = [variant.config for variant in VARIANTS.values()]
    assert len({config.model_dump_json() for config in configs}) == len(VARIANTS)
