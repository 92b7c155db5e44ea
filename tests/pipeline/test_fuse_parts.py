"""Fusion in parts, as worker processes do it: the bytes of one process, whatever the parts."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pipeline_scenes import TINY, make_config, make_scene

from uni4d_fg.frontend.sequence.frames import FramesInTurn
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.sequence.video import VideoFrames
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import run_stage
from uni4d_fg.pipeline import control, dense_maps, fuse, fuse_parts, reconstruct, run
from uni4d_fg.results.fusion.densify import ControlPoints, SomeControlPoints
from uni4d_fg.results.fusion.static_depth import HeldOut
from uni4d_fg.results.run_folder import RunFolder


class Elsewhere:
    """Does parts as workers do: each from a pickle, the last first."""

    count = 2

    def __call__(self, function: Any, items: Any) -> Iterator[tuple[int, Any]]:
        for index in reversed(range(len(items))):
            item = pickle.loads(pickle.dumps(items[index]))
            yield index, pickle.loads(pickle.dumps(function(item, run_stage, Hooks())))


@pytest.mark.parametrize(
    ("broken", "matched"), [([], False), pytest.param([5, 17], False, marks=pytest.mark.slow), ([5, 17], True)]
)
def test_parts_have_the_bytes_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: list[int], matched: bool
) -> None:
    if matched and find_extension()[0] is None:
        pytest.skip("needs the C++ extension")
    sequence = make_scene(TINY, num_frames=30)
    monkeypatch.setattr(control, "contradicting_frames", lambda control, config: broken)
    if matched:
        monkeypatch.setattr(dense_maps, "held_out_errors", lambda *_: HeldOut(0.01, 0.5, True))
    monkeypatch.setattr(fuse_parts, "_LEAST_FRAMES", 7)
    edges = []
    part_edges = fuse_parts.part_edges
    monkeypatch.setattr(fuse_parts, "part_edges", lambda *sizes: edges.append(part_edges(*sizes)) or edges[-1])
    told = []
    for where in (None, Elsewhere()):
        out = tmp_path / str(where is None)
        monkeypatch.setattr(run, "fuse_depth", partial(with_workers, where))
        fusion = reconstruct(sequence, out, make_config()).stages["fusion"]
        told.append({name: fusion[name] for name in ("facts", "broken_frames", "matched_frames", "depth_error")})
    assert edges == [[0, 8, 15, 22, 30]]
    assert told[1] == told[0]
    assert told[0]["broken_frames"] == broken
    assert not matched or told[0]["matched_frames"] == 30
    one, other = (RunFolder(tmp_path / name) for name in ("True", "False"))
    assert one.depth.read_bytes() == other.depth.read_bytes()
    assert one.confidence.read_bytes() == other.confidence.read_bytes()


def with_workers(workers: Any, *args: Any) -> dict[str, Any]:
    """Fuse on these workers."""
    return fuse.fuse_depth(*args[:-2], workers, args[-1])


def test_parts_are_as_many_as_suit_the_workers() -> None:
    assert fuse_parts.part_edges(1000, 2) == [0, 250, 500, 750, 1000]
    assert fuse_parts.part_edges(100, 4) == [0, 33, 67, 100]
    assert fuse_parts.part_edges(20, 4) == [0, 20]


def test_control_points_that_were_left_out_are_missed() -> None:
    control = [
        ControlPoints(
            np.full((1, 2), float(frame)), np.ones(1), np.zeros(1), np.zeros(1, np.int32), np.zeros((1, 3))
        )
        for frame in range(9)
    ]  # fmt: skip
    some = SomeControlPoints.of(control, -2, 4)
    assert len(some) == 9
    assert [some[frame].uv[0, 0] for frame in range(4)] == [0.0, 1.0, 2.0, 3.0]
    assert [points.uv[0, 0] for points in some[1:3]] == [1.0, 2.0]
    with pytest.raises(IndexError, match="frame 4"):
        _ = some[4]


def test_frames_that_are_large_or_foreign_are_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    class Maps:
        """As far as frames go."""

        def __init__(self, images: Any) -> None:
            self.sequence = replace(make_scene(TINY, num_frames=3), images=FramesInTurn(images))

    images = np.zeros((3, 4, 5, 3), np.uint8)
    assert fuse_parts.can_be_sent(Maps(ArrayFrames(images)))  # type: ignore[arg-type]
    assert not fuse_parts.can_be_sent(Maps(images[number] for number in range(3)))  # type: ignore[arg-type]
    monkeypatch.setattr(fuse_parts, "_MOST_BYTES", 100)
    assert not fuse_parts.can_be_sent(Maps(ArrayFrames(images)))  # type: ignore[arg-type]


def test_a_video_is_opened_again_by_another_process(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for _ in range(5):
        writer.write(rng.integers(0, 255, (48, 64, 3), np.uint8))
    writer.release()
    video = VideoFrames(path)
    first = [video[frame] for frame in range(5)]
    again = pickle.loads(pickle.dumps(video))
    assert (len(again), again.size, again.frame_rate) == (5, (48, 64), 10.0)
    for frame in (3, 0, 4, 1, 2):
        np.testing.assert_array_equal(again[frame], first[frame])
