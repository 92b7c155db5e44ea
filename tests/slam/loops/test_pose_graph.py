"""Closing a path whose landmarks are gone: against the truth, with wrong closures, and in a stream."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.load import load_config
from uni4d_fg.config.loops import LoopsConfig
from uni4d_fg.frontend.synthetic.circuit import circuit
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.pipeline.stream import stream_sequence
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.slam.incremental.model import DynamicPoints, FinishedFrame, FrameStatus, Landmarks
from uni4d_fg.slam.loops.closing import LoopClosing
from uni4d_fg.slam.loops.links import Link
from uni4d_fg.slam.loops.pose_graph import ClosedPath, close_path

FRAMES = 60
SIGMA = np.repeat([0.004, 0.006], 3)
"""Of a step, rad and m."""
LINK_SIGMA = 0.002
POINT = np.array([[0.1, -0.2, 2.0]])
"""In the axes of every camera."""


@dataclass(frozen=True)
class Left:
    """Frames and landmarks that a stream has left: one point each in front of every camera."""

    poses: FloatArray
    covariance: FloatArray

    def frames(self) -> Iterator[FinishedFrame]:
        number, color = np.array([1]), np.zeros((1, 3), np.uint8)
        for t, (pose, covariance) in enumerate(zip(self.poses, self.covariance, strict=True)):
            point = camera_to_world(pose[None], POINT)
            moving = DynamicPoints(number, number, point, np.ones(1, dtype=bool), color)
            yield FinishedFrame(t, float(t), FrameStatus.KEYFRAME, pose, covariance, 0.0, moving)

    def landmarks(self) -> Iterator[Landmarks]:
        one = np.ones(1)
        for t, pose in enumerate(self.poses):
            point = camera_to_world(pose[None], POINT)
            yield Landmarks(np.array([t]), point, one, np.array([9]), np.zeros((1, 3), np.uint8), np.array([t]))


def ring() -> FloatArray:
    """Cameras (T, 4, 4) on a circle, which ends where it began."""
    angle = 2 * np.pi * np.arange(FRAMES) / (FRAMES - 1)
    turn = np.stack([0 * angle, angle, 0 * angle], axis=1)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = np.stack([se3.so3_exp(w) for w in turn])
    poses[:, :3, 3] = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    return poses


def drifted(true: FloatArray, rng: np.random.Generator) -> Left:
    """Steps with noise, and the covariances that they add up to."""
    poses, covariance = true.copy(), np.zeros((FRAMES, 6, 6))
    for t in range(1, FRAMES):
        step = se3.inverse(true[t - 1]) @ true[t]
        noise = se3.se3_exp(SIGMA * rng.normal(size=6))
        poses[t] = poses[t - 1] @ step @ noise
        covariance[t] = se3.composed_covariance(covariance[t - 1], step, np.diag(SIGMA**2))
    return Left(poses, covariance)


def closed(path: Left, links: list[Link]) -> tuple[ClosedPath | None, LoopClosing]:
    sequence = circuit(2)
    closing = LoopClosing(sequence, PINHOLE, LoopsConfig(), links)
    return close_path(path, path.poses, path.covariance, closing), closing


def seen_again(true: FloatArray, rng: np.random.Generator, first: int, second: int) -> Link:
    relative = se3.inverse(true[first]) @ true[second] @ se3.se3_exp(LINK_SIGMA * rng.normal(size=6))
    return Link(first, second, relative, np.eye(6) / LINK_SIGMA**2, 50, 2.0)


def test_the_ring_is_closed_within_its_covariances() -> None:
    true, normalized, gain = ring(), [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        path = drifted(true, rng)
        found, closing = closed(path, [seen_again(true, rng, 0, FRAMES - 1), seen_again(true, rng, 2, FRAMES - 2)])
        assert found is not None
        assert not closing.let_go
        twist = se3.se3_log(se3.inverse(true) @ found.new)
        gain.append(np.linalg.norm(twist[-1]) / np.linalg.norm(se3.se3_log(se3.inverse(true[-1:]) @ path.poses[-1:])))
        information = np.linalg.inv(found.covariance[1:])
        normalized.append(np.einsum("ti,tij,tj->t", twist[1:], information, twist[1:]) / 6.0)
        assert (
            np.trace(found.covariance, axis1=1, axis2=2) <= 1.01 * np.trace(path.covariance, axis1=1, axis2=2)
        ).all()
    assert np.median(gain) < 0.1
    assert 0.6 < np.mean(normalized) < 1.6


def test_what_hangs_on_a_frame_moves_with_it() -> None:
    true, rng = ring(), np.random.default_rng(3)
    path = drifted(true, rng)
    found, _ = closed(path, [seen_again(true, rng, 0, FRAMES - 1)])
    assert found is not None
    for t, (frame, landmarks) in enumerate(zip(found.frames(), found.landmarks(), strict=True)):
        there = camera_to_world(found.new[t][None], POINT)
        np.testing.assert_allclose(frame.dynamic.point, there, atol=1e-9)
        np.testing.assert_allclose(landmarks.point, there, atol=1e-9)
        np.testing.assert_array_equal(frame.world_T_cam, found.new[t])


def test_a_wrong_closure_is_let_go() -> None:
    true, rng = ring(), np.random.default_rng(1)
    path = drifted(true, rng)
    good = [seen_again(true, rng, 0, FRAMES - 1), seen_again(true, rng, 1, FRAMES - 2)]
    wrong = replace(good[0], first=5, second=35, first_T_second=np.eye(4))
    found, closing = closed(path, [*good, wrong])
    alone, _ = closed(path, good)
    assert found is not None
    assert alone is not None
    assert closing.let_go == [wrong]
    np.testing.assert_allclose(found.new, alone.new, atol=1e-6)


def test_a_path_that_tells_no_covariances_stays_open() -> None:
    true, rng = ring(), np.random.default_rng(1)
    path = replace(drifted(true, rng), covariance=np.full((FRAMES, 6, 6), np.nan))
    assert closed(path, [seen_again(true, rng, 0, FRAMES - 1)])[0] is None


@pytest.mark.slow
def test_a_stream_that_comes_back_is_closed(tmp_path: Path) -> None:
    sequence = circuit(130, 1.1)
    true = sequence.ground_truth.world_T_cam
    assert true is not None
    ate = []
    for enabled in ("off", "auto"):
        config = load_config("default", [f"loops.enabled={enabled}", "loops.min_gap=40"])
        summary = stream_sequence(sequence, tmp_path / enabled, config)
        found = load_reconstruction(tmp_path / enabled / "reconstruction.npz")
        ate.append(evaluate_trajectory(found.world_T_cam, true).ate_m)
        assert any("1 loop closed" in fact for fact in summary.facts) == (enabled == "auto")
    assert ate[1] < 0.5 * ate[0]
