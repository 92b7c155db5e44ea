"""Tracks joined again after an occlusion: how many, how many of them rightly, and what the cameras gain.

    python benchmarks/rejoin.py [--frames 60] [--hidden 15] [--seeds 3]

A bar passes in front of a synthetic scene and hides every point for a while; tracks continue behind it under new
numbers. A join is right if both tracks are the same material point. Recall counts the static points that have a
landmark on both sides. ATE is that of the same scene with its tracks cut, cut and joined, and never cut.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.factors.state import State
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.synthetic.occlusion import Occluded, pass_bar
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.slam.association.fragments import FragmentSearch
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise, StaticScene
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver


@dataclass
class Recorded:
    """A search that keeps what it was asked and what it found."""

    search: FragmentSearch
    track: np.ndarray | None = None
    name: np.ndarray | None = None
    seconds: float = 0.0

    def __call__(self, state: State, observations: Observations, noise: StaticNoise) -> np.ndarray:
        """Search, as the solve asks for it."""
        began = time.perf_counter()
        self.track, self.name = observations.rows()[0], self.search(state, observations, noise)
        self.seconds = time.perf_counter() - began
        return self.name


@dataclass(frozen=True)
class Score:
    """Joins against the truth."""

    joined: int
    right: int
    possible: int

    def __str__(self) -> str:
        return (
            f"{self.possible} points seen again, {self.joined} joins, recall {self.right / max(self.possible, 1):.3f}, "
            f"precision {self.right / max(self.joined, 1):.4f}"
        )


def score(recorded: Recorded, occluded: Occluded) -> Score:
    """Count joins; each is a track that is named by another one."""
    track, name = recorded.track, recorded.name
    assert track is not None
    assert name is not None
    there = np.isin(occluded.earlier, track) & np.isin(occluded.later, track)
    origin = np.arange(int(track.max()) + 1)
    continued = occluded.later[there]
    origin[continued] = occluded.earlier[there]
    joined = track != name
    return Score(int(joined.sum()), int((origin[track[joined]] == origin[name[joined]]).sum()), int(there.sum()))


def solve(sequence: Sequence, config: Config) -> tuple[StaticScene, Recorded | None, float]:
    """Run stages 1 and 2 and time the second."""
    assert sequence.tracks is not None
    labelled = label_tracks(sequence.tracks, sequence, config.labels, config.input)
    search = FragmentSearch.of(sequence, labelled, config.bundle_adjustment.rejoin)
    recorded = None if search is None else Recorded(search)
    solver = StaticSceneSolver(config, stage_runner(config), find_fragments=recorded)
    start = solver.initialize(labelled, sequence.intrinsics, free_intrinsics=True)
    began = time.perf_counter()
    scene = solver.adjust(labelled, start.cameras, sequence.intrinsics, Freedom(poses=True, intrinsics=True))
    return scene, recorded, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--hidden", type=int, default=15)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--set", nargs="*", default=[], help="changes of the configuration")
    arguments = parser.parse_args()
    joining = load_config(None, ["bundle_adjustment.rejoin.enabled=on", *arguments.set])
    apart = load_config(None, ["bundle_adjustment.rejoin.enabled=off", *arguments.set])
    for seed in range(arguments.seeds):
        whole = make_synthetic_sequence(SyntheticSceneConfig(num_frames=arguments.frames, seed=seed))
        occluded = pass_bar(whole, arguments.hidden)
        truth = whole.ground_truth.world_T_cam
        assert truth is not None
        row = []
        for name, sequence, config in (
            ("apart", occluded.sequence, apart),
            ("joined", occluded.sequence, joining),
            ("never cut", whole, apart),
        ):
            scene, recorded, seconds = solve(sequence, config)
            ate = evaluate_trajectory(scene.cameras.world_T_cam, truth).ate_m
            row.append(f"{name} {1e3 * ate:.2f} mm in {seconds:.2f} s")
            if recorded is not None:
                print(f"seed {seed}: {score(recorded, occluded)}, search {recorded.seconds:.2f} s")
        print(f"seed {seed}: ATE " + ", ".join(row), flush=True)


if __name__ == "__main__":
    main()
