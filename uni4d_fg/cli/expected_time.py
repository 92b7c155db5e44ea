"""``doctor --time``: where the time of a reconstruction will go, before it starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uni4d_fg.cli.console import duration
from uni4d_fg.cli.forecast import expected_shares
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.runs import SequenceInput


def expected_time(path: Path, config: str | None) -> dict[str, Any]:
    """Return the tasks of ``reconstruct`` with a video's own cues, and what each is expected to take.

    Seconds are those of the machine on which the costs were measured; how they divide holds for others too.

    Args:
        path: Sequence folder, folder of images, or video file.
        config: Preset or YAML file.

    Raises:
        InputError: If the video cannot be read.
        ConfigError: If the configuration cannot.
    """
    from uni4d_fg.config.load import load_config

    settings = load_config(config, ())
    source = SequenceInput.of(
        path, LayoutChoice.auto, None, None, None, depth_gt_scale=1000.0, known_intrinsics=False
    )  # fmt: skip
    opened = source.open()
    video = opened.video
    shares = expected_shares(video.num_frames, video.image_size, settings, source.plan(opened), video.tracks)
    total = sum(share.seconds for share in shares)
    return {
        "name": video.name,
        "num_frames": video.num_frames,
        "image_size": list(video.image_size),
        "seconds": total,
        "tasks": [
            {"task": share.task, "seconds": share.seconds, "share": share.seconds / total} for share in shares
        ],
    }  # fmt: skip


def expected_time_lines(found: dict[str, Any]) -> list[str]:
    """Return what :func:`expected_time` found in words."""
    height, width = found["image_size"]
    lines = [
        f"{found['name']}: {found['num_frames']} frames of {width} x {height} px, "
        f"about {duration(found['seconds'])} on two cores",
    ]
    lines += [
        f"    {task['task']:<24} {task['seconds']:7.1f} s {100 * task['share']:4.0f} %" for task in found["tasks"]
    ]
    return lines
