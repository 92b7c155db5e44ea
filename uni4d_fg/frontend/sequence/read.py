"""Reading a sequence whatever its layout."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from uni4d_fg.frontend.sequence.assemble import assemble
from uni4d_fg.frontend.sequence.layout import (
    IMAGE_SUFFIXES,
    OTHER_IMAGE_SUFFIXES,
    Layout,
    LayoutName,
    LayoutOptions,
    SequenceFiles,
    check_root,
    find_images,
    not_read_images,
)
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.native import find_native_files, is_native_layout
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.uni4d_layout import find_uni4d_files, is_uni4d_layout
from uni4d_fg.reading import check_regular, is_present

if TYPE_CHECKING:
    from typing_extensions import Unpack


def detect_layout(root: Path, depth: str | None = None) -> LayoutName:
    """Tell which layout a folder has.

    Args:
        root: The sequence folder.
        depth: Name of the depth cue, if a particular one is meant.

    Raises:
        InputError: If it is no folder, has no frames, or fits both layouts.
    """
    check_root(root)
    native = is_native_layout(root, depth)
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
    what = "is not a sequence folder: there is no rgb/ and no video, nor are there images"
    remedy = "put frames into rgb/ and depth into depth_cue/ (native) or unidepth/depth.npy (Uni4D)"
    others = not_read_images(root)
    if others:
        what += f" that are read ({', '.join(IMAGE_SUFFIXES)}): it holds {', '.join(others)}"
        remedy = "convert them to .png or .jpg"
    raise SequenceProblem(root, what, remedy)


def find_files(root: Path, layout: Layout = "auto", **options: Unpack[LayoutOptions]) -> SequenceFiles:
    """Find the files of a sequence.

    Args:
        root: The sequence folder; or a folder of images, or a video file, which bring no cues.
        layout: "native" or "uni4d"; "auto" looks at what is there.
        **options: :class:`~uni4d_fg.frontend.sequence.layout.LayoutOptions`.

    Raises:
        InputError: If it cannot be told what ``root`` is, or an option does not fit it.
    """
    if layout not in ("auto", "native", "uni4d"):
        raise SequenceProblem(root, f"unknown layout {layout!r}", "choose auto, native or uni4d")
    if not is_present(root):
        raise SequenceProblem(root, "no such folder or file", "check the path")
    if not root.is_dir():
        check_regular(root, "a folder or a video file")
        if layout == "uni4d" or options.get("known_intrinsics"):
            asked = "Uni4D's layout" if layout == "uni4d" else "the K.npy of Uni4D's layout"
            raise SequenceProblem(root, f"is a file, and {asked} is asked for", "give the folder of the sequence")
        return _video_file(root, options)
    name = detect_layout(root, options.get("depth")) if layout == "auto" else layout
    if name == "uni4d":
        return find_uni4d_files(root, **options)
    if options.get("masks") is not None or options.get("tracks") is not None:
        raise SequenceProblem(
            root,
            "mask and track folders can be chosen in Uni4D's layout only",
            "use masks/ and tracks.npz here",
        )
    return find_native_files(root, options.get("depth"))


def _video_file(path: Path, options: LayoutOptions) -> SequenceFiles:
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise SequenceProblem(path, "is one image", "give a folder of images, or a video file")
    if path.suffix.lower() in OTHER_IMAGE_SUFFIXES:
        raise SequenceProblem(
            path, f"is a {path.suffix.lower()} image, which is not read",
            f"convert it to a video such as {path.stem}.mp4, or its frames to .png or .jpg in a folder",
        )  # fmt: skip
    named = [name for name in ("depth", "masks", "tracks") if options.get(name) is not None]
    if named:
        raise SequenceProblem(
            path,
            f"is a file, in which no {named[0]} can be chosen by name",
            "put it into a folder as video.mp4, with its cues beside it",
        )
    return SequenceFiles(
        root=path,
        layout="native",
        images=path,
        no_depth=SequenceProblem(
            path, "a video file brings no depth", "put it into a folder as video.mp4, with depth_cue.npy beside it"
        ),
    )


def read_sequence(root: Path, layout: Layout = "auto", **options: Unpack[LayoutOptions]) -> Sequence:
    """Read a sequence with its depth; frames are decoded only when they are used.

    :func:`~uni4d_fg.frontend.sequence.open_video.open_video` does without depth and can take a part of the frames.

    Args:
        root: The sequence folder.
        layout: "native" or "uni4d"; "auto" looks at what is there.
        **options: :class:`~uni4d_fg.frontend.sequence.layout.LayoutOptions`.

    Raises:
        InputError: With the first thing found wrong; :func:`~uni4d_fg.frontend.sequence.validate.validate_sequence`
            lists everything.
    """
    return assemble(find_files(Path(root), layout, **options))
