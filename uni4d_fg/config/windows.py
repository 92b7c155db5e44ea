"""Configuration of reconstruction in windows."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting


class WindowsConfig(Section):
    """Batch reconstruction in overlapping windows, for videos too long for one graph."""

    frames: int | None = setting(
        None, "Frames in a window at most; null solves the whole video as one graph.", ge=6, le=100000, basic=True
    )
    overlap: int = setting(
        10, "Frames that a window shares with the next; at most a third of frames.", ge=2, basic=True
    )
    rounds: int = setting(
        2, "Joint solves of all windows' cameras; between them every window is linearized anew at their result.", ge=1
    )
    calibration_sightings: int = setting(
        6,
        "The focal length of the whole video is found on frames as far apart as leaves an average track in this many "
        "of them.",
        ge=2,
    )
