"""Opening whatever a user has: a sequence folder, a folder of images, or a video file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from uni4d_fg.frontend.sequence.assemble import assemble_video
from uni4d_fg.frontend.sequence.layout import Layout, LayoutOptions
from uni4d_fg.frontend.sequence.model import Video
from uni4d_fg.frontend.sequence.read import find_files
from uni4d_fg.frontend.sequence.selection import FrameSelection, select_frames

if TYPE_CHECKING:
    from typing_extensions import Unpack

_EVERYTHING = FrameSelection()


def open_video(
    path: Path,
    selection: FrameSelection = _EVERYTHING,
    layout: Layout = "auto",
    **options: Unpack[LayoutOptions],
) -> Video:
    """Open a video with the cues that come with it; frames are decoded only when they are used.

    Args:
        path: A sequence folder of either layout, a folder of image files, or one video file. Depth, masks,
            intrinsics and tracks are taken where they are there; none is needed.
        selection: Frames to use and their largest size; images, cues and truth follow it alike.
        layout: "native" or "uni4d"; "auto" looks at what is there.
        **options: :class:`~uni4d_fg.frontend.sequence.layout.LayoutOptions`; what is named there must exist.

    Returns:
        The video. Its intrinsics are None when unknown, its timestamps (seconds) those of the video file or of
        ``timestamps.txt``, else the frame rate's or frame numbers.

    Raises:
        InputError: With the first thing found wrong. Of frames only the first is decoded; a later one that is
            broken raises when it is used.
    """
    path = Path(path)
    # The frames of a lone video file that nothing refers to need not be looked at beyond the last one used.
    stop = selection.stop if path.is_file() else None
    return select_frames(assemble_video(find_files(path, layout, **options), stop), selection)
