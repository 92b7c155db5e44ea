"""What an exporter is given, and what it says at the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from uni4d_fg.errors import Cancelled
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.results.run import Run


@dataclass(frozen=True)
class ExportOptions:
    """Choices that some formats offer; a format to which one means nothing ignores it."""

    masks: bool = True
    """colmap, nerfstudio, gsplat: hide what moves (where the sequence has any masks)."""
    depth: bool = False
    """colmap, nerfstudio, gsplat: write the dense depth."""
    normals: bool = False
    """nerfstudio: write normals of the dense depth; the images are undistorted."""
    text: bool = True
    """colmap, gsplat: write the model as text beside the binary one."""
    trajectories: bool = False
    """ply: write the trajectories of moving points and the camera path as line sets."""
    undistort: bool = False
    """Write frames, masks, depth and observations as a pinhole would see them; formats without lenses always do."""
    trail: int = 10
    """rrd: frames of the past that a trajectory shows."""


@dataclass(frozen=True)
class ExportReport:
    """One finished export."""

    format: str
    folder: Path
    facts: tuple[str, ...]
    """What was written, one line each."""
    figures: dict[str, float] = field(default_factory=dict)
    """Numbers for programs: counts, errors in px."""
    warnings: tuple[str, ...] = ()


@dataclass
class ExportJob:
    """One export in progress: where to read, where to write, and how to tell."""

    run: Run
    folder: Path
    """Exists, is empty, and is moved to its final place when the exporter returns."""
    options: ExportOptions = field(default_factory=ExportOptions)
    reporter: Reporter = field(default_factory=SilentReporter)
    should_stop: Callable[[], bool] = lambda: False
    facts: list[str] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def check(self) -> None:
        """Raise Cancelled if the user asked to stop; nothing is left then."""
        if self.should_stop():
            raise Cancelled("stopped; the export was not written")

    def advance(self, done: int) -> None:
        """Report ``done`` frames; checks as well."""
        self.check()
        self.reporter.advance(done)


@dataclass(frozen=True)
class Exporter:
    """One format."""

    write: Callable[[ExportJob], None]
    """Write everything into the job's folder, and note facts."""
    needs_images: bool = False
    """The frames of the sequence must be readable."""
    has_lens: bool = False
    """Whether the format can say how the images are distorted, or has no images."""
    require: Callable[[], object] = lambda: None
    """Raise MissingDependencyError if a package is missing; called before anything is written."""
