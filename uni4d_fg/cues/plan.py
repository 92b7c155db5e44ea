"""Where every cue of a video comes from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from uni4d_fg.cues.card import CardKind, find_model
from uni4d_fg.cues.session import weights_hash
from uni4d_fg.frontend.sequence.assemble import check_count, open_depth
from uni4d_fg.frontend.sequence.calibration_files import load_calibration
from uni4d_fg.frontend.sequence.model import Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.track_files import load_track_file
from uni4d_fg.optional import import_onnxruntime
from uni4d_fg.reading import check_regular, is_present

DepthSource = Literal["given", "card", "geometry"]
MaskSource = Literal["given", "card", "motion", "none"]
TrackSource = Literal["given", "card", "built_in"]

GUESSED = "guessed from the image size"
"""What :attr:`CueReport.sources` says of intrinsics that nobody gave and no motion told."""


@dataclass(frozen=True)
class CueFiles:
    """Cues in files of their own, beside those that the video brings and in their place."""

    depth: Path | None = None
    """Folder of depth maps, or one ``.npy`` file, as in the native layout."""
    masks: Path | None = None
    """Masks in any form that :mod:`uni4d_fg.cues.mask_files` knows."""
    tracks: Path | None = None
    """``.npz`` file of tracks in any of the known forms."""
    intrinsics: Path | None = None
    """Calibration in any form that :mod:`uni4d_fg.frontend.sequence.calibration_files` knows."""
    classes: tuple[str, ...] | None = None
    """Of ``masks``: names of the classes that may move."""

    def attach(self, video: Video) -> Video:
        """Return the video, whole and in its own size, with these cues.

        Raises:
            InputError: If a file cannot be read or does not fit the video.
        """
        count, size = video.num_frames, video.image_size
        changes: dict[str, Any] = {}
        if self.depth is not None:
            _check_exists(self.depth)
            depths = open_depth(self.depth, size)
            check_count(self.depth, len(depths), count)
            depths[0]
            # What the video's own depth was says nothing of this one, and cameras in its unit do not fit it.
            changes |= {"depths": depths, "depth_is_metric": True, "depth_parallax": None}
            if not video.depth_is_metric:
                changes["initial_world_T_cam"] = None
        if self.masks is not None:
            from uni4d_fg.cues.mask_files import open_mask_files  # takes a second to load

            changes["masks"] = open_mask_files(
                self.masks, size, count, video.frame_names, images=video.images, classes=self.classes
            )
            changes["masks_from_motion"] = False
        if self.tracks is not None:
            changes["tracks"] = load_track_file(self.tracks, count).to_tracks(count, size)
        if self.intrinsics is not None:
            calibration = load_calibration(self.intrinsics, count, size)
            changes |= {
                "intrinsics": calibration.intrinsics, "lens": calibration.lens, "zoom": None, "focal_sigma": None
            }  # fmt: skip
        return replace(video, **changes)

    def __bool__(self) -> bool:
        return any((self.depth, self.masks, self.tracks, self.intrinsics))


@dataclass(frozen=True)
class CuePlan:
    """Where depth, masks and tracks come from; intrinsics are given, or from the depth, or guessed."""

    depth: DepthSource = "given"
    depth_model: str | None = None
    """Card of ``depth: card``: ``CARD`` or ``CARD=FILE``."""
    masks: MaskSource = "given"
    mask_model: str | None = None
    """Card of ``masks: card``."""
    classes: tuple[str, ...] | None = None
    """Classes that may move, of ``masks: card``; None leaves it to the card."""
    tracks: TrackSource = "built_in"
    track_model: str | None = None
    """Card of ``tracks: card``."""
    keep_built_in_tracks: bool = False
    """Make the tracks of the built-in tracker even where only a later stage needs them."""

    @property
    def is_given(self) -> bool:
        """Whether nothing is to be made."""
        return (
            self.depth == "given"
            and self.masks in ("given", "none")
            and self.tracks in ("given", "built_in")
            and not self.keep_built_in_tracks
        )

    def check(self) -> None:
        """Make sure that cards are right and their ONNX files there, before anything is begun.

        Raises:
            ConfigError: If a card is wrong.
            InputError: If an ONNX file is missing or not the one that its card names.
            MissingDependencyError: If ONNX Runtime is needed and not installed.
        """
        chosen: list[tuple[str | None, CardKind]] = [
            (self.depth_model, "depth"), (self.mask_model, "segmentation"), (self.track_model, "tracks")
        ]  # fmt: skip
        for model, kind in chosen:
            if model is not None:
                import_onnxruntime()
                weights_hash(find_model(model, kind))


def plan_cues(
    video: Video,
    *,
    bare: bool,
    depth_model: str | None = None,
    masks: str | None = None,
    mask_model: str | None = None,
    classes: tuple[str, ...] | None = None,
    track_model: str | None = None,
) -> CuePlan:
    """Decide where the cues come from: what is asked for, else what the video brings, else what can be made.

    Args:
        video: With the cues that it brings.
        bare: It is frames only, not a prepared sequence: without masks, things in it are taken to move.
        depth_model: Card of a depth network.
        masks: 'motion' or 'none', where asked for.
        mask_model: Card of a segmenter.
        classes: Classes that may move.
        track_model: Card of a point tracker.
    """
    mask_source: MaskSource
    if masks in ("motion", "none"):
        mask_source = "motion" if masks == "motion" else "none"
    elif mask_model is not None:
        mask_source = "card"
    elif video.masks is not None:
        mask_source = "given"
    else:
        mask_source = "motion" if bare else "none"
    return CuePlan(
        depth="card" if depth_model is not None else "geometry" if video.depths is None else "given",
        depth_model=depth_model,
        masks=mask_source,
        mask_model=mask_model,
        classes=classes,
        tracks="card" if track_model is not None else "built_in" if video.tracks is None else "given",
        track_model=track_model,
    )


@dataclass
class CueReport:
    """What was made, and what to distrust; ends up in the summary of a run."""

    sources: dict[str, str] = field(default_factory=dict)
    """Cue to where it came from, in words."""
    facts: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    metric: bool = True
    """Whether depth is in meters."""
    start: dict[str, Any] = field(default_factory=dict)
    """What camera motion leaves open, see :class:`~uni4d_fg.cues.geometric_depth.GeometricDepth`; empty where depth was
    given."""
    seconds: float = 0.0
    """Time that this call took to make or to find them."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "sources": dict(self.sources),
            "facts": list(self.facts),
            "warnings": list(self.warnings),
            "metric": self.metric,
            "seconds": self.seconds,
            "start": dict(self.start),
        }


def _check_exists(path: Path) -> None:
    if not is_present(path):
        raise SequenceProblem(path, "no such file or folder", "check the path")
    if not path.is_dir():
        check_regular(path, "a folder or a .npy file")
