"""``shots.json``: the shots of a run that was split, each a run of its own in ``shots/000``, ``shots/001``, ..."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import atomic_write_json
from uni4d_fg.reading import is_present, read_json
from uni4d_fg.results.run_contents import Remedies

SHOT_LIST = "shots.json"
SHOT_FOLDER = "shots"
_MAX_BYTES = 16 * 1024**2


@dataclass(frozen=True)
class Shot:
    """One shot of a video, and what became of it."""

    folder: str | None
    """Of its run, relative to that of the whole; None where it was left out."""
    start: int
    """First frame, counted from the start of the video file or folder, as ``--start`` does."""
    stop: int
    """First frame behind it."""
    num_frames: int
    """Frames that are used."""
    exit_code: int | None = None
    """Of its reconstruction: 0 when all went well; None as long as it was not tried, or where it was left out."""
    message: str = ""
    """Why it was left out or failed."""
    ate_m: float | None = None
    """Absolute trajectory error after Sim(3), meters, where the truth is known."""

    def line(self) -> str:
        """Return one line of text."""
        text = f"{self.folder or 'left out'}: frames {self.start} to {self.stop - 1} ({self.num_frames})"
        if self.ate_m is not None:
            text += f", ATE {1e3 * self.ate_m:.1f} mm"
        return f"{text}, {self.message}" if self.message else text


def is_split(run: Path) -> bool:
    """Tell whether a folder is that of a run in several shots."""
    return is_present(run / SHOT_LIST)


def check_same_split(run: Path, split: bool, *, resume: bool, remedies: Remedies) -> None:
    """Raise OutputError if a run is to be continued in another form than it was begun."""
    if resume and is_split(run) != split and (is_split(run) or (run / "stages").is_dir()):
        was, now = ("several shots", "one") if is_split(run) else ("one shot", "several")
        raise OutputError(
            f"{run}: holds a run in {was}, and this one is in {now}; continue it with the same options, or replace it "
            f"with {remedies.overwrite}"
        )


def write_shots(run: Path, shots: list[Shot]) -> None:
    """Write ``shots.json``. Raises OutputError."""
    atomic_write_json(run / SHOT_LIST, {"shots": [asdict(shot) for shot in shots]})


def read_shots(run: Path) -> list[Shot]:
    """Read ``shots.json``.

    Raises:
        InputError: If it cannot be read, or names a folder elsewhere.
    """
    path = run / SHOT_LIST
    value = read_json(path, _MAX_BYTES)
    try:
        shots = TypeAdapter(list[Shot]).validate_python(value["shots"] if isinstance(value, dict) else None)
    except (ValidationError, RecursionError, KeyError) as error:
        raise InputError(f"{path}: is no list of shots; run the reconstruction again with --resume") from error
    if any(shot.folder is not None and shot.folder != shot_folder(i) for i, shot in enumerate(shots)):
        raise InputError(f"{path}: names folders that are not of its shots; run the reconstruction again")
    return shots


def shot_folder(index: int) -> str:
    """Return the folder of one shot, relative to that of the whole run."""
    return f"{SHOT_FOLDER}/{index:03d}"


def finished_shots(run: Path) -> list[Path]:
    """Return the folders of the shots that were reconstructed. Raises InputError if there are none."""
    folders = [run / shot.folder for shot in read_shots(run) if shot.folder is not None and shot.exit_code == 0]
    if not folders:
        raise InputError(f"{run}: none of its shots was reconstructed; see {run / SHOT_LIST}")
    return folders


def refuse_split(run: Path) -> None:
    """Raise InputError with a list of its shots if a run is one of several."""
    if is_split(run):
        shots = "; ".join(shot.line() for shot in read_shots(run))
        raise InputError(f"{run}: is a run in several shots; give the folder of one of them ({shots})")
