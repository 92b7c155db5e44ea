"""How the cost of every stage grows with frames and tracks.

    python benchmarks/scaling.py [--frames 30 60 120] [--repeats 3]

Reconstructs synthetic scenes (no images, tracks given) with doubled frames and with doubled tracks, side by
side in one run, and prints the ratio of each stage's time to the previous size as a Markdown table (minimum
over the repeats). A ratio of 2 is linear. Clouds and pictures are left out.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from uni4d_fg.config.load import load_config
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.synthetic import SyntheticSceneConfig, make_synthetic_sequence

STAGES = ("camera_init", "bundle_adjustment", "nonrigid", "fusion")
OVERRIDES = ["output.clouds=false", "output.pictures=false"]


def seconds(scene: SyntheticSceneConfig, repeats: int) -> dict[str, float]:
    """Return the fastest time per stage."""
    sequence = make_synthetic_sequence(scene)
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
