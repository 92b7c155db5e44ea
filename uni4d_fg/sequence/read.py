"""Reading a sequence whatever its layout."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from uni4d_fg.sequence.assemble import assemble
from uni4d_fg.sequence.layout import LayoutName, SequenceFiles, check_root, find_images
from uni4d_fg.sequence.model import Sequence
from uni4d_fg.sequence.native import DEFAULT_DEPTH, find_native_files, is_native_layout
from uni4d_fg.sequence.problems import SequenceProblem
from uni4d_fg.sequence.uni4d_layout import find_uni4d_files, is_uni4d_layout

Layout = Literal["auto", "native", "uni4d"]


def detect_layout(root: Path, depth: str | None = None) -> LayoutName:
    """Tell which layout a folder has.

    Args:
        root: The sequence folder.
        depth: Name of the depth cue, if a particular one is meant.

    Raises:
        InputError: If it is no folder, has no frames, or fits both layouts.
    """
    check_root(root)
    native = is_native_layout(root, depth or DEFAULT_DEPTH)
    uni4d = is_uni4d_layout(root)
    if native and uni4d:
        if depth is not None:
            # A named depth folder with a depth.npy inside is Uni4D's; one of images is native.
            return "uni4d" if (root / depth / "depth.npy").is_file() else "native"
        raise SequenceProblem(root, "holds both the native and Uni4D's layout", "choose layout native or uni4d")
    if uni4d:
        return "uni4d"
    if native or find_images(root) is not None:
        return "native"
    raise SequenceProblem(
        root,
        "is not a sequence folder: there is no rgb/ and no video",
        "put frames into rgb/ and depth into depth_cue/ (native) or unidepth/depth.npy (Uni4D)",
    )


def find_files(
    root: Path,
    layout: Layout = "auto",
    *,
    depth: str | None = None,
    masks: str | None = None,
    tracks: str | None = None,
    depth_gt_scale: float = 1000.0,
    known_intrinsics: bool = False,
) -> SequenceFiles:
    """Find the files of a sequence. Arguments and errors as in :func:`read_sequence`."""
    if layout not in ("auto", "native", "uni4d"):
        raise SequenceProblem(root, f"unknown layout {layout!r}", "choose auto, native or uni4d")
    name = detect_layout(root, depth) if layout == "auto" else layout
    if name == "uni4d":
        return find_uni4d_files(
            root,
            depth=depth,
            masks=masks,
            tracks=tracks,
            depth_gt_scale=depth_gt_scale,
            known_intrinsics=known_intrinsics,
        )
    if masks is not None or tracks is not None:
        raise SequenceProblem(
            root,
            "mask and track folders can be chosen in Uni4D's layout only",
            "use masks/ and tracks.npz here",
        )
    return find_native_files(root, depth or DEFAULT_DEPTH)


def read_sequence(
    root: Path,
    layout: Layout = "auto",
    *,
    depth: str | None = None,
    masks: str | None = None,
    tracks: str | None = None,
    depth_gt_scale: float = 1000.0,
    known_intrinsics: bool = False,
) -> Sequence:
    """Read a sequence folder; frames are decoded only when they are used.

    Args:
        root: The sequence folder.
        layout: "native" or "uni4d"; "auto" looks at what is there.
        depth: Name of the depth cue; None takes ``depth_cue`` (native) or the only candidate (Uni4D).
        masks: Mask folder (Uni4D's layout only).
        tracks: Track folder (Uni4D's layout only).
        depth_gt_scale: Units per metre of PNGs in ``depth_gt/`` (Uni4D's layout only; native is millimetres).
        known_intrinsics: Take ``K.npy`` instead of the estimate (Uni4D's layout; native always does).

    Raises:
        InputError: With the first thing found wrong; :func:`~uni4d_fg.sequence.validate.validate_sequence`
            lists everything.
    """
    files = find_files(
        Path(root),
        layout,
        depth=depth,
        masks=masks,
        tracks=tracks,
        depth_gt_scale=depth_gt_scale,
        known_intrinsics=known_intrinsics,
    )
    return assemble(files)
