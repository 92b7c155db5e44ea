"""DAVIS: short videos of things that move, with their masks; no geometry is known.

    JPEGImages/480p/VIDEO/00000.jpg
    Annotations/480p/VIDEO/00000.png        palette PNG: the value is the number of the object, 0 background

F. Perazzi et al., "A benchmark dataset and evaluation methodology for video object segmentation", CVPR 2016;
J. Pont-Tuset et al., "The 2017 DAVIS challenge on video object segmentation", 2017.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from uni4d_fg.arrays import Int32Array
from uni4d_fg.frontend.datasets.base import (
    Dataset,
    DatasetCard,
    images_of,
    images_of_truth,
    make_video,
    names_of_folders,
)
from uni4d_fg.frontend.sequence.decode import MAX_PIXELS
from uni4d_fg.frontend.sequence.frames import FileFrames
from uni4d_fg.frontend.sequence.model import GroundTruth, Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.reading import MAX_IMAGE_BYTES, read_bytes

FRAME_RATE_HZ = 24.0
URL = "https://data.vision.ee.ethz.ch/csergi/share/davis/DAVIS-2017-trainval-480p.zip"
_AGAIN = "unpack the archive again"


class Davis(Dataset):
    """The videos at 480 lines; for pictures, and for methods that are given true masks."""

    card = DatasetCard(
        name="davis",
        title="DAVIS",
        truth=("masks",),
        convention="all frames; for pictures only, since no geometry is known",
        urls=(URL,),
        splits={"all": None},
        default_split="all",
        max_depth_m=None,
    )

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of the videos."""
        return names_of_folders(self._base(root) / "JPEGImages" / "480p")

    def open(self, root: Path, video: str) -> Video:
        """Open one video; truth is what moves, where it is annotated."""
        base = self._base(root)
        folder = self.need_folder(base / "JPEGImages" / "480p" / video, root)
        paths = images_of(folder, (".jpg", ".jpeg"))
        opened = make_video(video, folder, paths, np.arange(len(paths)) / FRAME_RATE_HZ, GroundTruth())
        annotated = base / "Annotations" / "480p" / video
        if not annotated.is_dir():
            return opened
        images_of_truth(paths, annotated, ".png")
        masks = PaletteMasks(
            tuple(self.need_file(annotated / f"{path.stem}.png", root) for path in paths), opened.image_size
        )
        masks[0]
        return replace(opened, ground_truth=GroundTruth(masks=masks))

    def _base(self, root: Path) -> Path:
        self.need_folder(root, root)
        inner = root / "DAVIS"
        return inner if inner.is_dir() else root


class PaletteMasks(FileFrames[Int32Array]):
    """T label maps whose colors are of a palette: the palette's index is the label."""

    def _decode(self, path: Path) -> Int32Array:
        data = read_bytes(path, MAX_IMAGE_BYTES, "a mask file")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                with Image.open(io.BytesIO(data)) as image:
                    if image.width * image.height > MAX_PIXELS:
                        raise SequenceProblem(path, f"announces {image.width} x {image.height} px", _AGAIN)
                    if image.mode not in ("P", "L", "1"):
                        raise SequenceProblem(path, f"has pixels of mode {image.mode}, not of a palette", _AGAIN)
                    labels = np.array(image)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            if isinstance(error, SequenceProblem):
                raise
            what = "of no known kind" if isinstance(error, UnidentifiedImageError) else str(error)
            raise SequenceProblem(path, f"cannot be decoded as an image ({what})", _AGAIN) from error
        # The masks of 2016 are black and white.
        return (labels > 0).astype(np.int32) if labels.max(initial=0) == 255 else labels.astype(np.int32)
