"""The demo: a synthetic scene, its reconstruction, and how accurate that is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.runs import DEMO_SEQUENCE, SequenceInput
from uni4d_fg.cli.scenes import SCENE_FILE, reuse_or_write_scene
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline import RunSummary
from uni4d_fg.results.evaluate.points import PointMetrics
from uni4d_fg.results.evaluate.run import EvaluationReport
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_contents import COMMAND_LINE, is_free, is_run, remove_results, run_lock
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

DEMO_SCENE = SyntheticSceneConfig(num_frames=24, width=320, height=240)
FAST_SCENE = SyntheticSceneConfig(num_frames=12, width=200, height=150, focal=188.0, grid_columns=24, grid_rows=18)


@contextmanager
def demo_folder(folder: Path, *, resume: bool) -> Iterator[None]:
    """Make sure that the demo, and it alone, may be written to ``folder``; results of an earlier demo are removed.

    Raises:
        OutputError: If the folder holds anything but an earlier demo, or another process writes there.
    """
    prepare_demo_folder(folder)
    with run_lock(folder, COMMAND_LINE):
        if not resume:
            remove_results(folder)
        yield


def prepare_demo_folder(folder: Path) -> None:
    """Make sure that the demo may be written to ``folder``.

    Raises:
        OutputError: If the folder holds anything but an earlier demo.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; choose another --out")
    if is_free(folder):
        return
    if not (folder / DEMO_SEQUENCE / SCENE_FILE).is_file():
        what = "a run that is not the demo" if is_run(folder) else "something else"
        raise OutputError(f"{folder}: holds {what}; choose another --out")


def demo_input(folder: Path, *, fast: bool, quiet: bool) -> SequenceInput:
    """Make the demo's scene, unless it is there already, and return it as the input of a run.

    Raises:
        OutputError: If it cannot be written.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    root = folder / DEMO_SEQUENCE
    with progress_reporter(quiet) as reporter:
        reporter.begin("synthetic scene", None)
        reused = reuse_or_write_scene(FAST_SCENE if fast else DEMO_SCENE, root)
        reporter.end("the one of an earlier demo" if reused else "")
    return SequenceInput(str(root.resolve()), "native")


def demo_lines(folder: Path, sequence: Sequence, summary: RunSummary, report: EvaluationReport) -> list[str]:
    """Return what the demo prints: the run, its accuracy, its files and the next commands."""
    focal = focal_lengths(load_reconstruction(RunFolder(folder).reconstruction), sequence)
    accuracy = [f"    {line}" for line in accuracy_lines(report, *focal)]
    return [*summary.lines(), "", "accuracy against the exact truth", *accuracy, "", *result_lines(folder)]


def accuracy_lines(report: EvaluationReport, focal: float, focal_cue: float, focal_true: float) -> list[str]:
    """Return the accuracy of a demo run in a few lines."""
    lines: list[str] = []
    path = report.trajectory
    if path is not None:
        length = path.path_length_reference_m
        share = f", {100 * path.ate_m / length:.2f} % of the path of {length:.2f} m" if length else ""
        lines.append(f"camera path       ATE {_millimeters(path.ate_m)}{share}")
        rotation = "-" if path.rpe_rotation_deg is None else f"{path.rpe_rotation_deg:.3f} deg"
        lines.append(f"                  RPE {_millimeters(path.rpe_translation_m)} and {rotation} per frame")
        lines.append(f"scale             {_error(path.scale, 1.0)} off")
    lines.append(
        f"focal length      {_error(focal_cue, focal_true)} off at the start, {_error(focal, focal_true)} at the end"
    )
    moving = _observed(report.dynamic_points)
    if moving is not None:
        errors = f"RMSE {_millimeters(moving.rmse_m)}, median {_millimeters(moving.median_m)}"
        lines.append(f"dynamic points    {errors}, over {moving.points} observed points")
    if report.depth is not None and report.depth_cue is not None:
        cue, fused = (r.metrics["metric"].regions["all"].abs_rel for r in (report.depth_cue, report.depth))
        lines.append(f"dense depth       AbsRel {_number(cue, '.4f')} of the cue, {_number(fused, '.4f')} after fusion")
    return lines


def result_lines(folder: Path) -> list[str]:
    """Say where results lie and what to type next."""
    run = RunFolder(folder)
    named = (
        (run.trajectory, "camera poses (TUM)"),
        (run.reconstruction, "cameras, static points, 3D motion (NumPy)"),
        (run.depth, "fused depth (NumPy)"),
        (run.static_cloud, "static cloud; one cloud of the movers per frame in clouds/dynamic"),
        (run.scene_picture, "rendered views"),
    )
    lines = ["results"]
    width = max(len(str(path)) for path, _ in named)
    lines += [f"    {path!s:<{width}}  {text}" for path, text in named if path.exists()]
    lines += ["next", f"    uni4d-fg evaluate {folder}", "    uni4d-fg validate YOUR_SEQUENCE"]
    return lines


def focal_lengths(reconstruction: Reconstruction, sequence: Sequence) -> tuple[float, float, float]:
    """Return the focal length (mean of fx and fy) of the result, of the cue and of the truth, px."""
    truth = sequence.ground_truth.intrinsics
    known = (reconstruction.intrinsics, sequence.intrinsics, sequence.intrinsics if truth is None else truth)
    result, cue, true = (float(intrinsics[:2].mean()) for intrinsics in known)
    return result, cue, true


def _observed(metrics: tuple[PointMetrics, ...] | None) -> PointMetrics | None:
    """Return the score of observed points under the alignment that the camera path is scored with."""
    chosen = [m for m in metrics or () if m.protocol.startswith("observed") and "Sim(3)" in m.protocol]
    return chosen[0] if chosen and chosen[0].points else None


def _error(value: float, truth: float) -> str:
    return f"{100 * abs(value / truth - 1):.2f} %"


def _millimeters(value: float | None) -> str:
    return "-" if value is None else f"{1000 * value:.2f} mm"


def _number(value: float | None, digits: str) -> str:
    return "-" if value is None else format(value, digits)
