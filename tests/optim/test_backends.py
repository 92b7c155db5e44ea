"""Every backend solves the same stages to the same result, and the choice between them is settled plainly."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.errors import MissingDependencyError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.optim import extension
from uni4d_fg.optim.backend import choose_backend
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.optim.runners import solver_facts, solver_settings
from uni4d_fg.pipeline import reconstruct

WITHOUT_VIEWS = ["output.clouds=false", "output.pictures=false"]
_STRUCTURE = "bundle_adjustment.structure_solver"
CONVERGED = [
    *(
        f"{solver}.{setting}"
        for solver in ("camera_init.solver", "bundle_adjustment.solver", _STRUCTURE, "nonrigid.solver")
        for setting in ("relative_decrease=1e-9", "max_iterations=300")
    ),
    f"{_STRUCTURE}.early_relative_decrease=1e-9",
]
"""Solves that end at the minimum: the backends reach it on different ways, so that early stops end elsewhere."""
ENERGY_TOLERANCE = {"cpp": 1e-8, "gtsam": 1e-4}
"""On another way a landmark may end in another minimum of its depth kernel."""
CENTER_TOLERANCE_M = {"cpp": 1e-7, "gtsam": 1e-7}
INTRINSICS_TOLERANCE = {"cpp": 1e-7, "gtsam": 1e-7}

needs_extension = pytest.mark.skipif(find_extension()[0] is None, reason=find_extension()[1] or "installed")


@pytest.fixture(scope="module")
def small_scene() -> Sequence:
    scene = SyntheticSceneConfig(render_images=False, num_frames=5, grid_columns=9, grid_rows=7, width=160, height=120)
    return make_synthetic_sequence(scene)


@pytest.fixture(scope="module")
def reference(small_scene: Sequence, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:  # type: ignore[type-arg]
    return run(small_scene, tmp_path_factory.mktemp("python") / "run", "python")


def run(sequence: Sequence, folder: Path, backend: str) -> tuple[Path, dict]:  # type: ignore[type-arg]
    summary = reconstruct(sequence, folder, load_config("default", [f"backend={backend}", *WITHOUT_VIEWS, *CONVERGED]))
    return folder, summary.to_dict()


def stage_arrays(folder: Path, stage: str) -> dict[str, np.ndarray]:
    with np.load(next((folder / "stages").glob(f"{stage}*.npz"))) as stored:
        return dict(stored)


@pytest.mark.parametrize("backend", [pytest.param("cpp", marks=needs_extension), "gtsam"])
def test_same_reconstruction_from_every_backend(
    backend: str,
    small_scene: Sequence,
    reference: tuple[Path, dict],  # type: ignore[type-arg]
    tmp_path: Path,
) -> None:
    folder, summary = run(small_scene, tmp_path / "run", backend)
    assert summary["solver"]["backend"] == backend
    expected_folder, expected = reference
    for stage in ("camera_init", "bundle_adjustment", "nonrigid"):
        solves = summary["stages"][stage]["solves"]
        assert {solve["notes"]["backend"] for solve in solves if "backend" in solve["notes"]} == {backend}
        for solve, other in zip(solves, expected["stages"][stage]["solves"], strict=True):
            assert solve["final_energy"] == pytest.approx(other["final_energy"], rel=ENERGY_TOLERANCE[backend])
    ours = stage_arrays(folder, "bundle_adjustment")
    theirs = stage_arrays(expected_folder, "bundle_adjustment")
    np.testing.assert_allclose(
        ours["world_T_cam"][:, :3, 3], theirs["world_T_cam"][:, :3, 3], atol=CENTER_TOLERANCE_M[backend]
    )
    np.testing.assert_allclose(ours["intrinsics"], theirs["intrinsics"], rtol=INTRINSICS_TOLERANCE[backend])


@needs_extension
def test_the_extension_solves_every_stage(small_scene: Sequence, tmp_path: Path) -> None:
    _, summary = run(small_scene, tmp_path / "run", "auto")
    solves = [solve for stage in summary["stages"].values() for solve in stage.get("solves", [])]
    used: dict[str, dict[str, set[str]]] = {}
    for solve in solves:
        for part in solve["notes"]["solved_by"]:
            assert part["why"] == ""
            of_kind = used.setdefault(solve["name"].partition("[")[0], {})
            of_kind.setdefault(part["by"], set()).update(part["terms"])
    motion = {"camera_angular_acceleration", "camera_linear_acceleration"}
    cameras = motion | {"intrinsics_prior", "aspect_prior", "log_scale_prior"}
    assert used == {
        "camera_init": {"C++ frame pairs": {"depth_reprojection"}},
        "lens": {
            "C++ landmark elimination": {"static_reprojection", "depth_prior"},
            "linearized blocks in the C++ landmark elimination": {"static_reprojection"},
            "NumPy, on what is not eliminated": cameras | {"zoom_smoothness"},
        },
        "bundle_adjustment": {
            "C++ landmark elimination": {"static_reprojection", "depth_prior"},
            "NumPy, on what is not eliminated": cameras,
        },
        "structure": {
            "C++ landmark elimination": {"static_reprojection", "depth_prior"},
            "NumPy, on what is not eliminated": {"log_scale_prior"},
        },
        "nonrigid": {"C++ trajectories": {"dynamic_reprojection", "depth_prior", "smoothness", "arap"}},
    }


@pytest.fixture
def no_extension(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(sys.modules, "uni4d_fg_cpp", None)
    find_extension.cache_clear()
    yield
    monkeypatch.undo()
    find_extension.cache_clear()


@pytest.mark.usefixtures("no_extension")
def test_without_the_extension(small_scene: Sequence, tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match=r"not installed: run `pip install \./cpp_factors`"):
        choose_backend("cpp")
    backend = choose_backend("auto")
    assert backend.name == "python"
    assert "a faster path exists: run `pip install ./cpp_factors`" in backend.hint
    summary = reconstruct(small_scene, tmp_path / "run", load_config("fast", WITHOUT_VIEWS))
    assert sum("a faster path exists" in line for line in summary.lines()) == 1
    assert summary.to_dict()["solver"]["backend"] == "python"
    said = "depth from several views is left out, as the C++ extension uni4d-fg-cpp is not installed: run `pip install"
    assert said in str(summary.to_dict())
    with pytest.raises(MissingDependencyError):
        reconstruct(small_scene, tmp_path / "other", load_config("fast", ["backend=cpp"]))


def test_an_extension_of_another_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other:
        ABI = extension.REQUIRED_ABI + 1

    monkeypatch.setattr(extension.importlib, "import_module", lambda name: Other)
    core, reason = extension.find_extension.__wrapped__()
    assert core is None
    assert reason.startswith(f"the installed C++ extension has interface {Other.ABI}, ")
    assert reason.endswith(f"needs {extension.REQUIRED_ABI}")


def test_the_backend_is_part_of_what_a_stored_stage_depends_on() -> None:
    config = load_config("default", ["backend=python"])
    assert solver_settings(config) == ("lm", "python")
    assert solver_settings(config.model_copy(update={"backend": "gtsam"})) == ("lm", "gtsam")
    assert solver_facts(config) == {"solver": "lm", "backend": "python"}
    adam = config.model_copy(update={"solver": "adam"})
    assert solver_facts(adam) == {"solver": "adam"}
    assert solver_settings(adam)[0] == "adam"
