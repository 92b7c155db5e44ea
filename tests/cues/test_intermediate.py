"""What is removed of the cues at the end of a run, and what never is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from uni4d_fg.cues.intermediate import drop_intermediate
from uni4d_fg.errors import InputError

FIRST, LAST, MASKS = f"depth/motion-{'1' * 20}", f"depth/motion-{'2' * 20}", f"masks/motion-{'3' * 20}"


@pytest.fixture
def cues(tmp_path: Path) -> Path:
    for name in (
        f"{FIRST}/000000.map.npz", f"{FIRST}/start.npz", f"{LAST}/000000.map.npz", f"{LAST}/start.npz",
        f"{MASKS}/000000.png", "depth/unidepth-0123/aa.map.npz", "tracks.npz",
    ):  # fmt: skip
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x" * 10)
    manifest = {
        "num_frames": 1, "image_size": [60, 80], "depth": [f"{LAST}/000000.map.npz"], "masks": [f"{MASKS}/000000.png"],
        "static": False, "tracks": "tracks.npz", "intrinsics": [75.0, 75.0, 39.5, 29.5], "initial_world_T_cam": None,
        "report": {},
    }  # fmt: skip
    (tmp_path / "cues.json").write_text(json.dumps(manifest))
    return tmp_path


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_only_what_led_to_the_cues_goes(cues: Path) -> None:
    before = files(cues)
    assert drop_intermediate(cues) == 20
    assert before - files(cues) == {f"{FIRST}/000000.map.npz", f"{FIRST}/start.npz"}
    assert not (cues / FIRST).exists()
    assert drop_intermediate(cues) == 0


def test_files_and_folders_of_others_stay(cues: Path, tmp_path: Path) -> None:
    (cues / FIRST / "notes.txt").write_text("mine")
    (cues / "depth" / "motion-mine").mkdir()
    (cues / "depth" / "motion-mine" / "000000.map.npz").write_text("mine")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "000000.map.npz").write_text("mine")
    (cues / "depth" / f"motion-{'4' * 20}").symlink_to(elsewhere)
    drop_intermediate(cues)
    assert {f"{FIRST}/notes.txt", "depth/motion-mine/000000.map.npz", "elsewhere/000000.map.npz"} <= files(cues)


def test_without_a_manifest_nothing_goes(cues: Path) -> None:
    (cues / "cues.json").unlink()
    before = files(cues)
    assert drop_intermediate(cues) == 0
    assert files(cues) == before


def test_a_damaged_manifest_is_one_clear_error(cues: Path) -> None:
    (cues / "cues.json").write_text("{}")
    with pytest.raises(InputError, match="--resume"):
        drop_intermediate(cues)
