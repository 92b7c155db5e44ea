"""``summary.json`` as it is read: of the right types, whoever wrote it, before a page or a number is made of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from uni4d_fg.errors import InputError
from uni4d_fg.reading import read_json

_MAX_BYTES = 256 * 1024**2

Count = Annotated[int, Field(ge=0, le=2**53)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Part(BaseModel):
    """Fields that are not named may be there, and are passed on as they are."""

    model_config = ConfigDict(extra="allow")


class _Solve(_Part):
    name: str = ""
    termination: str = ""
    initial_energy: Number | None = None
    final_energy: Number | None = None
    initial_energies: dict[str, Number | None] = {}
    final_energies: dict[str, Number | None] = {}
    num_iterations: Count = 0
    num_factors: Count = 0
    num_variables: Count = 0
    energy_curve: list[Annotated[list[Number], Field(min_length=2, max_length=2)]] = []
    notes: dict[str, Any] = {}

    @field_validator("energy_curve", mode="before")
    @classmethod
    def _known(cls, curve: Any) -> Any:
        """Leave out points whose energy was not finite, which JSON writes as null."""
        if not isinstance(curve, list):
            return [] if curve is None else curve
        return [point for point in curve if not (isinstance(point, list) and len(point) == 2 and point[1] is None)]


class _Stage(_Part):
    seconds: Number | dict[str, Number] = 0.0
    peak_memory_mb: Number = 0.0
    resumed: bool = False
    solves: list[_Solve] = []
    facts: list[str] = []
    warnings: list[str] = []
    dropped: dict[str, Count] = {}
    counts: dict[str, Count] = {}
    tracks: dict[str, Count] = {}


class _Rival(_Part):
    first: Count = 0
    second: Count = 0
    degrees: Number | None = None
    degrees_per_frame: Number | None = None
    unexplained: Number | None = None


class _Start(_Part):
    """What motion alone left open; numbers that were not finite are null."""

    focal_px: Positive | None = None
    focal_interval_px: Annotated[list[Positive | None], Field(min_length=2, max_length=2)] = [None, None]
    focal_is_open: Annotated[list[bool], Field(min_length=2, max_length=2)] = [False, False]
    stretch_along_view: Annotated[list[Number | None], Field(min_length=2, max_length=2)] = [None, None]
    parallax_px: Number | None = None
    noise_px: Number | None = None
    unexplained: Number | None = None
    starts: list[_Rival] = []


class _Cues(_Part):
    sources: dict[str, str] = {}
    facts: list[str] = []
    warnings: list[str] = []
    metric: bool = True
    seconds: Number = 0.0
    start: _Start = _Start()


class _Sequence(_Part):
    name: str | None = None
    root: str | None = None


class _Summary(_Part):
    sequence: _Sequence = _Sequence()
    solver: dict[str, Any] = {}
    cues: _Cues = _Cues()
    stages: dict[str, _Stage] = {}
    warnings: list[str] = []
    versions: dict[str, str] = {}


def read_summary(path: Path) -> dict[str, Any]:
    """Return the content of ``summary.json``; what is there has the types that it is written with.

    Raises:
        InputError: If it cannot be read, or a field has another type.
    """
    remedy = "run the reconstruction again"
    try:
        value = read_json(path, _MAX_BYTES)
    except InputError as error:
        raise InputError(f"{error} ({remedy})") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: holds no summary of a run; {remedy}")
    try:
        return _Summary.model_validate(value, strict=False).model_dump(exclude_unset=True, warnings=False)
    except (ValidationError, RecursionError, OverflowError, ValueError) as error:
        what = str(error)
        if isinstance(error, ValidationError):
            detail = error.errors(include_url=False)[0]
            what = f"{'.'.join(map(str, detail['loc']))}: {detail['msg']}"
        raise InputError(f"{path}: is not what a run writes ({what}); {remedy}") from error
