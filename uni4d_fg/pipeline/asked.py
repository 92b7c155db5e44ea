"""What a configuration asks of a video and cannot have: said before cues are made, or an earlier run is replaced."""

from __future__ import annotations

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.pipeline.lens import check_camera, is_sought
from uni4d_fg.pipeline.steps import given_poses
from uni4d_fg.slam.windows.plan import windows_of


def check_asked(video: Video | Sequence, config: Config) -> None:
    """Check a configuration against the video that it is meant for, without decoding a frame.

    Raises:
        ConfigError: If the video cannot be solved in the windows, or with the camera model or zoom, that are asked for.
        InputError: If poses are to be taken from it, and it brings none.
    """
    windows_of(config, video.num_frames)
    given_poses(video, config)
    if not is_sought(video, config):
        check_camera(video, config)
