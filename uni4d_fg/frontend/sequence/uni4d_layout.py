"""Uni4D's preprocessed layout: ``rgb/``, ``unidepth/``, ``deva/Annotations/``, ``cotrackerv3_10_50/``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from uni4d_fg.frontend.sequence.assemble import assemble
from uni4d_fg.frontend.sequence.layout import (
    LayoutOptions,
    SequenceFiles,
    check_root,
    existing,
    find_images,
    missing_images,
    subfolders,
)
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.problems import SequenceProblem

if TYPE_CHECKING:
    from typing_extensions import Unpack

_TRACK_FILES = ("results.npz", "filtered_results.npz")


def _track_file(folder: Path) -> Path | None:
    return next((folder / name for name in _TRACK_FILES if (folder / name).is_file()), None)


def _has_depth(folder: Path) -> bool:
    return (folder / "depth.npy").is_file()


def _has_masks(folder: Path) -> bool:
    return (folder / "Annotations").is_dir()


def _has_tracks(folder: Path) -> bool:
    return _track_file(folder) is not None


def is_uni4d_layout(root: Path) -> bool:
    """Tell whether ``root`` holds ``rgb/`` and a depth, mask or track folder as Uni4D's preprocessing makes them."""
    return (root / "rgb").is_dir() and has_uni4d_cues(root)


def has_uni4d_cues(root: Path) -> bool:
    """Tell whether ``root`` holds a depth, mask or track folder as Uni4D's preprocessing makes them."""
    return any(_has_depth(f) or _has_masks(f) or _has_tracks(f) for f in subfolders(root))


def _choose(
    root: Path,
    cue: str,
    expected: str,
    holds: Callable[[Path], bool],
    chosen: str | None,
    problems: list[SequenceProblem],
) -> Path | None:
    """Return the folder of a cue: the chosen one, or the only candidate; what fails goes to ``problems``."""
    if chosen is not None:
        if holds(root / chosen):
            return root / chosen
        problems.append(SequenceProblem(root / chosen, f"has no {expected}", f"choose another {cue} folder"))
        return None
    candidates = [folder for folder in subfolders(root) if holds(folder)]
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        names = ", ".join(folder.name for folder in candidates)
        problems.append(
            SequenceProblem(root, f"has more than one {cue} folder: {names}", f"choose the {cue} folder by name")
        )
    return None


def find_uni4d_files(
    root: Path,
    *,
    depth: str | None = None,
    masks: str | None = None,
    tracks: str | None = None,
    depth_gt_scale: float = 1000.0,
    known_intrinsics: bool = False,
) -> SequenceFiles:
    """Find the files of a sequence in Uni4D's layout. Arguments as in :func:`read_uni4d`.

    Returns:
        The files; what is wrong with them is in ``problems``.

    Raises:
        InputError: If ``root`` is not a folder or ``depth_gt_scale`` is not positive.
    """
    check_root(root)
    if not depth_gt_scale > 0:
        raise SequenceProblem(root, f"depth_gt_scale {depth_gt_scale} is not positive", "give units per meter")
    problems: list[SequenceProblem] = []
    images = find_images(root)
    if images is None:
        problems.append(missing_images(root))
    depth_folder = _choose(root, "depth", "depth.npy", _has_depth, depth, problems)
    mask_folder = _choose(root, "mask", "Annotations/", _has_masks, masks, problems)
    track_folder = _choose(root, "track", " or ".join(_TRACK_FILES), _has_tracks, tracks, problems)
    known = existing(root / "K.npy")
    estimated = None if depth_folder is None else existing(depth_folder / "intrinsics.npy")
    if known_intrinsics and known is None:
        problems.append(
            SequenceProblem(
                root, "has no K.npy, but known intrinsics are asked for", "add it, or let them be estimated"
            )
        )
    return SequenceFiles(
        root=root,
        layout="uni4d",
        images=images,
        depth=None if depth_folder is None else depth_folder / "depth.npy",
        masks=None if mask_folder is None else mask_folder / "Annotations",
        intrinsics=known if known_intrinsics or estimated is None else estimated,
        tracks=None if track_folder is None else _track_file(track_folder),
        true_poses=existing(root / "c2w.npy"),
        true_depth=existing(root / "depth_gt"),
        true_depth_units_per_meter=depth_gt_scale,
        true_intrinsics=known,
        problems=tuple(problems),
        no_depth=SequenceProblem(root, "has no depth: no folder holds depth.npy", "run the depth preprocessing first")
        if depth_folder is None
        else None,
    )


def read_uni4d(root: Path, **options: Unpack[LayoutOptions]) -> Sequence:
    """Read a sequence as Uni4D's preprocessing leaves it; frames are decoded only when they are used.

    =====================================  ================================================================
    ``rgb/``                               one PNG or JPEG per frame, in the order of their names
    ``unidepth/depth.npy``                 (T, 1, H, W), meters; any folder with a ``depth.npy``
    ``unidepth/intrinsics.npy``            (3, 3) or (T, 3, 3) estimated intrinsics, px, principal point included
    ``deva/Annotations/``                  optional: RGB PNGs, id = R + 256 G + 65536 B; any ``*/Annotations/``
    ``cotrackerv3_10_50/results.npz``      optional tracks; ``filtered_results.npz`` when only that is there
    ``K.npy``                              optional: known intrinsics; used as truth and, on request, as input
    ``c2w.npy``                            optional truth: (T, 4, 4); a zero bottom row is repaired
    ``depth_gt/``                          optional truth: ``.npy`` in meters or 16-bit PNG
    =====================================  ================================================================

    Args:
        root: The sequence folder.
        **options: ``depth``, ``masks``, ``tracks``: names of folders; None takes the only one there is.
            ``depth_gt_scale``: units per meter of true depth in PNGs: 1000, or 256 for KITTI, 5000 for TUM and
            Bonn. ``known_intrinsics``: take ``K.npy`` instead of the depth network's estimate.

    Returns:
        The sequence. A track is visible where its visibility is 1 and it lies inside the image. True
        intrinsics are None when ``K.npy`` changes along the video.

    Raises:
        InputError: With the first thing found wrong, among it more than one candidate folder for a cue.
    """
    return assemble(find_uni4d_files(Path(root), **options))
