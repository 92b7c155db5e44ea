"""How the cost of every stage grows with frames and tracks.

    python benchmarks/scaling.py [--frames 30 60 120] [--repeats 3]

Reconstructs synthetic scenes (no images, tracks given) with doubled frames and with doubled tracks, side by
side in one run, and prints the ratio of each stage's time to the previous size as a Markdown table (minimum
over the repeats). A ratio of 2 is linear. Tracks live for a fixed number of frames, so that twice the frames
are twice the observations. Clouds and pictures are left out.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.pipeline import reconstruct

STAGES = ("camera_init", "bundle_adjustment", "nonrigid", "fusion")
LIFE = 12
OVERRIDES = ["output.clouds=false", "output.pictures=false"]


def with_short_tracks(sequence: Sequence, life: int) -> Sequence:
    """Return the sequence with every track cut to ``life`` frames on either side of its query frame."""
    tracks = sequence.tracks
    assert tracks is not None
    away = np.abs(np.arange(tracks.num_frames) - tracks.query_frame[:, None])
    visible = tracks.visible & (away <= life)
    uv = np.where(visible[..., None], tracks.uv, np.float32(np.nan))
    return replace(sequence, tracks=Tracks(uv, visible, tracks.query_frame))


def seconds(scene: SyntheticSceneConfig, repeats: int) -> dict[str, float]:
    """Return the fastest time per stage."""
    sequence = with_short_tracks(make_synthetic_sequence(scene), LIFE)
    best = dict.fromkeys(STAGES, float("inf"))
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as root:
            summary = reconstruct(sequence, Path(root) / "run", load_config(None, OVERRIDES))
        for stage in STAGES:
            best[stage] = min(best[stage], float(summary.stages[stage]["seconds"]))
    return best


def table(title: str, sizes: list[str], times: list[dict[str, float]]) -> None:
    """Print seconds and ratios."""
    print(f"\n| {title} | " + " | ".join(STAGES) + " |")
    print("|---|" + "---|" * len(STAGES))
    for size, time in zip(sizes, times, strict=True):
        print(f"| {size}, s | " + " | ".join(f"{time[stage]:.2f}" for stage in STAGES) + " |")
    for (size, time), previous in zip(list(zip(sizes, times, strict=True))[1:], times, strict=False):
        print(f"| {size}, ratio | " + " | ".join(f"{time[s] / max(previous[s], 1e-9):.2f}" for s in STAGES) + " |")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[30, 60, 120])
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    base = SyntheticSceneConfig(render_images=False, grid_columns=32, grid_rows=24)
    by_frames = [seconds(base.model_copy(update={"num_frames": n}), arguments.repeats) for n in arguments.frames]
    table("frames", [str(n) for n in arguments.frames], by_frames)
    grids = [(32, 24), (48, 32), (64, 48)]
    by_tracks = [
        seconds(base.model_copy(update={"grid_columns": c, "grid_rows": r}), arguments.repeats) for c, r in grids
    ]
    table("tracks", [f"{c}x{r} grid" for c, r in grids], by_tracks)


if __name__ == "__main__":
    main()
