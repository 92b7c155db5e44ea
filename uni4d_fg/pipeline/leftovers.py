"""What an earlier run in the same folder may have left: temporary files of a killed one, a summary, views."""

from __future__ import annotations

from uni4d_fg.files import remove_file
from uni4d_fg.results import run_contents
from uni4d_fg.results.run_folder import RunFolder


def remove_leftovers(folder: RunFolder) -> None:
    """Remove temporary files that a killed run could not remove, and the summary, which says that a run is complete.

    Raises:
        OutputError: If one cannot be removed.
    """
    run_contents.remove_leftovers(folder.root)
    remove_file(folder.summary)


def remove_views(folder: RunFolder) -> None:
    """Remove the clouds and pictures of an earlier result.

    Raises:
        OutputError: If one cannot be removed.
    """
    dynamic = folder.dynamic_cloud(0).parent
    pictures = (folder.trajectory_picture, folder.depth_picture, folder.scene_picture)
    for path in (folder.static_cloud, *sorted(dynamic.glob("[0-9]*.ply")), *pictures):
        remove_file(path)
