"""The tables of an experiment: averages over videos and every video, per kind of score and protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uni4d_fg.pipeline.benchmark.published import Published
from uni4d_fg.pipeline.benchmark.table import Column, Kind, Row, Table
from uni4d_fg.pipeline.benchmark.task import TaskResult
from uni4d_fg.results.evaluate.protocols.depth import DEPTH_PROTOCOLS, DepthScore, average_depth
from uni4d_fg.results.evaluate.protocols.pose import POSE_PROTOCOLS

POSES = {"ATE": "ate", "RPE trans": "rpe_translation", "RPE rot": "rpe_rotation_deg"}
POSED = (Column("posed", 0, ""), Column("of frames", 0, ""))
"""Frames with an estimated pose, and frames with a true one."""
REGIONS = ("all", "static", "moving")
DEPTH_CUE = "depth cue"
"""Row of the depth that runs start from."""


@dataclass(frozen=True)
class Method:
    """All results of one row of the tables."""

    name: str
    results: Mapping[str, TaskResult]
    """By video, in the order of the split; a video that is not there was not tried."""
    kind: Kind = "run"
    source: str = ""

    @property
    def failed(self) -> int:
        """Number of videos without a result."""
        return sum(result.failed is not None for result in self.results.values())


def all_tables(
    dataset: str, title: str, methods: list[Method], pose_protocols: tuple[str, ...],
    depth_protocols: tuple[str, ...], published: list[Published],
) -> list[Table]:  # fmt: skip
    """Return every table that has a row.

    Args:
        dataset: Its name.
        title: Its name in tables.
        methods: Rows.
        pose_protocols: Names.
        depth_protocols: Names.
        published: Numbers of papers, of any dataset and protocol.
    """
    tables: list[Table] = []
    for name in pose_protocols:
        told = [p.row(dataset) for p in published if p.fits(dataset, name)]
        tables += [pose_table(title, name, methods, told), pose_videos(title, name, methods)]
        tables += [stages_table(title, name, methods)]
    for name in depth_protocols:
        told = [p.row(dataset) for p in published if p.fits(dataset, name)]
        with_cue = [*methods, *_cues(methods)]
        tables += [depth_table(title, name, with_cue, told), depth_videos(title, name, with_cue)]
    told = [p.row(dataset) for p in published if p.fits(dataset, "consistency")]
    tables += [consistency_table(title, [*methods, *_cues(methods)], told), points_table(title, methods)]
    tables += [tracks_table(title, methods)]
    tables += [runtime_table(title, methods)]
    return [table for table in tables if _says_something(table)]


def _says_something(table: Table) -> bool:
    """Tell whether any row that is not printed has more than counts."""
    counts = {column.name for column in _COUNTS}
    rows = (row for row in table.rows if row.kind != "published")
    return any(value is not None for row in rows for name, value in row.values.items() if name not in counts)


def pose_table(title: str, protocol: str, methods: list[Method], published: list[Row]) -> Table:
    """Return ATE and relative errors, averaged over the videos that have them, and how many frames have a pose."""

    def value(result: TaskResult, key: str) -> float | None:
        return _pose(result, protocol, key)

    rows = [_with_posed(_averaged(method, value, POSES), method) for method in methods]
    columns = [Column("ATE"), Column("RPE trans"), Column("RPE rot"), *POSED, *_COUNTS]
    notes = [POSE_PROTOCOLS[protocol].text, "ATE and RPE trans in m, RPE rot in degrees; mean over videos"]
    notes.append("errors are those of the frames that a method poses, of all with a true pose; frames of all videos")
    return Table(
        f"poses-{protocol}", f"{title}: camera poses, `{protocol}`", "method", columns, [*published, *rows],
        [*notes, _FAILED],
    )  # fmt: skip


def pose_videos(title: str, protocol: str, methods: list[Method]) -> Table:
    """Return the ATE of every video; beside methods that leave frames without a pose, how many have one."""
    table = _per_video(
        f"poses-{protocol}-videos", f"{title}: ATE of every video, m, `{protocol}`", methods,
        lambda result: _pose(result, protocol, "ate"), Column("", 4), [POSE_PROTOCOLS[protocol].text],
    )  # fmt: skip
    partial = [method for method in methods if is_partial(_with_posed(Row(method.name, {}), method))]
    if not partial:
        return table
    for row in table.rows:
        for method in partial:
            told = method.results[row.name].scores.get("posed") if row.name in method.results else None
            if told is not None:
                row.values.update({f"{method.name}, posed": told["posed"], "of frames": told["frames"]})
    columns = [*table.columns, *(Column(f"{method.name}, posed", 0, "") for method in partial), POSED[1]]
    return replace(table, columns=columns)


def stages_table(title: str, protocol: str, methods: list[Method]) -> Table:
    """Return the errors of the cameras after each stage of every run."""

    def value(result: TaskResult, key: str) -> float | None:
        return _pose(result, protocol, key)

    rows = []
    for method in methods:
        stages = dict.fromkeys(stage for r in method.results.values() for stage in r.scores.get("stages", {}))
        for stage in stages:
            parts = {
                video: replace(r, scores=r.scores.get("stages", {}).get(stage, {}))
                for video, r in method.results.items()
            }
            rows.append(_averaged(Method(f"{method.name}, after {stage.replace('_', ' ')}", parts), value, POSES))
    columns = [Column("ATE"), Column("RPE trans"), Column("RPE rot"), *_COUNTS]
    return Table(
        f"stages-{protocol}", f"{title}: camera poses after each stage, `{protocol}`", "method", columns, rows,
        [POSE_PROTOCOLS[protocol].text, _FAILED],
    )  # fmt: skip


def depth_table(title: str, protocol: str, methods: list[Method], published: list[Row]) -> Table:
    """Return AbsRel and delta < 1.25 by region, averaged as the protocol says."""
    rows = []
    for method in methods:
        values: dict[str, float | int | None] = {}
        for region in REGIONS:
            scores = [s for r in method.results.values() if (s := _depth(r, protocol, region)) is not None]
            absolute, inliers = average_depth(DEPTH_PROTOCOLS[protocol], scores)
            values |= {_named("AbsRel", region): absolute, _named("δ<1.25", region): inliers}
        scored = sum(_depth(r, protocol, "all") is not None for r in method.results.values())
        rows.append(Row(method.name, values | {"videos": scored, "failed": method.failed}, method.kind, method.source))
    used = [region for region in REGIONS if any(row.values.get(_named("AbsRel", region)) is not None for row in rows)]
    columns = [c for region in used for c in (Column(_named("AbsRel", region)), _inliers(region))]
    whose = {r.scores.get("regions") for m in methods for r in m.results.values()} - {None}
    notes = [next((t for m in methods for r in m.results.values() if (t := _text_of(r, protocol))), "")]
    notes += [f"static and moving by {' or '.join(sorted(map(str, whose)))}"] if whose else []
    notes.append(f"mean over {'videos' if DEPTH_PROTOCOLS[protocol].over_videos else 'pixels of all videos'}")
    return Table(
        f"depth-{protocol}", f"{title}: video depth, `{protocol}`", "method", [*columns, *_COUNTS],
        [*published, *rows], [*(note for note in notes if note), _FAILED],
    )  # fmt: skip


def depth_videos(title: str, protocol: str, methods: list[Method]) -> Table:
    """Return the AbsRel of every video."""
    return _per_video(
        f"depth-{protocol}-videos", f"{title}: AbsRel of every video, `{protocol}`", methods,
        lambda result: score.abs_rel if (score := _depth(result, protocol, "all")) is not None else None,
        Column("", 4), [],
    )  # fmt: skip


def consistency_table(title: str, methods: list[Method], published: list[Row]) -> Table:
    """Return self-consistency with the masks of the runs; no truth is needed."""
    keys = {"SC": "mean", "SC<0.01": "below_1", "SC<0.05": "below_5"}
    rows = [_averaged(m, lambda r, key: _of(r.scores.get("consistency"), key), keys) for m in methods]
    told = [found for m in methods for r in m.results.values() if (found := r.scores.get("consistency"))]
    whose = " or ".join(sorted({str(found["masks"]) for found in told}))
    notes = [f"{told[0]['protocol']}; static pixels: {whose}"] if told else []
    columns = [Column("SC"), Column("SC<0.01", better="high"), Column("SC<0.05", better="high"), *_COUNTS]
    return Table(
        "consistency", f"{title}: self-consistency of depth", "method", columns, [*published, *rows], [*notes, _FAILED]
    )


def tracks_table(title: str, methods: list[Method]) -> Table:
    """Return the scores of TAPVid-3D."""
    keys = {"3D-AJ": "average_jaccard", "APD": "points_within", "OA": "occlusion_accuracy"}
    rows = [_averaged(m, lambda r, key: _of(r.scores.get("tracks"), key), keys) for m in methods]
    columns = [*(Column(name, better="high") for name in keys), *_COUNTS]
    note = "TAPVid-3D, scaled by the median distance; visibility of the truth is that of the given tracks"
    return Table("tracks", f"{title}: tracking in 3D", "method", columns, rows, [note, _FAILED])


def points_table(title: str, methods: list[Method]) -> Table:
    """Return the errors of points that are static and that move, in mm: medians and RMSE, averaged over videos."""

    def value(result: TaskResult, key: str) -> float | None:
        region, measure = key.split(".")
        found = _of(result.scores.get("points", {}).get(region), measure)
        return None if found is None else 1000.0 * float(found)

    keys = {
        f"{region} {name}": f"{region}.{measure}"
        for region in ("static", "moving")
        for name, measure in (("median", "median_m"), ("RMSE", "rmse_m"))
    }
    rows = [_averaged(m, value, keys) for m in methods]
    note = "mm, where a point is seen, in the true world: aligned by Sim(3) Umeyama of the cameras; mean over videos"
    return Table(
        "points", f"{title}: errors of points", "method", [*(Column(name, 1) for name in keys), *_COUNTS], rows,
        [note, _FAILED],
    )  # fmt: skip


def runtime_table(title: str, methods: list[Method]) -> Table:
    """Return the mean seconds per stage and the largest memory."""
    stages = list(dict.fromkeys(s for m in methods for r in m.results.values() for s in r.seconds))
    rows = []
    for method in methods:
        done = [r for r in method.results.values() if r.failed is None and r.seconds]
        values: dict[str, float | int | None] = {
            stage: float(np.mean([r.seconds.get(stage, 0.0) for r in done])) if done else None for stage in stages
        }
        values["all"] = float(np.mean([sum(r.seconds.values()) for r in done])) if done else None
        values["frames"] = float(np.mean([r.frames for r in done])) if done else None
        values["peak MB"] = max((r.peak_memory_mb for r in done if r.peak_memory_mb), default=None)
        rows.append(Row(method.name, values | {"videos": len(done), "failed": method.failed}, method.kind))
    columns = [*(Column(stage, 2) for stage in stages), Column("all", 2), Column("frames", 1, ""), Column("peak MB", 0)]
    note = "wall time, s, mean over videos; what was taken over from an earlier run counts with the time of reading it"
    return Table("runtime", f"{title}: runtime", "method", [*columns, *_COUNTS], rows, [note])


def is_partial(row: Row) -> bool:
    """Tell whether a row of the table of poses leaves some frames without one."""
    posed, frames = (row.values.get(column.name) for column in POSED)
    return posed is not None and frames is not None and posed < frames


_COUNTS = (Column("videos", 0, ""), Column("failed", 0, ""))
_FAILED = "videos that failed are counted, and not in the means"


def _averaged(method: Method, value: Callable[[TaskResult, str], float | None], keys: Mapping[str, str]) -> Row:
    values: dict[str, float | int | None] = {}
    scored = 0
    for name, key in keys.items():
        found = [v for r in method.results.values() if (v := value(r, key)) is not None]
        values[name] = float(np.mean(found)) if found else None
        scored = max(scored, len(found))
    return Row(method.name, values | {"videos": scored, "failed": method.failed}, method.kind, method.source)


def _with_posed(row: Row, method: Method) -> Row:
    """Return a row with the number of frames that have a pose, and of those with a true one, of all videos."""
    told = [found for r in method.results.values() if (found := r.scores.get("posed"))]
    counts = {"posed": sum(t["posed"] for t in told), "of frames": sum(t["frames"] for t in told)}
    return replace(row, values=row.values | (counts if told else {}))


def _per_video(
    name: str, title: str, methods: list[Method], value: Callable[[TaskResult], float | None], column: Column,
    notes: list[str],
) -> Table:  # fmt: skip
    videos = list(dict.fromkeys(video for method in methods for video in method.results))
    rows = [Row(video, {m.name: value(m.results[video]) for m in methods if video in m.results}) for video in videos]
    columns = [Column(m.name, column.digits, column.better) for m in methods]
    return Table(name, title, "video", columns, rows, notes)


def _cues(methods: list[Method]) -> list[Method]:
    """Return the depth that the first run starts from as a method of its own."""
    for method in methods:
        if any(r.scores.get("depth_cue") for r in method.results.values()):
            results = {
                video: replace(r, method=DEPTH_CUE, scores=r.scores.get("depth_cue", {}), seconds={})
                for video, r in method.results.items()
            }
            return [Method(DEPTH_CUE, results)]
    return []


def _pose(result: TaskResult, protocol: str, key: str) -> float | None:
    return _of(result.scores.get("poses", {}).get(protocol), key)


def _depth(result: TaskResult, protocol: str, region: str) -> DepthScore | None:
    found = result.scores.get("depth", {}).get(protocol, {}).get("regions", {}).get(region)
    return None if found is None or found["abs_rel"] is None else DepthScore(**found)


def _text_of(result: TaskResult, protocol: str) -> str:
    return str(result.scores.get("depth", {}).get(protocol, {}).get("text", ""))


def _of(scores: dict[str, Any] | None, key: str) -> float | None:
    value = None if scores is None else scores.get(key)
    return None if value is None else float(value)


def _named(score: str, region: str) -> str:
    return score if region == "all" else f"{score} {region}"


def _inliers(region: str) -> Column:
    return Column(_named("δ<1.25", region), better="high")
