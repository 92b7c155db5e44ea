"""Loops: what is found in walks that come back and in others, and what closing does to drifted cameras."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.loops import LoopsConfig
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LOG_SCALE, POSE
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic.circuit import circuit, forgetful
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.optim.added_factors import with_additions
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.loops.closing import LoopClosing, find_loops
from uni4d_fg.slam.loops.links import Link, link
from uni4d_fg.slam.loops.places import describe

FRAMES = 48
CONFIG = LoopsConfig(interval=1, min_gap=20)
ROTATION_STEP, TRANSLATION_STEP = 0.004, 0.004
"""Drift per frame, rad and m: 11 degrees and 19 cm over the walk."""


@functools.cache
def walk() -> Sequence:
    """A lap and a tenth in 48 frames: frame 43 stands where frame 0 did."""
    return circuit(FRAMES, 1.1)


def truth(sequence: Sequence) -> FloatArray:
    poses = sequence.ground_truth.world_T_cam
    assert poses is not None
    return poses


def drifted(poses: FloatArray) -> FloatArray:
    """Let the cameras turn and slide a little more from each frame to the next."""
    step = se3.se3_exp(np.array([0.0, ROTATION_STEP, 0.0, TRANSLATION_STEP, 0.0, 0.0]))
    out = poses.copy()
    for t in range(1, len(poses)):
        out[t] = out[t - 1] @ se3.inverse(poses[t - 1]) @ poses[t] @ step
    return out


def cameras(sequence: Sequence, poses: FloatArray) -> State:
    return State({POSE: poses, INTRINSICS: sequence.intrinsics[None], LOG_SCALE: np.zeros((len(poses), 1))})


def error(one: Link, poses: FloatArray) -> FloatArray:
    """Return the twist (6,) between a link and the truth."""
    real = se3.inverse(poses[one.first]) @ poses[one.second]
    twist: FloatArray = se3.se3_log((se3.inverse(one.first_T_second) @ real)[None])[0]
    return twist


@functools.cache
def found() -> tuple[Link, ...]:
    return tuple(find_loops(walk(), PINHOLE, cameras(walk(), drifted(truth(walk()))), CONFIG))


def test_a_link_is_the_relative_pose_within_its_covariance() -> None:
    sequence = walk()
    first, second, elsewhere = (
        describe(sequence, frame, sequence.intrinsics, PINHOLE, 0.0, CONFIG) for frame in (0, 43, 20)
    )
    one = link(first, second, sequence.intrinsics, sequence.image_size, CONFIG)
    assert one is not None
    twist = error(one, truth(sequence))
    assert np.linalg.norm(twist[:3]) < np.radians(0.3)
    assert np.linalg.norm(twist[3:]) < 0.01
    assert twist @ one.information @ twist < 30.0
    assert link(first, elsewhere, sequence.intrinsics, sequence.image_size, CONFIG) is None


def test_every_place_that_is_seen_again_is_found_and_none_else() -> None:
    sequence, links = walk(), found()
    assert len(links) >= 4
    errors = [error(one, truth(sequence)) for one in links]
    for one, twist in zip(links, errors, strict=True):
        assert one.second - one.first > 35
        # Frames that share only an edge of their images know little of each other, and must say so.
        assert np.linalg.norm(twist[:3]) < np.radians(3.0)
        assert np.linalg.norm(twist[3:]) < 0.1
    normalized = [twist @ one.information @ twist for one, twist in zip(links, errors, strict=True)]
    assert 0.5 < np.mean(normalized) / 6.0 < 1.5
    assert np.max(normalized) < 20.0


class _Unread:
    """Images that must not be read."""

    def __len__(self) -> int:
        return FRAMES

    def __getitem__(self, frame: int) -> ImageArray:
        raise AssertionError(f"frame {frame} was read")

    def __iter__(self) -> Iterator[ImageArray]:
        raise AssertionError("frames were read")


def test_a_camera_that_keeps_looking_at_one_place_has_none_and_reads_no_image() -> None:
    sequence = replace(walk(), images=_Unread())
    still = np.tile(truth(walk())[:1], (FRAMES, 1, 1))
    assert find_loops(sequence, PINHOLE, cameras(sequence, still), CONFIG) == []


@pytest.mark.parametrize("world", ["tiled room", "tiled corridor"])
def test_tiles_that_repeat_are_no_loop(world: str) -> None:
    sequence = circuit(FRAMES, 0.75, world=world)  # type: ignore[arg-type]
    assert find_loops(sequence, PINHOLE, cameras(sequence, drifted(truth(sequence))), CONFIG) == []


def solve(closing: LoopClosing, times: int = 2) -> FloatArray:
    """Solve the graph of a drifted walk with closing, as bundle adjustment does, and return its poses."""
    poses = drifted(truth(walk()))
    sigmas = np.repeat([1.5 * ROTATION_STEP, 1.5 * TRANSLATION_STEP], 3)
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    steps = [
        gtsam.BetweenFactorPose3(
            POSE.key(t), POSE.key(t + 1), gtsam.Pose3(se3.inverse(poses[t]) @ poses[t + 1]), noise
        )
        for t in range(FRAMES - 1)
    ]  # fmt: skip
    state, run = cameras(walk(), poses), with_additions(run_stage, [closing])
    for _ in range(times):
        problem = Problem.over(state).fix(POSE, rows=[0]).fix(INTRINSICS).fix(LOG_SCALE)
        problem.add(steps, state=state)
        state, _ = run(Stage("bundle_adjustment", problem, SolverConfig(max_iterations=100)), state, None)
    return state[POSE]


def closing_with(links: list[Link] | None) -> LoopClosing:
    return LoopClosing(walk(), PINHOLE, CONFIG, None if links is None else list(links))


def test_closing_takes_the_drift_out_of_the_walk() -> None:
    real = truth(walk())
    closing = closing_with(list(found()))
    before = evaluate_trajectory(drifted(real), real).ate_m
    after = evaluate_trajectory(solve(closing), real).ate_m
    assert after < 0.25 * before
    assert closing.let_go == []
    assert closing.facts()[0].startswith("1 loop closed: frames ")


def test_a_wrong_closure_is_let_go_and_warned_of() -> None:
    right = list(found())
    wrong = replace(right[0], first=3, second=28)
    closing = closing_with([*right, wrong])
    clean, disturbed = solve(closing_with(right)), solve(closing)
    assert [(one.first, one.second) for one in closing.let_go] == [(3, 28)]
    np.testing.assert_allclose(disturbed, clean, atol=1e-3)
    assert closing.warnings() == [
        "1 pair of frames that look like the same place contradict the rest and were let go: frames 3 and 28"
    ]


def test_solves_of_some_cameras_are_left_alone() -> None:
    closing = closing_with(None)
    sequence = walk()
    some = cameras(sequence, truth(sequence)[:10])
    assert closing(Stage("bundle_adjustment", Problem.over(some), SolverConfig()), some) is None
    assert closing(Stage("nonrigid", Problem.over(some), SolverConfig()), some) is None
    assert closing.links is None


def test_tracks_that_were_lost_are_not_seen_again() -> None:
    visible = np.zeros((2, 20), dtype=bool)
    visible[0, [2, 3, 4, 6, 7, 15, 16]] = True
    visible[1, 1:] = True
    uv = np.zeros((2, 20, 2), dtype=np.float32)
    cut = forgetful(Tracks(uv, visible, np.array([2, 1], dtype=np.int32)), life=10)
    assert np.flatnonzero(cut.visible[0]).tolist() == [2, 3, 4, 6, 7]
    assert np.flatnonzero(cut.visible[1]).tolist() == list(range(1, 11))
    assert np.isnan(cut.uv[1, 11:]).all()
