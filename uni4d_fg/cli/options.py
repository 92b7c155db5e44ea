"""Arguments and options that several verbs share."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class LayoutChoice(str, Enum):
    """Folder layouts that can be read."""

    auto = "auto"
    native = "native"
    uni4d = "uni4d"


class SolverChoice(str, Enum):
    """Minimizers of the stages."""

    lm = "lm"
    adam = "adam"


SequenceFolder = Annotated[Path, typer.Argument(metavar="SEQ", help="Folder of the sequence.", show_default=False)]
VideoPath = Annotated[
    Path,
    typer.Argument(metavar="SEQ|VIDEO", help="Sequence folder, folder of images, or video file.", show_default=False),
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)]
Layout = Annotated[LayoutChoice, typer.Option(help="Layout of the sequence; 'auto' looks at what is there.")]
Depth = Annotated[
    str | None, typer.Option(help="Name of the depth cue, where the sequence has several.", show_default=False)
]
Masks = Annotated[str | None, typer.Option(help="Mask folder (Uni4D's layout).", show_default=False)]
Tracks = Annotated[str | None, typer.Option(help="Track folder (Uni4D's layout).", show_default=False)]
DepthFiles = Annotated[
    str | None,
    typer.Option("--depth", help="Depth: a name in the sequence, or a folder or .npy file.", show_default=False),
]
DepthModel = Annotated[
    str | None,
    typer.Option(metavar="CARD[=ONNX]", help="Make depth with a network: its model card.", show_default=False),
]
MaskFiles = Annotated[
    str | None,
    typer.Option(
        "--masks", metavar="NAME|FILE|motion|none", help="Masks: a name, a file, from motion, or none.",
        show_default=False,
    ),
]  # fmt: skip
MaskModel = Annotated[
    str | None, typer.Option(metavar="CARD[=ONNX]", help="Make masks with a segmenter.", show_default=False)
]
Classes = Annotated[str | None, typer.Option(help="Classes that may move, separated by commas.", show_default=False)]
TrackFiles = Annotated[
    str | None, typer.Option("--tracks", help="Tracks: a name in the sequence, or an .npz file.", show_default=False)
]
TrackModel = Annotated[
    str | None, typer.Option(metavar="CARD[=ONNX]", help="Make tracks with a network.", show_default=False)
]
IntrinsicsFile = Annotated[
    str | None,
    typer.Option(
        "--intrinsics", help="Calibration: .npy, COLMAP, OpenCV, ROS, Kalibr, nerfstudio.", show_default=False
    ),
]
OneShot = Annotated[
    bool, typer.Option("--one-shot", help="Solve the video as one shot, whatever cuts are found; they are named.")
]
Imu = Annotated[
    Path | None,
    typer.Option(
        "--imu", metavar="FILE|FOLDER", help="Accelerometer and gyroscope: a CSV file, or a folder with imu.csv.",
        show_default=False,
    ),
]  # fmt: skip
OdometryFile = Annotated[
    Path | None,
    typer.Option("--odometry", help="Odometry: TUM trajectory, with sigmas or without.", show_default=False),
]
GpsFile = Annotated[Path | None, typer.Option("--gps", help="GPS positions: CSV.", show_default=False)]
RelativePosesFile = Annotated[
    Path | None, typer.Option("--relative-poses", help="Known relative poses of frames: g2o.", show_default=False)
]
Start = Annotated[int, typer.Option(help="First frame.")]
Stop = Annotated[int | None, typer.Option(help="First frame that is left out.", show_default=False)]
Stride = Annotated[int, typer.Option(help="Use every N-th frame.")]
MaxSize = Annotated[int | None, typer.Option(help="Longer side of the images at most, px.", show_default=False)]
DepthScale = Annotated[float, typer.Option(help="Units per meter of true depth in PNGs (Uni4D's layout).")]
KnownIntrinsics = Annotated[
    bool, typer.Option("--known-intrinsics", help="Take K.npy instead of the estimate (Uni4D's layout).")
]
ConfigChoice = Annotated[
    str | None, typer.Option("--config", help="Preset or YAML file.", metavar="PRESET|FILE", show_default=False)
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="Change one field; may be repeated.", show_default=False),
]
Solver = Annotated[SolverChoice | None, typer.Option(help="Minimizer; short for --set solver=...", show_default=False)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
WindowFrames = Annotated[
    int | None,
    typer.Option("--window", help="Solve in windows of this many frames, for a video too long for one graph.", min=6),
]
WindowOverlap = Annotated[
    int | None, typer.Option("--overlap", help="Frames that a window shares with the next.", min=2)
]
WindowProcesses = Annotated[
    int | None,
    typer.Option(
        "--workers", help="Solve this many windows at once, each in its own process; 1: in this one, same result.",
        show_default=False,
    ),
]  # fmt: skip
WindowScheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="ADDRESS", help="Dask scheduler of a cluster that solves the windows.",
        show_default=False,
    ),
]  # fmt: skip
WindowTimeLimit = Annotated[
    float | None,
    typer.Option(
        "--time-limit", metavar="MINUTES", show_default=False,
        help="With --workers: a window that takes longer is ended and tried again; 360 if not given.",
    ),
]  # fmt: skip
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue a run; finished stages are kept.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
