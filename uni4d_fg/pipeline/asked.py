"""What a configuration asks of a video and cannot have: said before cues are made, or an earlier run is replaced."""

from __future__ import annotations

from uni4d_fg.config.models import Config
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.pipeline.inertial import check_goes_with_imu
from uni4d_fg.pipeline.lens import check_camera, is_sought
from uni4d_fg.pipeline.steps import given_poses
from uni4d_fg.pipeline.workers.options import WorkerOptions
from uni4d_fg.slam.windows.plan import windows_of


def check_asked(
    video: Video | Sequence, config: Config, imu: ImuSamples | None = None, workers: WorkerOptions | None = None
) -> None:
    """Check what is asked for against the video that it is meant for, without decoding a frame: before cues are made.

    Raises:
        ConfigError: If the video cannot be solved in the windows, or with the camera model or zoom, that are asked for;
            if the configuration leaves no place for an IMU, or has no windows for workers.
        InputError: If poses are to be taken from it, and it brings none, or the IMU does not cover the frames.
    """
    windows = windows_of(config, video.num_frames)
    if imu is not None:
        check_goes_with_imu(config, len(windows))
        imu.check_covers(video.timestamps)
    if workers is not None and config.windows.frames is None:
        raise ConfigError("workers solve the windows of a long video: set windows.frames (`--window N`)")
    given_poses(video, config)
    if not is_sought(video, config):
        check_camera(video, config)
