"""What an earlier run in the same folder may have left: temporary files of a killed one, a summary, views."""

from __future__ import annotations

import re
from pathlib import Path

from uni4d_fg.files import write_failure
from uni4d_fg.results.run_folder import RunFolder

_TEMPORARY = re.compile(r"\.tmp-[0-9a-f]{8}-(?P<name>.+)")


def remove_leftovers(folder: RunFolder) -> None:
    """Remove temporary files that a killed run could not remove, and the summary, which says that a run is complete.

    Raises:
        OutputError: If one cannot be removed.
    """
    results = (folder.reconstruction, folder.trajectory, folder.depth, folder.summary, folder.config, folder.labels)
    names = {path.name for path in results}
    stages, clouds, pictures = folder.root / "stages", folder.static_cloud.parent, folder.trajectory_picture.parent
    for parent in (folder.root, stages, folder.graphs, clouds, folder.dynamic_cloud(0).parent, pictures):
        for path in parent.glob(".tmp-*") if parent.is_dir() else ():
            temporary = _TEMPORARY.fullmatch(path.name)
            ours = temporary is not None and (parent != folder.root or temporary["name"] in names)
            if ours and path.is_file():
                _remove(path)
    _remove(folder.summary)


def remove_views(folder: RunFolder) -> None:
    """Remove the clouds and pictures of an earlier result.

    Raises:
        OutputError: If one cannot be removed.
    """
    dynamic = folder.dynamic_cloud(0).parent
    pictures = (folder.trajectory_picture, folder.depth_picture, folder.scene_picture)
    for path in (folder.static_cloud, *sorted(dynamic.glob("*.ply")), *pictures):
        _remove(path)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise write_failure(path, error) from error
