"""Verbs about sequences: ``validate``, ``track``, ``synthesize``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json, validation_text
from uni4d_fg.cli.interruption import Interruption
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.runs import SequenceInput
from uni4d_fg.errors import ConfigError, InputError, OutputError

if TYPE_CHECKING:
    from uni4d_fg.arrays import ImageArray
    from uni4d_fg.frontend.sequence.model import FrameSource


def validate(
    seq: options.SequenceFolder,
    layout: options.Layout = LayoutChoice.auto,
    depth: options.Depth = None,
    masks: options.Masks = None,
    tracks: options.Tracks = None,
    intrinsics: options.IntrinsicsFile = None,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    depth_gt_scale: options.DepthScale = 1000.0,
    known_intrinsics: options.KnownIntrinsics = False,
    json: options.Json = False,
) -> None:
    """Check a sequence: what is there, what is wrong, what to do. Exit code 3 if it cannot be used.

    Options as `reconstruct` will get them: what they leave out or replace is not read, and of a configuration the
    limits of depth count.
    """
    from uni4d_fg.config.load import load_config
    from uni4d_fg.frontend.sequence.validate import validate_sequence

    source = SequenceInput.of(
        seq, layout, depth, masks, tracks, depth_gt_scale=depth_gt_scale, known_intrinsics=known_intrinsics,
        intrinsics=intrinsics, start=start, stop=stop, stride=stride,
    )  # fmt: skip
    report = validate_sequence(
        seq, selection=source.selection, intrinsics=source.calibration,
        limits=load_config(config, changes or ()).input, **source.arguments(),
    )  # fmt: skip
    if json:
        print_json(report.to_dict())
    else:
        typer.echo(validation_text(report))
    if not report.ok:
        raise typer.Exit(InputError.exit_code)


def track(
    seq: options.VideoPath,
    out: Annotated[Path | None, typer.Option(help="Track file; SEQ/tracks.npz if not given.")] = None,
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Track points through a video with the built-in tracker and write them to a file."""
    from uni4d_fg.config.load import load_config
    from uni4d_fg.frontend.tracks.io import save_tracks
    from uni4d_fg.frontend.tracks.lucas_kanade import track_grid

    settings = load_config(config, changes or ()).tracking
    images, path = images_and_track_file(seq, out, overwrite)
    with progress_reporter(quiet) as reporter, Interruption() as stop:
        reporter.begin("tracking", 2 * (len(images) - 1))
        found = track_grid(images, settings, lambda done, _: reporter.advance(done), stop)
        reporter.end()
    save_tracks(path, found)
    length = found.visible.sum() / max(found.num_tracks, 1)
    typer.echo(f"{found.num_tracks} tracks, seen in {length:.1f} of {found.num_frames} frames on average: {path}")


def images_and_track_file(seq: Path, out: Path | None, overwrite: bool) -> tuple[FrameSource[ImageArray], Path]:
    """Open the images of a sequence, a folder or a video file, and choose where its tracks go.

    Raises:
        InputError: If there are no images, or there is no place for the tracks and ``out`` is not given.
        OutputError: If the file exists and is not to be replaced.
    """
    from uni4d_fg.frontend.sequence.assemble import open_images
    from uni4d_fg.frontend.sequence.layout import find_images
    from uni4d_fg.frontend.sequence.open_video import open_video
    from uni4d_fg.frontend.sequence.uni4d_layout import is_uni4d_layout

    own = find_images(seq) if seq.is_dir() else None
    # The other cues of a sequence folder may be missing or broken: tracks need images only.
    images = open_video(seq).images if own is None else open_images(own)
    if out is None and (own is None or is_uni4d_layout(seq)):
        raise InputError(f"{seq}: has no place for these tracks; choose a file with --out")
    path = out or seq / "tracks.npz"
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already; replace it with --overwrite or choose another --out")
    return images, path


def synthesize(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to make.", show_default=False)],
    frames: Annotated[int | None, typer.Option(help="Number of frames.", show_default=False)] = None,
    width: Annotated[int | None, typer.Option(help="Image width, px.", show_default=False)] = None,
    height: Annotated[int | None, typer.Option(help="Image height, px.", show_default=False)] = None,
    path: Annotated[str | None, typer.Option(help="Camera: handheld, static, rotation or forward.")] = None,
    objects: Annotated[str | None, typer.Option(help="Movers: none, rigid, deforming, both or all_dynamic.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the noise.", show_default=False)] = None,
    changes: options.Overrides = None,
    layout: options.Layout = LayoutChoice.native,
    dataset: Annotated[
        str | None,
        typer.Option(
            "--as",
            metavar="sintel|tum|bonn|kitti",
            help="Write one more video of a dataset, in its own layout.",
            show_default=False,
        ),
    ] = None,
    video: Annotated[str | None, typer.Option(help="Name of the video, with --as.", show_default=False)] = None,
    imu: Annotated[bool, typer.Option("--imu", help="Write an accelerometer and a gyroscope too: imu.csv.")] = False,
    quiet: options.Quiet = False,
) -> None:
    """Make a moving scene with exact ground truth. All fields of --set are in docs/configuration_advanced.md."""
    from uni4d_fg.cli.scenes import scene_config, write_scene, write_scene_as

    if dataset is not None and (imu or layout == LayoutChoice.uni4d):
        raise ConfigError("--as writes the layout of a dataset, without an IMU; leave out --layout and --imu")
    if dataset is None and video is not None:
        raise ConfigError("--video names a video of a dataset; choose its layout with --as")
    named = {"num_frames": frames, "width": width, "height": height, "path": path, "objects": objects, "seed": seed}
    scene = scene_config(named, changes or ())
    with progress_reporter(quiet) as reporter:
        reporter.begin("synthetic scene", None)
        if dataset is not None:
            name, used = write_scene_as(scene, out, dataset, video)
            reporter.end()
            typer.echo(f"{name}: {scene.num_frames} frames of {scene.width} x {scene.height} px, {used} used: {out}")
            return
        sequence = write_scene(scene, out, layout.value, imu=imu)
        reporter.end()
    tracks = 0 if sequence.tracks is None else sequence.tracks.num_tracks
    typer.echo(f"{sequence.num_frames} frames of {scene.width} x {scene.height} px, {tracks} tracks: {out}")
