"""Loop closing as a source of factors: it looks for loops when bundle adjustment first has all cameras.

What it finds are relative poses with a robust kernel. They are asked for again before every later solve, and those that
the earlier ones left far away are let go: a wrong one then pulls at nothing.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.loops import LoopsConfig
from uni4d_fg.counted import counted
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LOG_SCALE, POSE
from uni4d_fg.frontend.measurements.relative_poses import RelativePoses
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.optim.added_factors import Addition
from uni4d_fg.optim.stage import Stage
from uni4d_fg.slam.loops.links import Link, link
from uni4d_fg.slam.loops.places import Place, alike, describe, lost_from_sight
from uni4d_fg.slam.measurements.relative_poses import RelativePoseSource

_LISTED = 5


@dataclass
class LoopClosing:
    """Finds loops in a sequence, and closes them; a :data:`~uni4d_fg.optim.added_factors.FactorSource`."""

    sequence: Sequence
    """Images, depth and masks."""
    lens: Lens
    """Of the images; the solved cameras are of a pinhole."""
    config: LoopsConfig
    links: list[Link] | None = None
    """Those that still hold; None before the search."""
    let_go: list[Link] = field(default_factory=list)
    """Those that bundle adjustment did not follow."""
    asked: bool = False
    """Whether a solve had them."""
    seconds: float = 0.0
    """CPU time of the search, s."""

    @property
    def fingerprint(self) -> str:
        """What a resumed run compares."""
        return f"loops {self.config.model_dump_json()}"

    def __call__(self, stage: Stage, state: State) -> Addition | None:
        """Search, or judge what was found, and return what holds; None for solves of some of the cameras."""
        everywhere = len(state[POSE]) == self.sequence.num_frames if POSE in state else False
        if not stage.finds_cameras or stage.own_world or not everywhere:
            return None
        if self.links is None:
            self.search(state)
        if self.asked:
            self.judge(state[POSE])
        self.asked = True
        source = self.source()
        return None if source is None else source(stage, state)

    def search(self, state: State) -> None:
        """Look for loops, with the cameras of all frames as solved so far."""
        began = time.process_time()
        self.links = find_loops(self.sequence, self.lens, state, self.config)
        self.seconds = time.process_time() - began

    def source(self) -> RelativePoseSource | None:
        """Return what holds as factors; None where nothing does."""
        if not self.links:
            return None
        poses = RelativePoses(
            np.array([one.first for one in self.links]),
            np.array([one.second for one in self.links]),
            np.stack([one.first_T_second for one in self.links]),
            np.stack([one.information for one in self.links]),
        )
        return RelativePoseSource(poses, self.config.kernel, is_metric=False)

    def judge(self, world_T_cam: FloatArray) -> bool:
        """Let go what solved cameras (T, 4, 4) left far away; return whether anything was."""
        links = self.links or []
        holds = [self._sigmas(one, world_T_cam) <= self.config.let_go for one in links]
        self.let_go += [one for one, good in zip(links, holds, strict=True) if not good]
        self.links = [one for one, good in zip(links, holds, strict=True) if good]
        return not all(holds)

    @staticmethod
    def _sigmas(one: Link, world_T_cam: FloatArray) -> float:
        twist = _difference(one, world_T_cam)
        return float(np.sqrt(twist @ one.information @ twist))

    def facts(self) -> list[str]:
        """Return what to say of the loops."""
        if not self.links:
            return []
        loops = self.loops()
        names = ", ".join(
            f"{part[0].first} and {part[0].second} ({counted(len(part), 'pair')})" for part in loops[:_LISTED]
        )
        more = ", ..." if len(loops) > _LISTED else ""
        return [f"{counted(len(loops), 'loop')} closed: frames {names}{more}"]

    def warnings(self) -> list[str]:
        """Return what to distrust."""
        if not self.let_go:
            return []
        pairs = ", ".join(f"{one.first} and {one.second}" for one in self.let_go[:_LISTED])
        return [
            f"{counted(len(self.let_go), 'pair')} of frames that look like the same place contradict the rest and "
            f"were let go: frames {pairs}{', ...' if len(self.let_go) > _LISTED else ''}"
        ]

    def loops(self) -> list[list[Link]]:
        """Return the links that hold, neighbors in both frames together, the one with most matches first."""
        reach = 2 * self.config.min_gap
        groups: list[list[Link]] = []
        for one in self.links or []:
            near = [g for g in groups if any(_apart(one, other) <= reach for other in g)]
            for group in near:
                groups.remove(group)
            groups.append(sorted(sum(near, [one]), key=lambda part: -part.inliers))
        return sorted(groups, key=lambda group: min(part.second for part in group))


def _apart(one: Link, other: Link) -> int:
    return max(abs(one.first - other.first), abs(one.second - other.second))


def _difference(one: Link, world_T_cam: FloatArray) -> FloatArray:
    """Return the twist (6,) from a link's relative pose to that of the cameras."""
    present = se3.inverse(world_T_cam[one.first]) @ world_T_cam[one.second]
    twist: FloatArray = se3.se3_log((se3.inverse(one.first_T_second) @ present)[None])[0]
    return twist


def find_loops(sequence: Sequence, lens: Lens, state: State, config: LoopsConfig) -> list[Link]:
    """Return the links of frames that see a place again.

    Args:
        sequence: Images, depth and masks of all T frames.
        lens: Of the images.
        state: Cameras of all frames as solved so far.
        config: What is compared and believed.
    """
    world_T_cam, intrinsics = state[POSE], state[INTRINSICS][0]
    log_scale = state[LOG_SCALE][:, 0] if LOG_SCALE in state else np.zeros(len(world_T_cam))
    frames = np.arange(0, len(world_T_cam), config.interval)
    gap = frames[None, :] - frames[:, None]
    if not (gap >= config.min_gap).any():
        return []
    allowed = lost_from_sight(sequence, frames, world_T_cam, intrinsics, log_scale, config) & (gap >= config.min_gap)
    if not allowed.any():
        return []
    places = [describe(sequence, f, intrinsics, lens, float(log_scale[f]), config) for f in frames.tolist()]
    search = _Search(places, world_T_cam, intrinsics, sequence.image_size, allowed, config)
    return search.links(alike(places, config.words))


@dataclass
class _Search:
    places: list[Place]
    world_T_cam: FloatArray
    intrinsics: FloatArray
    size: tuple[int, int]
    allowed: BoolArray
    """(P, P) pairs that may be a loop, the earlier one first."""
    config: LoopsConfig
    tried: dict[tuple[int, int], Link | None] = field(default_factory=dict)

    def links(self, likeness: FloatArray) -> list[Link]:
        """Return what is believed among the pairs that look most alike, and the neighbors that say the same."""
        believed: dict[tuple[int, int], Link] = {}
        for j in range(len(self.places)):
            earlier = np.flatnonzero(self.allowed[:, j])
            best = earlier[np.argsort(-likeness[earlier, j], kind="stable")][: self.config.candidates]
            for i in best.tolist():
                found = self.link(i, j)
                if found is None:
                    continue
                supporters = self.supporters(found, i, j)
                if len(supporters) >= self.config.support:
                    believed.update({(i, j): found, **supporters})
        return [believed[pair] for pair in sorted(believed)]

    def link(self, i: int, j: int) -> Link | None:
        """Return the link of two places that the way between them allows."""
        if (i, j) not in self.tried:
            found = link(self.places[i], self.places[j], self.intrinsics, self.size, self.config)
            self.tried[i, j] = found if found is not None and self._is_drift(found) else None
        return self.tried[i, j]

    def supporters(self, one: Link, i: int, j: int) -> dict[tuple[int, int], Link]:
        """Return the neighboring links that say the same."""
        out = {}
        for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
            pair = (i + di, j + dj)
            inside = pair[0] >= 0 and pair[1] < len(self.places) and pair[0] < pair[1]
            other = self.link(*pair) if inside and self.allowed[pair] else None
            if other is not None and self._same(one, other):
                out[pair] = other
        return out

    def _same(self, one: Link, other: Link) -> bool:
        poses = self.world_T_cam
        there = se3.inverse(poses[one.first]) @ poses[other.first] @ other.first_T_second
        expected = there @ se3.inverse(poses[other.second]) @ poses[one.second]
        twist = se3.se3_log((se3.inverse(one.first_T_second) @ expected)[None])[0]
        return bool(
            np.linalg.norm(twist[:3]) <= self.config.max_disagreement_rad
            and np.linalg.norm(twist[3:]) <= self.config.max_disagreement_depth * one.depth
        )

    def _is_drift(self, one: Link) -> bool:
        """Return whether the cameras may have drifted as far as a link says."""
        way = self.world_T_cam[one.first : one.second + 1 : max(1, self.config.interval)]
        steps = se3.inverse(way[:-1]) @ way[1:]
        length = np.linalg.norm(steps[:, :3, 3], axis=1).sum()
        turn = np.linalg.norm(se3.so3_log(steps[:, :3, :3]), axis=1).sum()
        twist = _difference(one, self.world_T_cam)
        return bool(
            np.linalg.norm(twist[3:]) <= self.config.max_drift * length
            and np.linalg.norm(twist[:3]) <= self.config.max_drift * turn
        )
