"""What to distrust in a run, the most serious first: what it warned of itself, and what its numbers say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from uni4d_fg.results.measures import pose_sigmas, scene_depth
from uni4d_fg.results.residuals import Residuals
from uni4d_fg.results.run import Run

_MIN_STATIC_PER_FRAME = 30
_OUTLYING_FRAME = 3.0
_LARGE_POSITION_SIGMA = 0.02
_LARGE_FOCAL_SIGMA = 0.04
_LARGE_SCALE_SPREAD = 0.15
_LARGE_DROPPED_SHARE = 0.1
_UNFINISHED_DECREASE = 1e-4


def distrusted(run: Run, residuals: Residuals | None) -> list[str]:
    """Return one sentence for everything that a reader should know before using the result."""
    found = [*_own_warnings(run), *_dropped(run), *_geometry(run)]
    if residuals is not None:
        found += _frames(run, residuals)
    found += _solvers(run.summary)
    return list(dict.fromkeys(found))


def _own_warnings(run: Run) -> Iterator[str]:
    cues = run.summary.get("cues")
    warnings = list(map(_sentence, cues.get("warnings", []))) if isinstance(cues, dict) else []
    if not run.is_metric and not any("not metric" in text for text in warnings):
        yield "Depth is not metric: all lengths are up to one unknown scale, also where a number looks like meters."
    # That lengths have no unit concerns every number below it.
    yield from sorted(warnings, key=lambda text: "not metric" not in text)
    yield from map(_sentence, run.summary.get("warnings", []))


def _sentence(text: Any) -> str:
    words = str(text).strip()
    return words[:1].upper() + words[1:] + ("" if words.endswith((".", "!", "?")) else ".")


def _solvers(summary: dict[str, Any]) -> Iterator[str]:
    for name, stage in summary.get("stages", {}).items():
        solves = stage.get("solves", [])
        # A probe takes a few steps and is not meant to converge.
        solves = [s for s in solves if not str(s.get("name", "")).endswith("probe]")]
        stopped = [s for s in solves if not str(s.get("termination", "")).startswith(("converged", "nothing"))]
        if not stopped:
            continue
        title = name.replace("_", " ")
        if len(solves) > 8:
            yield f"Stage {title}: {len(stopped)} of {len(solves)} solves ended before they converged."
            continue
        for solve in stopped:
            decrease = _last_decrease(solve)
            if decrease is not None and decrease < _UNFINISHED_DECREASE:
                continue
            tail = "" if decrease is None else f"; its last step still lowered the energy by {100 * decrease:.2g} %"
            yield (
                f"Stage {title}: the solve “{solve.get('name')}” ended after {solve.get('num_iterations')} steps "
                f"before it converged ({solve.get('termination')}){tail}."
            )


def _last_decrease(solve: dict[str, Any]) -> float | None:
    """Return by which part the last step lowered the energy, if the run recorded it."""
    curve = solve.get("energy_curve") or []
    if len(curve) < 2 or not curve[-2][1]:
        return None
    steps = max(curve[-1][0] - curve[-2][0], 1)
    return float((curve[-2][1] - curve[-1][1]) / curve[-2][1] / steps)


def _geometry(run: Run) -> Iterator[str]:
    reconstruction = run.reconstruction
    spread = float(np.std(reconstruction.depth_log_scale))
    if spread > _LARGE_SCALE_SPREAD:
        yield (
            f"The depth cue changes its scale from frame to frame (standard deviation {100 * spread:.0f} %); "
            "the overall scale is no better than its mean."
        )
    if not len(reconstruction.landmarks):
        yield "There is no static landmark: nothing but the input supports the cameras."
    covariance = reconstruction.intrinsics_covariance
    if covariance is not None:
        relative = np.sqrt(np.diagonal(covariance)[:2]) / reconstruction.intrinsics[:2]
        if not np.isfinite(relative).all():
            yield "The data do not determine the focal length."
        elif relative.max() > _LARGE_FOCAL_SIGMA:
            yield f"The focal length is uncertain by {100 * relative.max():.0f} % (standard deviation)."
    sigmas = pose_sigmas(reconstruction)
    if sigmas is None:
        return
    position = sigmas[0]
    unknown = np.flatnonzero(~np.isfinite(position)).tolist()
    if unknown:
        yield f"The data do not determine the camera in {_frames_text(unknown)}."
    depth = scene_depth(reconstruction)
    large = np.flatnonzero(np.nan_to_num(position) > _LARGE_POSITION_SIGMA * depth).tolist()
    if large:
        yield (
            f"The camera's position is uncertain by more than {100 * _LARGE_POSITION_SIGMA:.0f} % of the scene's depth "
            f"in {_frames_text(large)}."
        )


def _frames(run: Run, residuals: Residuals) -> Iterator[str]:
    count = np.bincount(residuals.frame[~residuals.is_dynamic], minlength=run.num_frames)
    few = np.flatnonzero(count < _MIN_STATIC_PER_FRAME).tolist()
    if few:
        yield f"Fewer than {_MIN_STATIC_PER_FRAME} static points support the camera in {_frames_text(few)}."
    median = residuals.per_frame(run.num_frames, 0.5, dynamic=False)
    if np.isfinite(median).any():
        bad = np.flatnonzero(np.nan_to_num(median) > _OUTLYING_FRAME * float(np.nanmedian(median))).tolist()
        if bad:
            yield f"The residuals are more than {_OUTLYING_FRAME:.0f} times the usual ones in {_frames_text(bad)}."


def _dropped(run: Run) -> Iterator[str]:
    tracks = run.summary.get("stages", {}).get("tracks", {}).get("tracks", {})
    rejected, total = tracks.get("rejected", 0), sum(tracks.values())
    if total and rejected > 0.5 * total:
        yield f"{rejected} of {total} tracks were rejected: they mix static and moving, or were never surely seen."
    dropped = run.summary.get("stages", {}).get("bundle_adjustment", {}).get("dropped", {})
    bad = sum(n for reason, n in dropped.items() if reason.startswith("landmark"))
    kept = len(run.reconstruction.landmarks)
    if bad > _LARGE_DROPPED_SHARE * (kept + bad):
        share = 100 * bad / (kept + bad)
        yield (
            f"{share:.0f} % of the static landmarks contradict the rest and were dropped: depth, masks or tracks are "
            "wrong in a part of the picture."
        )


def _frames_text(frames: list[int]) -> str:
    """Return 'frame 3' or 'frames 3–7, 12' with runs of frames joined."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    shown = [str(a) if a == b else f"{a}–{b}" for a, b in runs[:8]]
    rest = f" and {len(runs) - 8} more stretches" if len(runs) > 8 else ""
    return ("frame " if len(frames) == 1 else "frames ") + ", ".join(shown) + rest
