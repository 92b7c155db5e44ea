"""From a video or a sequence to a result in one call, as the command line does it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from uni4d_fg.config.load import opened_config
from uni4d_fg.config.models import Config
from uni4d_fg.cues.depth_settings import settings_for_depth
from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.plan import CuePlan, plan_cues
from uni4d_fg.frontend.measurements.imu import ImuSamples, read_imu
from uni4d_fg.frontend.sequence import model
from uni4d_fg.frontend.sequence.assemble import as_sequence
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.shots.cuts import find_cuts
from uni4d_fg.optim.added_factors import FactorSource, checked_sources
from uni4d_fg.pipeline.asked import check_asked
from uni4d_fg.pipeline.checks import check_sequence
from uni4d_fg.pipeline.measurements import MeasurementFiles, read_measurements
from uni4d_fg.pipeline.run import reconstruct as reconstruct_sequence
from uni4d_fg.pipeline.usable_cues import check_given_cues
from uni4d_fg.pipeline.workers.options import WorkerOptions
from uni4d_fg.progress import Reporter
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.run_contents import PYTHON, claim_folder, run_lock
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.results.shot_list import check_same_split
from uni4d_fg.slam.reconstruction import Reconstruction

_CUTS = (
    "there are cuts at frame {frames}: the video was solved as one shot nevertheless; `uni4d-fg reconstruct` makes "
    "each shot a run of its own"
)


def reconstruct(
    source: str | Path | model.Sequence,
    run: str | Path,
    config: Config | str | Path | None = None,
    changes: Sequence[str] = (),
    *,
    additions: Iterable[FactorSource] = (),
    imu: ImuSamples | str | Path | None = None,
    measurements: MeasurementFiles | None = None,
    resume: bool = False,
    overwrite: bool = False,
    reporter: Reporter | None = None,
    workers: WorkerOptions | None = None,
) -> Reconstruction:
    """Reconstruct a video and write the run folder; cues that it does not bring are made.

    The video is one shot; where cuts are found in it, the summary warns of them.

    Args:
        source: Video file, folder of images, sequence folder, or an opened sequence with all its cues.
        run: Folder of the run, made if absent.
        config: A configuration, the name of a preset, or a YAML file; the default preset when None.
        changes: ``section.field=VALUE``, as ``--set`` of the command line; not with an opened configuration.
        additions: Factors and variables of your own for any stage, see :mod:`uni4d_fg.optim.added_factors`.
        imu: Accelerometer and gyroscope on the clock of the frames: samples, a CSV file as EuRoC has it, or a folder
            with ``imu.csv`` and ``imu.yaml``.
        measurements: Files of odometry, GPS and relative poses, see ``docs/measurements.md``.
        resume: Take over stages of the folder whose input and configuration are the same.
        overwrite: Replace an earlier run in the folder. Files that are not of the run stay.
        reporter: Progress.
        workers: Processes that solve the windows of a long video (``windows.frames``), see ``docs/cluster.md``.

    Returns:
        Cameras, static points and trajectories; depth and clouds are in the folder.

    Raises:
        OutputError: If the folder holds anything but a run, or a run and neither ``resume`` nor ``overwrite`` is given.
        Uni4dFgError: If the input cannot be read, the cues do not determine the cameras, or a file cannot be written;
            the message says what, where and what to do.
    """
    folder = Path(run)
    settings = opened_config(config, changes)
    sources = checked_sources(additions)
    samples = read_imu(Path(imu)) if isinstance(imu, str | Path) else imu
    files = measurements or MeasurementFiles()
    # What is wrong is said before anything is made, or an earlier run is replaced.
    video: model.Video | model.Sequence
    if isinstance(source, model.Sequence):
        check_sequence(source)
        video, plan = source, CuePlan()
    else:
        path = Path(source)
        video = open_video(path)
        plan = plan_cues(video, bare=path.is_file() or video.depths is None)
        plan.check()
    check_asked(video, settings, samples, workers)
    check_given_cues(video, settings.input, plan)
    read_measurements(files, video.timestamps, settings.measurements)
    report, warnings = None, []
    with run_lock(folder):
        claim_folder(folder, resume=resume, overwrite=overwrite, remedies=PYTHON)
        check_same_split(folder, False, resume=resume, remedies=PYTHON)
        if isinstance(video, model.Sequence):
            sequence = video
        else:
            if settings.shots.split == "auto" and samples is None and measurements is None:
                frames = ", ".join(str(cut.frame) for cut in find_cuts(video.images, settings.shots))
                warnings = [_CUTS.format(frames=frames)] if frames else []
            if plan.is_given:
                sequence = as_sequence(replace(video, masks=None) if plan.masks == "none" else video)
            else:
                sequence, report = gather_cues(
                    video, plan, folder / "cues", settings, reporter=reporter, track_cache=folder / "stages"
                )
        cues = None if report is None else report.to_dict()
        reconstruct_sequence(
            sequence, folder, settings_for_depth(settings, sequence), resume=resume, reporter=reporter, cues=cues,
            additions=sources, measurements=files, imu=samples, warnings=warnings, workers=workers,
        )  # fmt: skip
    return load_reconstruction(RunFolder(folder).reconstruction)
