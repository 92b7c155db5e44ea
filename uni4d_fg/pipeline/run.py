"""Run the stages in order, keep each as it ends, and write the run folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any, TypeVar

import numpy as np

from uni4d_fg.allocation import LARGE, return_free_memory
from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.load import dump_config
from uni4d_fg.config.models import Config
from uni4d_fg.counted import counted
from uni4d_fg.cues.depth_settings import settings_of_judgment
from uni4d_fg.cues.mask_repair import RepairedMasks, repair_masks, repair_warnings
from uni4d_fg.cues.plan import CueReport
from uni4d_fg.cues.scale_notes import NOT_METRIC_GIVEN
from uni4d_fg.errors import InputError
from uni4d_fg.files import atomic_write_json, atomic_write_text
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.frontend.sequence.bars import bars_note, without_bars
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.naming import order_warnings
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.frontend.tracks.cache import load_or_track
from uni4d_fg.frontend.tracks.io import save_tracks
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.optim.added_factors import FactorSource, checked_sources, fingerprints, with_additions
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.runners import solver_facts, solver_settings, stage_runner
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.optim.stage_graph import RecordingRunner
from uni4d_fg.optim.threads import one_blas_thread, thread_limit
from uni4d_fg.pipeline.asked import check_asked
from uni4d_fg.pipeline.assemble import assemble, write_result, write_views
from uni4d_fg.pipeline.checks import check_sequence
from uni4d_fg.pipeline.control import BegunControl, static_control
from uni4d_fg.pipeline.fingerprint import sequence_digest, stage_key
from uni4d_fg.pipeline.first_cameras import StageInputs, first_cameras
from uni4d_fg.pipeline.fuse import fuse_depth
from uni4d_fg.pipeline.graphs import KEPT, GraphValues
from uni4d_fg.pipeline.in_progress import RunInProgress
from uni4d_fg.pipeline.inertial import metric_cues
from uni4d_fg.pipeline.joint import NOT_IN_WINDOWS, WITHOUT_IMU, joint_step
from uni4d_fg.pipeline.leftovers import remove_leftovers
from uni4d_fg.pipeline.lens import found_camera, goes_along, is_sought, known_camera, lens_step
from uni4d_fg.pipeline.loops import loop_closing, with_loops
from uni4d_fg.pipeline.measurements import MeasurementFiles, Measurements, read_measurements
from uni4d_fg.pipeline.repeats import Repeats
from uni4d_fg.pipeline.shutter import readout_step
from uni4d_fg.pipeline.steps import Arrays, bundle_adjustment_step, nonrigid_step
from uni4d_fg.pipeline.store import StageRecord, StageStore
from uni4d_fg.pipeline.summary import RunSummary
from uni4d_fg.pipeline.usable_cues import check_given_cues
from uni4d_fg.pipeline.warnings import blur_warnings, found_focal_warnings, intrinsics_warnings
from uni4d_fg.pipeline.window_workers import NOT_ON_WORKERS, window_workers
from uni4d_fg.pipeline.windowed import WindowedRun, motion_step, scene_step
from uni4d_fg.pipeline.workers.options import WorkerOptions
from uni4d_fg.pipeline.written_beside import WrittenBeside
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.results import pictures
from uni4d_fg.results.confidence_store import read_confidence
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.labels_io import load_labels, save_labels
from uni4d_fg.results.run_contents import mark_run, run_lock
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.association.fragments import FragmentSearch
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.rolling_shutter import Readout, at_one_time, readout_of_array
from uni4d_fg.slam.loops.closing import LoopClosing
from uni4d_fg.slam.reconstruction import zoomed
from uni4d_fg.slam.windows.plan import Window, windows_of

ValueT = TypeVar("ValueT")


def reconstruct(
    sequence: Sequence,
    run_dir: Path,
    config: Config,
    *,
    resume: bool = False,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
    cues: dict[str, Any] | None = None,
    additions: Iterable[FactorSource] = (),
    measurements: MeasurementFiles | None = None,
    imu: ImuSamples | None = None,
    warnings: Iterable[str] = (),
    workers: WorkerOptions | None = None,
) -> RunSummary:
    """Reconstruct a sequence and write the run folder.

    Args:
        sequence: Frames and cues.
        run_dir: Folder of the run; made if absent.
        config: Everything else the result depends on.
        resume: Take over stages stored in ``run_dir`` whose inputs and configuration have not changed.
        reporter: Progress.
        should_stop: Polled often; True ends the run with :class:`Cancelled`, finished stages kept.
        cues: What was made of the cues, for the summary: ``sources``, ``facts``, ``warnings``, ``metric``.
        additions: Factors and variables of your own for any stage, see :mod:`uni4d_fg.optim.added_factors`. Of
            them ``resume`` compares the fingerprints that they may have, see
            :data:`~uni4d_fg.optim.added_factors.FactorSource`.
        measurements: Files of odometry, GPS and relative poses that join bundle adjustment; ``resume`` compares them.
        imu: Inertial measurements over all frames, on their clock, for stage 2.
        warnings: What else the summary should warn of.
        workers: Processes that solve the windows of a long video; with ``workers=1`` it is this one, with the same
            result to the last bit.

    Returns:
        The summary that is also written as ``summary.json``.

    Raises:
        InputError: If a cue cannot be read, the parts of the sequence contradict each other, or the IMU does not cover
            the frames.
        ConfigError: If the configuration leaves no place for an IMU, or has no windows for workers.
        DegenerateProblemError: If the cues do not determine the cameras, or the IMU not the scale.
        SolverError: If a stage cannot be solved.
        OutputError: If a result cannot be written.
        MissingDependencyError: If the solver needs a package that is not installed.
        Cancelled: If ``should_stop`` turned true.
    """
    check_sequence(sequence)
    check_asked(sequence, config, imu, workers)
    check_given_cues(sequence, config.input)
    own = checked_sources(additions)
    recorder = RecordingRunner(stage_runner(config), KEPT)
    # Threads of BLAS wait for each other in busy loops: on a busy machine small matrices take a thousand times as long.
    # What is worth several threads divides its work itself.
    with one_blas_thread(), run_lock(run_dir):
        mark_run(run_dir)
        return _reconstruct(
            recorder, sequence, run_dir, config, resume, reporter or SilentReporter(), should_stop or (lambda: False),
            cues or {}, own, measurements or MeasurementFiles(), imu, warnings, workers,
        )  # fmt: skip


def _reconstruct(
    recorder: RecordingRunner, sequence: Sequence, run_dir: Path, config: Config, resume: bool, reporter: Reporter,
    should_stop: Callable[[], bool], cues: dict[str, Any], additions: Iterable[FactorSource],
    measurements: MeasurementFiles, imu: ImuSamples | None, warnings: Iterable[str],
    workers: WorkerOptions | None,
) -> RunSummary:  # fmt: skip
    measured = read_measurements(measurements, sequence.timestamps, config.measurements)
    sources = (*additions, *measured.sources)
    run_stage = with_additions(recorder, sources)
    windows = windows_of(config, sequence.num_frames)
    if not sequence.depth_is_metric and not cues:
        given = {"depth": "given, in a unit of its own"}
        cues = CueReport(given, warnings=[NOT_METRIC_GIVEN], metric=False).to_dict()
    if imu is not None:
        cues = metric_cues(cues) if cues else cues
    folder = RunFolder(run_dir)
    height, width = sequence.image_size
    summary = RunSummary(
        {
            "name": sequence.name,
            "root": None if sequence.root is None else str(sequence.root.resolve()),
            "num_frames": sequence.num_frames,
            "image_size": [height, width],
        },
        solver_facts(config),
        cues=cues,
        warnings=[
            *order_warnings(sequence.frame_names),
            *intrinsics_warnings(sequence),
            *cues.get("warnings", []),
            *measured.warnings,
            *warnings,
        ],
    )
    on = None
    if windows and not sources:
        on = window_workers(workers, windows, sequence.image_size, run_dir / "stages", config, recorder, should_stop)
    with WrittenBeside() as written, on or nullcontext():
        run = RunInProgress(
            sequence, config, folder, StageStore(run_dir / "stages"), resume,
            reporter, should_stop, summary, recorder, written, sources, imu, workers, on,
        )  # fmt: skip
        if on is not None and not resume:
            on.start()
        return _solve(run, windows, measured, run_stage)


def _solve(run: RunInProgress, windows: list[Window], measured: Measurements, run_stage: StageRunner) -> RunSummary:
    """Do all steps of a run that has been prepared."""
    sequence, config, folder, summary = run.sequence, run.config, run.folder, run.summary
    if config.output.pictures:
        Thread(target=pictures.load).start()
    remove_leftovers(folder)
    atomic_write_text(folder.config, dump_config(config))
    key, images = sequence_digest(sequence, run.should_stop)
    sequence = run.sequence = without_bars(sequence, look=config.input.black_bars == "auto")
    if config.input.repair_masks:
        key = _repair_masks(run, key)
        sequence = run.sequence
    key, labelled = _labels(run, key, images)
    energy = (config.energy, config.normalization)
    key = stage_key(key, config.camera_init, config.input, *energy, *solver_settings(config))
    # What is added to stages, windows included, counts the frames of the video: none is left out there.
    alone = not (windows or run.sources or run.imu is not None)
    repeats = Repeats.of(sequence, labelled) if alone and config.input.repeated_frames == "auto" else None
    solved, solved_tracks = sequence, labelled
    if repeats is not None:
        solved, solved_tracks = repeats.sequence(sequence), repeats.labelled(labelled)
        summary.stages["tracks"]["facts"] = [*summary.stages["tracks"].get("facts", []), repeats.fact()]
        key = stage_key(key, repeats.solved.tolist())
    judging = settings_of_judgment(config, sequence, depth_is_needed=not alone)
    key, readout = readout_step(run, key, solved, solved_tracks, judging)
    key, camera, readout = _camera(run, key, solved, solved_tracks, judging, readout)
    still_tracks = at_one_time(solved_tracks, readout, solved.timestamps, solved.image_size)
    key, poses = stage_key(key, sequence.focal_sigma), None
    if windows:
        inputs = StageInputs.of(solved, still_tracks, camera, config, depth_is_needed=True)
    else:
        first = first_cameras(
            run, key, solved, still_tracks, camera, run_stage, is_sought=is_sought(solved, config),
            depth_is_needed=not alone,
        )  # fmt: skip
        camera, inputs, poses, key = first.camera, first.inputs, first.poses, first.key
    fragments = FragmentSearch.of(solved, solved_tracks, config.bundle_adjustment.rejoin)
    loops = loop_closing(solved, camera, config)
    if loops is not None:
        # Not a source of the user's: it adds nothing to single windows, which workers may then solve.
        run_stage = with_additions(run.recorder, (*run.sources, loops))
    zoom = camera.zoom if camera.zoom is None or repeats is None else camera.zoom[repeats.shown]
    static = BegunControl(
        lambda scene: static_control(
            labelled, scene, zoomed(scene["intrinsics"], zoom, sequence.num_frames), config.fusion
        )
    )
    key, scene, motion = _stages(run, key, inputs, poses, windows, run_stage, fragments, loops, static)
    found = zoomed(scene["intrinsics"], zoom, sequence.num_frames)[:, :2]
    summary.warnings += found_focal_warnings(sequence, found, config.geometric_depth.usual_focal)
    camera_facts: list[str] = []
    if goes_along(camera, sequence):
        camera = camera.with_intrinsics(scene["intrinsics"])
        camera_facts = camera.facts()
    if repeats is not None:
        scene, motion = repeats.expanded(scene), repeats.expanded(motion)
    adjusted = summary.stages["bundle_adjustment"]
    adjusted["facts"] = [*adjusted.get("facts", []), *camera_facts, *measured.facts]
    _fuse(run, stage_key(key, config.fusion), labelled, scene, motion, zoom, camera.lens, static)
    reconstruction = assemble(sequence, labelled, scene, motion, camera.lens, zoom)
    write_result(folder, reconstruction)
    began = time.perf_counter()
    run.reporter.begin("clouds and pictures", None)
    unit = "m" if summary.cues.get("metric", True) else "scale unknown"
    return_free_memory(LARGE)
    with ThreadPoolExecutor(1) as beside:
        # Clouds mostly wait for the disk.
        made = beside.submit(GraphValues.of, folder)
        write_views(folder, sequence, reconstruction, config, run.should_stop, unit=unit)
    graphs = made.result()
    graphs.write(folder)
    run.reporter.end()
    run.note("output", {"graphs": graphs.sizes}, time.perf_counter() - began, False)
    atomic_write_json(folder.summary, summary.to_dict())
    return summary


def _camera(
    run: RunInProgress, key: str, sequence: Sequence, labelled: LabelledTracks, config: Config, readout: Readout | None
) -> tuple[str, CameraModel, Readout | None]:
    """Find the lens, where it is not given or ruled out; return the key so far, the camera and its readout."""
    if not is_sought(sequence, config):
        return key, known_camera(sequence, config), readout
    limit = config.camera_init.max_depth_spread
    stages = stage_key(key, config.camera, config.bundle_adjustment, config.windows.calibration_sightings, limit)
    # Without what users add to stages: the lens is found on some of the frames.
    found = run.step("lens", stages, lambda hooks: lens_step(sequence, labelled, readout, config, hooks, run.recorder))
    camera, of_lens = found_camera(found), readout_of_array(found["readout"])
    return key if camera.is_plain and of_lens == readout else stages, camera, of_lens


def _stages(
    run: RunInProgress,
    key: str,
    inputs: StageInputs,
    cameras: Arrays | None,
    windows: list[Window],
    run_stage: StageRunner,
    fragments: FragmentSearch | None,
    loops: LoopClosing | None,
    static: BegunControl,
) -> tuple[str, Arrays, Arrays]:
    """Run stages 2 and 3 from the first cameras, or all three in windows, and the joint solve.

    Returns:
        The key so far, and the records of the static scene and of what moves: both are that of the joint solve if there
        is one.
    """
    sources: tuple[FactorSource, ...] = run.sources if loops is None else (*run.sources, loops)
    sequence, labelled, config = inputs.sequence, inputs.labelled, inputs.config
    if cameras is None:
        if config.joint.enabled:
            run.summary.warnings.append(NOT_IN_WINDOWS)
        run.forget("joint")
        key = stage_key(key, config.bundle_adjustment, config.windows, *fingerprints(sources))
        before = key
        if run.options is not None and run.sources:
            run.summary.warnings.append(NOT_ON_WORKERS)
        # What is solved in this process has the threads of one task too: it does not matter where windows are solved.
        with ExitStack() as stack:
            if run.options is not None:
                stack.enter_context(thread_limit(run.options.threads))
            parts = WindowedRun(
                sequence, labelled, windows, config, StageStore(run.store.folder / "windows"), run.resume, run_stage,
                run.reporter, run.should_stop, run.workers,
            )  # fmt: skip
            scene = run.step(
                "bundle_adjustment", key, lambda hooks: with_loops(loops, scene_step(parts, before, hooks))
            )
            key = stage_key(key, *_of_motion(config))
            after = key
            if run.workers is not None:
                static.begin(scene)  # while they solve windows this process is idle
            return key, scene, run.step("nonrigid", key, lambda hooks: motion_step(parts, scene, after, hooks))
    inertial = [] if run.imu is None else [config.imu, run.imu.digest()]
    key = stage_key(key, config.bundle_adjustment, *inertial, *fingerprints(sources))
    scene = run.step(
        "bundle_adjustment",
        key,
        lambda hooks: with_loops(
            loops,
            bundle_adjustment_step(sequence, labelled, cameras, config, hooks, run_stage, run.imu, fragments),
        ),
    )
    key = stage_key(key, *_of_motion(config))
    motion = run.step(
        "nonrigid",
        key,
        lambda hooks: nonrigid_step(labelled, scene, config, hooks, run_stage, sequence.timestamps),
    )
    if not config.joint.enabled:
        run.forget("joint")
        return key, scene, motion
    if run.imu is not None:
        run.summary.warnings.append(WITHOUT_IMU)
    key = stage_key(key, config.joint)
    both = run.step("joint", key, lambda hooks: joint_step(sequence, labelled, scene, motion, config, hooks, run_stage))
    return key, both, both


def _of_motion(config: Config) -> list[object]:
    """Return the settings of stage 3, those of cues that it does without, and those of rigid objects if any."""
    fusion = config.fusion
    judged = [fusion.broken_ratio, fusion.broken_share, fusion.min_broken_frames, fusion.min_control_points]
    return [config.nonrigid, *judged, *([config.rigid_objects] if config.rigid_objects.enabled else [])]


def _repair_masks(run: RunInProgress, key: str) -> str:
    """Give the sequence masks where some were missing, and return the key, with what was changed."""
    repaired = repair_masks(run.sequence.images, run.sequence.masks, run.sequence.image_size)
    if repaired is None:
        return key
    run.sequence = replace(run.sequence, masks=repaired)
    return stage_key(key, repaired.fingerprint())


def _labels(run: RunInProgress, key: str, images: bytes) -> tuple[str, LabelledTracks]:
    """Track and label; the labelled tracks are stored in ``labels.npz``, their key beside the stages.

    ``images`` is the hash of the images.
    """
    sequence, config = run.sequence, run.config
    key = stage_key(key, config.tracking if sequence.tracks is None else None, config.labels, config.input)

    fresh: list[LabelledTracks] = []

    def compute(hooks: Hooks) -> StageRecord:
        cache = run.store.folder
        tracks = load_or_track(
            sequence, config.tracking, cache, run.track_progress, run.should_stop,
            lambda path, made: run.written.put(partial(save_tracks, path, made)), images,
        )  # fmt: skip
        labelled = label_tracks(tracks, sequence, config.labels, config.input)
        run.written.put(partial(save_labels, run.folder.labels, labelled))
        fresh.append(labelled)
        counts = labelled.counts()
        facts = [", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())]
        facts += bars_note(sequence.content, sequence.image_size)
        blur = tracks.blur_px
        if blur is not None and blur.any():
            facts.append(
                f"{counted(int((blur > 0).sum()), 'frame')} blurred by up to {blur.max():.0f} px by the camera"
            )
        warnings = blur_warnings(blur, config.tracking.patch_px)
        found: dict[str, Any] = {"tracks": counts, "facts": facts, "warnings": warnings}
        if isinstance(sequence.masks, RepairedMasks):
            repaired = sequence.masks
            found |= {"repaired_masks": repaired.frames, "averaged_masks": repaired.instances}
            warnings += repair_warnings(repaired)
            if repaired.frames:
                facts.append(f"masks of {counted(len(repaired.frames), 'frame')} were made from those beside")
            if repaired.instances:
                facts.append(f"masks of {counted(len(repaired.instances), 'instance')} were averaged over frames")
        return StageRecord({"num_tracks": np.array(tracks.num_tracks)}, found)

    if run.resume and not _readable(lambda: load_labels(run.folder.labels)):
        run.store.discard("tracks")
    run.step("tracks", key, compute, 2 * (sequence.num_frames - 1) if sequence.tracks is None else None)
    return key, fresh[0] if fresh else load_labels(run.folder.labels)


def _fuse(
    run: RunInProgress, key: str, labelled: LabelledTracks, scene: Arrays, motion: Arrays, zoom: FloatArray | None,
    lens: Lens, static: BegunControl,
) -> None:  # fmt: skip
    expected = (run.sequence.num_frames, *run.sequence.image_size)
    stored = run.folder.depth
    if run.resume and not _readable(
        lambda: read_depth(stored, whole=True), lambda found: found.array.shape == expected
    ):
        run.store.discard("fusion")
    sure = run.folder.confidence
    if run.resume and run.config.fusion.static == "field":
        size = run.sequence.image_size
        if not _readable(lambda: read_confidence(sure, size), lambda found: len(found) == run.sequence.num_frames):
            run.store.discard("fusion")

    def compute(hooks: Hooks) -> StageRecord:
        workers = None if run.workers is None else run.workers.at_hand()
        summary = fuse_depth(
            run.folder, run.sequence, labelled, scene, motion, run.config.fusion, run.reporter, run.should_stop,
            zoom, lens, workers, static,
        )  # fmt: skip
        return StageRecord({}, summary)

    run.written.wait()  # depth takes the most space: whether there is any, the small files should say
    run.step("fusion", key, compute, run.sequence.num_frames)
    if run.workers is not None:
        run.workers.close()
    run.written.wait()


def _readable(read: Callable[[], ValueT], fits: Callable[[ValueT], bool] = lambda _: True) -> bool:
    """Tell whether a file that belongs to a stage's record is there, whole and of the right kind."""
    try:
        return fits(read())
    except InputError:
        return False
