"""A full check of a sequence folder that lists everything wrong at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.cues import InputConfig
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence import assemble, naming
from uni4d_fg.frontend.sequence.calibration import (
    CHECK_SIZE,
    VaryingIntrinsics,
    guess_intrinsics,
    implausible,
    load_intrinsics,
)
from uni4d_fg.frontend.sequence.calibration_files import load_calibration
from uni4d_fg.frontend.sequence.decode import MIN_16_BIT_RANGE, check_bit_depth, is_16_bit_png
from uni4d_fg.frontend.sequence.frame_checks import outside_limits, usable_depth
from uni4d_fg.frontend.sequence.frames import FileFrames, ImageFolder, LazyFrames
from uni4d_fg.frontend.sequence.layout import IMAGE_SUFFIXES, Layout, LayoutOptions, SequenceFiles, list_frames
from uni4d_fg.frontend.sequence.poses import load_poses, load_timestamps
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.frontend.sequence.read import find_files
from uni4d_fg.frontend.sequence.report import ValidationReport
from uni4d_fg.frontend.sequence.scan import Findings, scan_frames
from uni4d_fg.frontend.sequence.selection import FrameSelection, selected_frames
from uni4d_fg.frontend.sequence.video import VideoFrames

if TYPE_CHECKING:
    from typing_extensions import Unpack

MOSTLY_MISSING = 0.5
"""Share of missing depth above which a warning is given."""
MAX_TIME_RATIO = 1.5
"""Ratio of the longest to the shortest time between frames that is taken for a constant frame rate."""
PLAUSIBLE_DEPTH = (0.05, 200.0)
"""Range in meters in which a frame's median depth is expected."""
_LIMITS = InputConfig()
"""Of the depth that is used, unless a configuration says otherwise."""
_EVERYTHING = FrameSelection()


def validate_sequence(
    root: Path,
    layout: Layout = "auto",
    *,
    selection: FrameSelection = _EVERYTHING,
    intrinsics: Path | None = None,
    limits: InputConfig = _LIMITS,
    **options: Unpack[LayoutOptions],
) -> ValidationReport:
    """Read every file of a sequence and list all that is wrong, odd or worth knowing.

    Bad content never raises: it becomes a finding that says what to do.

    Args:
        root: The sequence folder.
        layout: "native" or "uni4d"; "auto" looks at what is there.
        selection: Frames that will be used: of images, depth and masks the others are not read. Its size plays no part.
        intrinsics: Calibration that will be used in place of the sequence's own, which is then not read.
        limits: Of the depth that will be used.
        **options: :class:`~uni4d_fg.frontend.sequence.layout.LayoutOptions`.

    Returns:
        The findings and a table of what was found.
    """
    root = Path(root)
    findings = Findings()
    files = findings.attempt("sequence", lambda: find_files(root, layout, **options))
    if files is not None:
        for problem in files.problems:
            findings.add_error("sequence", problem)
        files = files if intrinsics is None else replace(files, intrinsics=intrinsics)
        _Validation(files, findings, selection, limits).run()
    found_layout = None if files is None else files.layout
    return ValidationReport(root, found_layout, tuple(findings.findings), tuple(findings.items))


class _Validation:
    """One pass over the items of a sequence; later items are compared with the images."""

    def __init__(
        self, files: SequenceFiles, findings: Findings, selection: FrameSelection, limits: InputConfig
    ) -> None:
        self.files = files
        self.findings = findings
        self.selection = selection
        self.limits = limits
        self.size: tuple[int, int] | None = None
        self.num_frames: int | None = None
        self.image_stems: list[str] | None = None
        self.num_tracks: int | None = None
        self.metric = True

    def run(self) -> None:
        files = self.files
        if files.images is not None:
            self._images(files.images)
        if files.depth_note is not None and self.num_frames is not None:
            self._depth_note(files.depth_note, self.num_frames)
        if files.depth is not None:
            self._depth("depth", files.depth, 1000.0)
        elif files.no_depth is not None and not files.problems:
            self.findings.add(
                "warning",
                "depth",
                f"{files.no_depth.where}: {files.no_depth.what}",
                "add it, or have it made by a network; else the scale of the world stays unknown",
            )
        self._masks(files.masks)
        if self.num_frames is None or self.size is None:
            return
        num_frames, size = self.num_frames, self.size
        self._intrinsics(files.intrinsics, num_frames, size)
        self._tracks(files.tracks, num_frames, size)
        if files.timestamps is not None:
            self._array("timestamps", lambda path: load_timestamps(path, num_frames), files.timestamps)
        if files.initial_poses is not None:
            self._array("initial poses", lambda path: load_poses(path, num_frames), files.initial_poses)
        if files.true_poses is not None:
            self._array("true poses", lambda path: load_poses(path, num_frames, may_lack=True), files.true_poses)
        if files.true_depth is not None:
            self._depth("true depth", files.true_depth, files.true_depth_units_per_meter)
        if files.true_masks is not None:
            self._true_masks(files.true_masks)
        self._other_truth(num_frames, size)

    def _images(self, path: Path) -> None:
        # As it is opened: only of a lone video file the end is not looked at.
        stop = self.selection.stop if path == self.files.root else None
        images = self.findings.attempt("images", lambda: _open_images(path, stop))
        if images is None:
            return
        self.num_frames = len(images)
        chosen = self._chosen(images)
        if isinstance(images, ImageFolder):
            self.image_stems = [file.stem for file in images.paths]
            naming.check_numbering(self.image_stems, self.findings)
        else:
            self._frame_times(images)

        black: list[int] = []

        def visit(frame: int, image: npt.NDArray[np.uint8]) -> None:
            if not isinstance(images, ImageFolder):
                return
            if frame == chosen[0]:
                self.findings.attempt("images", lambda: check_bit_depth(*assemble.sampled(images.paths)))
            if int(image.max(initial=0)) < MIN_16_BIT_RANGE // 256 and is_16_bit_png(images.paths[frame]):
                black.append(frame)

        scan_frames("images", images, self.findings, visit, chosen)
        if black:
            self.findings.add(
                "warning",
                "images",
                f"{path}: 16-bit images that are next to black in frame(s) {some_of(black)}",
                "scale all images by one factor to the whole range, unless these are dark",
            )
        if self.findings.items[-1].shape:
            self.size = images.size
        self.findings.attempt("images", lambda: assemble.check_length(path, len(images)))
        if len(chosen) < len(images):
            self.findings.attempt("images", lambda: selected_frames(self.selection, len(images), path))

    def _chosen(self, frames: LazyFrames[Any]) -> IntArray:
        """Return the frames of a source that are used; of those that it lacks :meth:`_pairing` tells."""
        chosen = self.selection.indices(len(frames) if self.num_frames is None else self.num_frames)
        return chosen[chosen < len(frames)]

    def _frame_times(self, images: VideoFrames) -> None:
        """Say where the times of a video file are from, if not from a constant frame rate."""
        if images.times is None:
            source = "the frame rate" if images.frame_rate else "frame numbers"
            self.findings.add(
                "info",
                "images",
                f"{images.path}: its frames have no times that increase; {source} stand in for them",
                "add timestamps.txt if times matter",
            )
            return
        steps = np.diff(images.times)
        if steps.size and steps.max() > MAX_TIME_RATIO * steps.min():
            self.findings.add(
                "info",
                "images",
                f"{images.path}: variable frame rate, frames {steps.min():.3g} to {steps.max():.3g} s apart; "
                "their times are kept",
                "none",
            )

    def _depth_note(self, path: Path, num_frames: int) -> None:
        note = self.findings.attempt("depth", lambda: assemble.load_depth_note(path, num_frames))
        if note is not None and not note.metric:
            self.metric = False
            self.findings.add(
                "info", "depth", f"{path}: depth is in a unit of its own", "none: lengths are in that unit"
            )

    def _depth(self, item: str, path: Path, units_per_meter: float) -> None:
        frames = self.findings.attempt(item, lambda: assemble.open_depth(path, self.size, units_per_meter))
        if frames is None:
            return
        self._pairing(item, path, frames)
        missing: list[float] = []
        medians: list[float] = []
        empty: list[int] = []
        odd: list[int] = []
        usable: list[int] = []
        in_meters = self.metric or item != "depth"

        def visit(frame: int, depth: npt.NDArray[np.float32]) -> None:
            known = depth[np.isfinite(depth)]
            if usable_depth(known, self.limits).any():
                usable.append(frame)
            missing.append(1.0 - known.size / max(depth.size, 1))
            if not known.size:
                empty.append(frame)
                return
            medians.append(float(np.median(known)))
            if in_meters and not PLAUSIBLE_DEPTH[0] <= medians[-1] <= PLAUSIBLE_DEPTH[1]:
                odd.append(frame)

        scan_frames(item, frames, self.findings, visit, self._chosen(frames))
        of_no_use = item == "depth" and bool(medians) and not usable
        if missing and len(empty) == len(missing):
            self.findings.add("error", item, f"{path}: all depth is missing", "check how the depth was exported")
        elif empty:
            self.findings.add(
                "warning",
                item,
                f"{path}: all depth is missing in frame(s) {some_of(empty)}",
                "replace these depth maps; the frames are tied by their neighbors only",
            )
        if odd:
            self.findings.add(
                "error" if of_no_use else "warning",
                item,
                f"{path}: the median depth is outside {PLAUSIBLE_DEPTH[0]} to {PLAUSIBLE_DEPTH[1]:g} m "
                f"in frame(s) {some_of(odd)}",
                "check the unit: PNGs are in millimeters, .npy in meters",
            )
        elif of_no_use:
            outside = outside_limits(float(np.median(medians)), self.limits, "m", "in every frame")
            self.findings.add_error(item, SequenceProblem(path, *outside))
        if len(empty) < len(missing) and np.mean(missing) > MOSTLY_MISSING:
            self.findings.add(
                "warning",
                item,
                f"{path}: {100 * float(np.mean(missing)):.0f} % of the depth is missing",
                "check how the depth was exported, or use a denser depth cue",
            )

    def _true_masks(self, path: Path) -> None:
        frames = self.findings.attempt("true masks", lambda: assemble.open_masks(path, self.size))
        if frames is not None:
            self._pairing("true masks", path, frames)
            scan_frames("true masks", frames, self.findings, chosen=self._chosen(frames))

    def _masks(self, path: Path | None) -> None:
        if path is None:
            self.findings.add(
                "info",
                "masks",
                "there are no masks: with depth the whole scene is taken as static, else they come from motion",
                "add masks if things move, or have them made: reconstruct --masks motion, or --mask-model",
            )
            return
        frames = self.findings.attempt("masks", lambda: assemble.open_masks(path, self.size))
        if frames is None:
            return
        self._pairing("masks", path, frames)
        empty: list[int] = []
        full: list[int] = []

        def visit(frame: int, mask: npt.NDArray[np.int32]) -> None:
            moving = mask > 0
            if not moving.any():
                empty.append(frame)
            elif moving.all():
                full.append(frame)

        chosen = self._chosen(frames)
        scan_frames("masks", frames, self.findings, visit, chosen)
        if empty and len(empty) == len(chosen):
            self.findings.add(
                "info",
                "masks",
                f"{path}: all masks are empty: a static video",
                "none, unless something moves in it",
            )
        if full:
            self.findings.add(
                "error" if len(full) == len(chosen) else "warning",
                "masks",
                f"{path}: no pixel is static in frame(s) {some_of(full)}",
                "check that 0 means static; the camera cannot be found from moving things",
            )

    def _pairing(self, item: str, path: Path, frames: LazyFrames[Any]) -> None:
        """Compare a cue's number of frames, and its file names, with the images."""
        if self.image_stems is not None and isinstance(frames, FileFrames):
            naming.check_pairing(item, [file.stem for file in frames.paths], self.image_stems, self.findings)
        elif self.num_frames is not None:
            found, expected = len(frames), self.num_frames
            self.findings.attempt(item, lambda: assemble.check_count(path, found, expected))

    def _intrinsics(self, path: Path | None, num_frames: int, size: tuple[int, int]) -> None:
        if path is None:
            self.findings.add(
                "warning",
                "intrinsics",
                f"there is no K.npy: a focal length of {guess_intrinsics(size)[0]:.0f} px is guessed",
                "add K.npy, or leave the intrinsics free",
            )
            return
        intrinsics = self._array("intrinsics", lambda p: load_calibration(p, num_frames, size).intrinsics, path)
        odd = None if intrinsics is None else implausible(intrinsics, size)
        if odd:
            self.findings.add("warning", "intrinsics", f"{path}: {odd}", CHECK_SIZE)

    def _tracks(self, path: Path | None, num_frames: int, size: tuple[int, int]) -> None:
        if path is None:
            self.findings.add("info", "tracks", "there are no tracks", "none: the built-in tracker makes them")
            return
        raw = self.findings.attempt("tracks", lambda: assemble.load_tracks(self.files, path, num_frames))
        if raw is None:
            return
        self.num_tracks = int(raw.visible.shape[0])
        self.findings.add_array("tracks", raw.uv)
        problems: list[SequenceProblem] = raw.problems(num_frames, size)
        for problem in problems:
            self.findings.add_error("tracks", problem)
        if problems:
            return
        tracks = raw.to_tracks(num_frames, size)
        outside = int(raw.outside(size).sum())
        if outside:
            self.findings.add(
                "warning",
                "tracks",
                f"{path}: {outside} visible observations lie outside the image and are taken as not visible",
                "check that the tracks were made on images of this size, as (x, y)",
            )
        chosen = self.selection.indices(num_frames)
        seen = tracks.visible[:, chosen].any(axis=0)
        if not seen.any():
            self.findings.add(
                "warning",
                "tracks",
                f"{path}: no track is visible anywhere",
                "run the tracker again, or remove the file",
            )
            return
        unseen = chosen[~seen].tolist()
        if unseen:
            self.findings.add(
                "warning",
                "tracks",
                f"{path}: no track is visible in frame(s) {some_of(unseen)}",
                "start tracks in these frames too",
            )

    def _array(self, item: str, load: Callable[[Path], FloatArray], path: Path) -> FloatArray | None:
        values = self.findings.attempt(item, lambda: load(path))
        if values is not None:
            self.findings.add_array(item, values, count=1 if values.shape == (4,) else None)
        return values

    def _other_truth(self, num_frames: int, size: tuple[int, int]) -> None:
        path = self.files.ground_truth
        if path is not None:
            num_tracks = self.num_tracks
            found = self.findings.attempt(
                "ground truth", lambda: assemble.load_ground_truth(path, num_tracks, num_frames)
            )
            if found is not None:
                named = {
                    "true intrinsics": found.intrinsics,
                    "true track points": found.track_points,
                    "true object poses": found.world_T_object,
                }
                for name, array in named.items():
                    if array is not None:
                        self.findings.add_array(name, array)
        truth = self.files.true_intrinsics
        if truth is not None and truth != self.files.intrinsics:
            try:
                self.findings.add_array("true intrinsics", load_intrinsics(truth, num_frames, size))
            except VaryingIntrinsics as error:
                self.findings.add("warning", "true intrinsics", error.what, "they are not used as truth")
            except InputError as error:
                self.findings.add_error("true intrinsics", error)


def _open_images(path: Path, stop: int | None) -> ImageFolder | VideoFrames:
    """Open the images even if the first of them is broken: the size is that of the first readable one."""
    if not path.is_dir():
        return VideoFrames(path, stop)
    paths = list_frames(path, IMAGE_SUFFIXES)
    for file in paths:
        try:
            return ImageFolder(paths, ImageFolder((file,)).size)
        except InputError:
            continue
    return ImageFolder(paths, (0, 0))
