"""Masks that are missing in some frames, in whole runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import SMALL, make_config, masks_of, with_masks

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import make_synthetic_sequence
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.pipeline import RunSummary, reconstruct
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder

LOST = [4, 9]
SAID = "masks are missing in 2 frames between frames that have them"


@pytest.fixture(scope="module")
def scene() -> Sequence:
    return make_synthetic_sequence(SyntheticSceneConfig(**(SMALL | {"num_frames": 14})))


@pytest.fixture(scope="module")
def broken(scene: Sequence) -> Sequence:
    masks = masks_of(scene).copy()
    masks[LOST] = 0
    return with_masks(scene, masks)


def warned(summary: RunSummary) -> bool:
    return any(SAID in warning for warning in summary.warnings)


def test_missing_masks_are_made_named_and_the_same_when_resumed(broken: Sequence, tmp_path: Path) -> None:
    auto = reconstruct(broken, tmp_path / "auto", make_config())
    assert warned(auto)
    assert any(warning.endswith("(input.repair_masks): 4, 9") for warning in auto.warnings)
    assert auto.stages["tracks"]["repaired_masks"] == LOST
    assert "masks of 2 frames were made from those beside" in auto.stages["tracks"]["facts"]

    again = reconstruct(broken, tmp_path / "auto", make_config(), resume=True)
    assert all(again.stages[name]["resumed"] for name in ("tracks", "bundle_adjustment", "fusion"))
    assert again.warnings == auto.warnings
    assert again.stages["tracks"]["facts"] == auto.stages["tracks"]["facts"]

    off = reconstruct(broken, tmp_path / "auto", make_config("input.repair_masks=false"), resume=True)
    assert not off.stages["tracks"]["resumed"]
    assert not warned(off)
    assert "repaired_masks" not in off.stages["tracks"]


def test_tracks_get_the_labels_of_whole_masks(scene: Sequence, broken: Sequence, tmp_path: Path) -> None:
    config = make_config()
    assert scene.tracks is not None
    reconstruct(broken, tmp_path, config)
    made = load_labels(RunFolder(tmp_path).labels)
    whole, missing = (label_tracks(scene.tracks, s, config.labels, config.input) for s in (scene, broken))
    wrong = {name: np.abs(found.weight - whole.weight)[:, LOST].sum() for name, found in
             (("made", made), ("missing", missing))}  # fmt: skip
    assert wrong["made"] < 0.5 * wrong["missing"]
    assert np.count_nonzero(made.label != whole.label) <= 0.5 * np.count_nonzero(missing.label != whole.label)


def test_sparse_and_sound_masks_are_taken_as_they_are(scene: Sequence, tmp_path: Path) -> None:
    masks = masks_of(scene).copy()
    masks[1::2] = 0
    for name, sequence in (("sparse", with_masks(scene, masks)), ("sound", scene)):
        summary = reconstruct(sequence, tmp_path / name, make_config())
        assert "repaired_masks" not in summary.stages["tracks"]
        assert not any("repair_masks" in warning for warning in summary.warnings)
