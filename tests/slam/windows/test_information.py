"""What windows tell the join: with and without what covariances are made of; and their records."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.factors.variable_types import INTRINSICS, LOG_SCALE, POSE
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.store import StageStore
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.slam.windows import scene
from uni4d_fg.slam.windows.information import FRAME, SHARED
from uni4d_fg.slam.windows.plan import Window, windows_of
from uni4d_fg.slam.windows.scene import WindowScene, information

FRAMES = 24


def settings(*overrides: str) -> Config:
    windows = ["windows.frames=12", "windows.overlap=4", "output.clouds=false", "output.pictures=false"]
    return load_config("default", [*windows, *overrides])


def video() -> Sequence:
    return make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=FRAMES, height=120, width=160, focal=150.0, margin_px=3.0, grid_columns=16, grid_rows=12,
            render_images=False,
        )
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("windows")
    reconstruct(video(), folder, settings())
    return folder


@pytest.fixture(scope="module")
def window(folder: Path) -> WindowScene:
    record = StageStore(folder / "stages" / "windows").load("scene_000000")
    assert record is not None
    return WindowScene.of_arrays(Window(0, 12), record.arrays)


def test_a_round_without_covariances_has_the_same_information(window: WindowScene) -> None:
    windows = windows_of(settings(), FRAMES)
    whole = information(window, windows, 0, settings())
    bare = information(window, windows, 0, settings(), uncertain=False)
    assert bare.uncertainty is None
    np.testing.assert_array_equal(bare.hessian, whole.hessian)
    np.testing.assert_array_equal(bare.gradient, whole.gradient)
    size = FRAME * 12 + SHARED
    assert whole.uncertainty is not None
    assert whole.uncertainty.spread is not None
    assert whole.uncertainty.curvature.shape == whole.uncertainty.spread.rest.shape == (size, size)


def test_columns_are_placed_as_a_product_by_their_selection_does(
    window: WindowScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    reduce = scene.reduced_hessian
    monkeypatch.setattr(scene, "reduced_hessian", lambda *given: made.append(reduce(*given)) or made[-1])
    found = information(window, windows_of(settings(), FRAMES), 0, settings())
    layout, hessian, gradient = made[0]
    onto = np.zeros((layout.size, FRAME * 12 + SHARED))
    for group, start in ((POSE, 0), (LOG_SCALE, 6), (INTRINSICS, FRAME * 12)):
        for row in range(layout.count[group]):
            for column in range(group.dim):
                place = start + column + (0 if group is INTRINSICS else FRAME * row)
                mine = layout.columns(group, np.array(row))[column]
                onto[mine, place] = layout.free[mine]
    np.testing.assert_array_equal(found.hessian, onto.T @ hessian @ onto)
    np.testing.assert_array_equal(found.gradient, onto.T @ gradient)
    assert found.uncertainty is not None
    np.testing.assert_array_equal(found.uncertainty.curvature, onto.T @ made[1][1] @ onto)
    assert not found.hessian[:6].any()
    assert np.diag(found.hessian)[6:13].all()


def test_records_keep_observations_to_the_last_bit(folder: Path, window: WindowScene) -> None:
    arrays = window.arrays()
    assert arrays["uv"].dtype == arrays["depth"].dtype == np.float32
    again = WindowScene.of_arrays(window.window, arrays)
    np.testing.assert_array_equal(again.observations.uv, window.observations.uv)
    np.testing.assert_array_equal(again.observations.depth, window.observations.depth)
    assert again.observations.uv.dtype == np.float64
    finer = replace(window, observations=replace(window.observations, uv=window.observations.uv + 1e-9))
    assert finer.arrays()["uv"].dtype == np.float64


def test_some_arrays_of_a_record_can_be_read_alone(folder: Path) -> None:
    store = StageStore(folder / "stages" / "windows")
    whole, some = store.load("scene_000000"), store.load("scene_000000", arrays=("log_scale",))
    assert whole is not None
    assert some is not None
    assert list(some.arrays) == ["log_scale"]
    np.testing.assert_array_equal(some.arrays["log_scale"], whole.arrays["log_scale"])
    assert some.summary == whole.summary


@pytest.mark.parametrize("rounds", [1, 3])
def test_covariances_come_from_the_last_round_whichever_that_is(tmp_path: Path, folder: Path, rounds: int) -> None:
    reconstruct(video(), tmp_path, settings(f"windows.rounds={rounds}"))
    found, two = (load_reconstruction(path / "reconstruction.npz") for path in (tmp_path, folder))
    sigma, usual = (np.sqrt(np.trace(one.pose_covariance[1:], axis1=1, axis2=2)) for one in (found, two))
    assert np.isfinite(sigma).all()
    np.testing.assert_allclose(sigma, usual, rtol=0.1)
