"""The native layout: one folder with ``rgb/``, ``K.npy``, ``depth_cue/``, ``masks/`` and optional extras."""

from __future__ import annotations

from pathlib import Path

from uni4d_fg.frontend.sequence.assemble import assemble
from uni4d_fg.frontend.sequence.layout import (
    SequenceFiles,
    check_root,
    existing,
    find_images,
    missing_images,
    subfolders,
)
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.reading import is_present

DEFAULT_DEPTH = "depth_cue"
DEPTH_NOTE = "depth_cue.json"
"""Beside that depth: ``{"metric": false}`` where it is in a unit of its own."""


def _depth_candidates(root: Path, depth: str | None) -> list[Path]:
    """Return what goes by the name ``depth`` here (by default the usual ones): a folder, a ``.npy`` file, or both."""
    name = depth or DEFAULT_DEPTH
    found = [path for path in (root / name, root / f"{name}.npy") if is_present(path)]
    if not found and name == DEFAULT_DEPTH and is_present(root / "depth.npy"):
        return [root / "depth.npy"]
    return found


def is_native_layout(root: Path, depth: str | None = None) -> bool:
    """Tell whether ``root`` holds frames and a depth cue under their native names."""
    return root.is_dir() and find_images(root) is not None and bool(_depth_candidates(root, depth))


def find_native_files(root: Path, depth: str | None = None) -> SequenceFiles:
    """Find the files of a sequence in the native layout.

    Args:
        root: The sequence folder.
        depth: Name of the depth cue: a folder of 16-bit PNGs in millimeters, or a ``.npy`` file in meters;
            None takes ``depth_cue`` or ``depth.npy`` if it is there.

    Returns:
        The files; what is wrong with them is in ``problems``.

    Raises:
        InputError: If ``root`` is not a folder.
    """
    check_root(root)
    problems: list[SequenceProblem] = []
    images = find_images(root)
    if images is None:
        problems.append(missing_images(root))
    candidates = _depth_candidates(root, depth)
    no_depth = None
    if not candidates:
        folders = some_of([f"{p.name}/" for p in subfolders(root)]) or "no folder"
        no_depth = SequenceProblem(
            root,
            f"has no depth: neither {depth or DEFAULT_DEPTH}/ nor {depth or DEFAULT_DEPTH}.npy is there "
            f"(found {folders})",
            "add it, or name another depth folder or .npy file",
        )
        if depth is not None:
            problems.append(no_depth)
    elif len(candidates) > 1:
        names = " and ".join(path.name for path in candidates)
        problems.append(SequenceProblem(root, f"has two depth cues, {names}", "remove or rename one of them"))
    true_depth = existing(root / "depth_gt") or existing(root / "depth_gt.npy")
    return SequenceFiles(
        root=root,
        layout="native",
        images=images,
        depth=candidates[0] if len(candidates) == 1 else None,
        depth_note=existing(root / DEPTH_NOTE) if depth in (None, DEFAULT_DEPTH) and candidates else None,
        masks=existing(root / "masks"),
        intrinsics=existing(root / "K.npy"),
        tracks=existing(root / "tracks.npz"),
        timestamps=existing(root / "timestamps.txt"),
        initial_poses=existing(root / "world_T_cam_init.npy"),
        true_poses=existing(root / "c2w.npy"),
        true_depth=true_depth,
        true_masks=existing(root / "masks_gt"),
        ground_truth=existing(root / "ground_truth.npz"),
        problems=tuple(problems),
        no_depth=no_depth,
    )


def read_native(root: Path, depth: str | None = None) -> Sequence:
    """Read a sequence in the native layout; frames are decoded only when they are used.

    ==========================  =========================================================================
    ``rgb/``                    one PNG or JPEG per frame, in the order of their names; without the folder
                                ``video.mp4`` (``.mov``, ``.mkv``, ...), or the images themselves
    ``K.npy``                   (3, 3) or (T, 3, 3), px; guessed from the image size when absent
    ``depth_cue/``              one 16-bit PNG per frame, millimeters, 0 = missing; or ``depth_cue.npy`` or
                                ``depth.npy``, (T, H, W) or (T, 1, H, W), meters
    ``masks/``                  one PNG of ids per frame; without the folder everything is static
    ``tracks.npz``              optional: uv (K, T, 2), visible (K, T), query_frame (K,), confidence (K, T)
    ``timestamps.txt``          optional: seconds, one per line
    ``world_T_cam_init.npy``    optional: (T, 4, 4) poses to start from
    ``c2w.npy``                 optional truth: (T, 4, 4) camera to world, OpenCV axes
    ``depth_gt/``               optional truth, like ``depth_cue/``; or ``depth_gt.npy``
    ``masks_gt/``               optional truth, like ``masks/``: what really moves
    ``ground_truth.npz``        optional truth: intrinsics (4,), track_points (K, T, 3), and of rigid objects
                                rigid_instance (J,) and world_T_object (J, T, 4, 4)
    ==========================  =========================================================================

    Args:
        root: The sequence folder.
        depth: Name of the depth cue to use; None takes the usual one.

    Returns:
        The sequence. Track observations outside the image are not visible.

    Raises:
        InputError: With the first thing found wrong. Only the first frame is decoded; a later one that is
            broken raises when it is used (:func:`~uni4d_fg.frontend.sequence.validate.validate_sequence` finds all).
    """
    return assemble(find_native_files(Path(root), depth))
