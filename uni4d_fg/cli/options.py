"""Arguments and options that several verbs share."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class LayoutChoice(str, Enum):
    """Folder layouts that can be read."""

    auto = "auto"
    native = "native"
    uni4d = "uni4d"


class SolverChoice(str, Enum):
    """Minimisers of the stages."""

    lm = "lm"
    adam = "adam"


SequenceFolder = Annotated[Path, typer.Argument(metavar="SEQ", help="Folder of the sequence.", show_default=False)]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)]
Layout = Annotated[LayoutChoice, typer.Option(help="Layout of the sequence; 'auto' looks at what is there.")]
Depth = Annotated[
    str | None, typer.Option(help="Name of the depth cue, where the sequence has several.", show_default=False)
]
Masks = Annotated[str | None, typer.Option(help="Mask folder (Uni4D's layout).", show_default=False)]
Tracks = Annotated[str | None, typer.Option(help="Track folder (Uni4D's layout).", show_default=False)]
DepthScale = Annotated[float, typer.Option(help="Units per metre of true depth in PNGs (Uni4D's layout).")]
KnownIntrinsics = Annotated[
    bool, typer.Option("--known-intrinsics", help="Take K.npy instead of the estimate (Uni4D's layout).")
]
ConfigChoice = Annotated[
    str | None, typer.Option("--config", help="Preset or YAML file.", metavar="PRESET|FILE", show_default=False)
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="Change one field; may be repeated.", show_default=False),
]
Solver = Annotated[SolverChoice | None, typer.Option(help="Minimiser; short for --set solver=...", show_default=False)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue a run; finished stages are kept.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
