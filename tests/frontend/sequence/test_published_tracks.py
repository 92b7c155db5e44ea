"""Track files in the forms in which CoTracker, TAPIR and BootsTAPIR save them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.errors import InputError
from uni4d_fg.files import save_npz
from uni4d_fg.frontend.sequence.track_files import load_native_tracks, load_track_file

K, T = 5, 7
SIZE = (60, 80)
rng = np.random.default_rng(0)
UV = rng.uniform([0, 0], [79, 59], (K, T, 2))
SEEN = rng.random((K, T)) > 0.3
LOGIT = np.where(SEEN, -4.0, 4.0)  # of occlusion

FORMS: dict[str, dict[str, Any]] = {
    "cotracker": {"pred_tracks": UV.swapaxes(0, 1)[None], "pred_visibility": SEEN.T[None]},
    "cotracker2_old": {"pred_tracks": UV.swapaxes(0, 1)[None], "pred_visibility": SEEN.T[None, ..., None]},
    "cotracker3_probabilities": {
        "pred_tracks": UV.swapaxes(0, 1), "pred_visibility": np.where(SEEN, 0.9, 0.1).T,
        "pred_confidence": np.full((T, K), 0.8),
    },
    "cotracker_short_names": {"tracks": UV.swapaxes(0, 1), "visibility": SEEN.T},
    "tapir": {"tracks": UV, "visibles": SEEN},
    "tapvid": {"tracks": UV, "occluded": ~SEEN},
    "tapir_logits": {"tracks": UV[None], "occlusion": LOGIT[None], "expected_dist": np.full((1, K, T), -4.0)},
    "bootstapir": {
        "tracks": UV, "occlusions": LOGIT, "expected_dist": np.full((K, T), -4.0),
        "query_points": np.stack([np.arange(K), np.ones(K), np.ones(K)], axis=1),
    },
    "uni4d": {"all_tracks": UV.swapaxes(0, 1), "all_visibilities": SEEN.T},
    "native": {"uv": UV, "visible": SEEN, "query_frame": np.arange(K)},
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_tracks(tmp_path: Path, form: str) -> None:
    path = tmp_path / "t.npz"
    save_npz(path, **FORMS[form])
    tracks = load_track_file(path, T).to_tracks(T, SIZE)
    np.testing.assert_array_equal(tracks.visible, SEEN)
    np.testing.assert_allclose(tracks.uv[SEEN], UV[SEEN], rtol=1e-6)
    assert np.isnan(tracks.uv[~SEEN]).all()
    if form in ("bootstapir", "native"):
        assert tracks.query_frame.tolist() == list(range(K))
    if form == "cotracker3_probabilities":
        assert tracks.confidence is not None
        np.testing.assert_allclose(tracks.confidence, 0.8, rtol=1e-6)
    if form != "uni4d":
        np.testing.assert_array_equal(load_native_tracks(path).to_tracks(T, SIZE).visible, SEEN)


def test_an_uncertain_position_is_not_seen(tmp_path: Path) -> None:
    save_npz(tmp_path / "t.npz", tracks=UV, occlusion=np.full((K, T), -4.0), expected_dist=np.where(SEEN, -4.0, 4.0))
    np.testing.assert_array_equal(load_track_file(tmp_path / "t.npz", T).visible, SEEN)


def test_the_length_of_the_video_settles_the_axes(tmp_path: Path) -> None:
    save_npz(tmp_path / "t.npz", tracks=UV.swapaxes(0, 1), visibles=SEEN.T)
    tracks = load_track_file(tmp_path / "t.npz", T).to_tracks(T, SIZE)
    np.testing.assert_array_equal(tracks.visible, SEEN)


def test_positions_of_another_image_size_are_refused(tmp_path: Path) -> None:
    save_npz(tmp_path / "t.npz", tracks=UV, visibles=SEEN, image_size=np.array([256, 256]))
    with pytest.raises(InputError, match="256 x 256"):
        load_track_file(tmp_path / "t.npz", T).to_tracks(T, SIZE)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"points": UV}, "holds points; needed are uv, visible"),
        ({"tracks": UV}, "holds tracks"),
        ({"tracks": UV[..., :1], "visibles": SEEN}, "save positions"),
        ({"tracks": UV, "visibles": SEEN[:2]}, "there are positions"),
        ({"pred_tracks": np.stack([UV, UV]), "pred_visibility": SEEN}, "2 videos"),
        ({"tracks": UV, "visibles": SEEN, "query_points": np.zeros((2, 3))}, "one query for each of 5"),
        ({"tracks": UV, "visibles": SEEN, "image_size": np.array([3])}, "height, width"),
        ({"tracks": np.full((2, 2), "a"), "visibles": SEEN}, "instead of numbers"),
    ],
)
def test_what_does_not_fit_is_one_error(tmp_path: Path, arrays: dict[str, Any], said: str) -> None:
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(InputError, match=said):
        load_track_file(tmp_path / "t.npz", T)


NAMES = st.sampled_from(
    ["pred_tracks", "tracks", "pred_visibility", "visibles", "occlusion", "expected_dist", "queries"]
)
SHAPES = st.lists(st.integers(0, 3), max_size=4).map(tuple)


@given(st.dictionaries(NAMES, SHAPES, max_size=4))
@settings(max_examples=80, deadline=None)
def test_no_shape_breaks_the_reader(
    tmp_path_factory: pytest.TempPathFactory, shapes: dict[str, tuple[int, ...]]
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.npz"
    np.savez(path, **{name: np.zeros(shape) for name, shape in shapes.items()})
    try:
        load_track_file(path, 2).to_tracks(2, SIZE)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017 - it need not fail
