"""Presets, files, overrides, and the message of every kind of mistake."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.config import Config
from uni4d_fg.config.describe import describe_fields, field_paths, find_field
from uni4d_fg.config.load import (
    dump_config,
    load_config,
    opened_config,
    preset_names,
    presets_folder,
    with_overrides,
)
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_the_default_preset_is_the_models_defaults() -> None:
    assert load_config() == load_config("default") == Config()


@pytest.mark.parametrize("name", ["default", "fast", "paper"])
def test_presets_are_valid_and_known(name: str) -> None:
    assert name in preset_names()
    assert (presets_folder() / f"{name}.yaml").is_file()
    assert dump_config(load_config(name))


def test_the_paper_preset_has_the_numbers_of_the_reference_program() -> None:
    config = load_config("paper")
    assert (config.energy, config.normalization) == ("paper", "mean")
    assert config.camera_init.window == 5
    assert config.camera_init.max_tracks_per_pair == 0
    for motion in (config.camera_init.camera_motion, config.bundle_adjustment.camera_motion):
        assert (motion.rotation_weight, motion.translation_weight) == (1.0, 1.0)
    assert not config.bundle_adjustment.depth_prior
    assert not config.nonrigid.depth_prior
    assert (config.nonrigid.neighbors, config.nonrigid.smoothness_order) == (4, 1)
    assert (config.nonrigid.smoothness_weight, config.nonrigid.arap_weight) == (10.0, 100.0)
    assert config.nonrigid.annealing[-1] == 1.0
    assert config.labels.min_static_fraction == 0.2
    for kernel in (
        config.camera_init.kernel,
        config.bundle_adjustment.reprojection_kernel,
        config.nonrigid.reprojection_kernel,
        config.nonrigid.smoothness_kernel,
        config.nonrigid.arap_kernel,
    ):
        assert kernel.kind == "norm"


@pytest.mark.parametrize("name", ["default", "fast", "paper"])
def test_a_dumped_configuration_reads_back_the_same(name: str, tmp_path: Path) -> None:
    config = load_config(name, ["camera_init.window=7", "nonrigid.annealing=[8, 1]"])
    path = write(tmp_path / "config.yaml", dump_config(config))
    assert load_config(path) == config
    assert load_config(str(path)) == config
    assert yaml.safe_load(dump_config(config)) == config.model_dump(mode="json")


def test_a_file_holds_only_what_it_changes(tmp_path: Path) -> None:
    path = write(tmp_path / "mine.yaml", "tracking:\n  query_interval: 4\ncamera_init:\n")
    assert load_config(path) == with_overrides(Config(), ["tracking.query_interval=4"])


def test_a_section_keeps_what_its_parent_gave_it(tmp_path: Path) -> None:
    # The solver of camera_init stops after other iterations than the solver section's own default.
    path = write(tmp_path / "mine.yaml", "camera_init: {solver: {max_damping: 1.0e+8}}\n")
    solver = load_config(path).camera_init.solver
    assert solver.max_iterations == Config().camera_init.solver.max_iterations != SolverConfig().max_iterations


def test_a_file_names_its_preset_and_overrides_come_last(tmp_path: Path) -> None:
    path = write(tmp_path / "mine.yaml", "preset: paper\nnonrigid:\n  neighbors: 5\n  arap_weight: 50.0\n")
    config = load_config(path, ["nonrigid.neighbors=6"])
    assert (config.nonrigid.neighbors, config.nonrigid.arap_weight, config.energy) == (6, 50.0, "paper")


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    assert load_config(write(tmp_path / "empty.yaml", "# nothing\n")) == Config()


def test_a_preset_wins_over_a_file_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fast").mkdir()
    assert load_config("fast").tracking.grid_columns == 30


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("bundle_adjustment.depth_sigma=1e-3", 1e-3),
        ("bundle_adjustment.depth_sigma=2E-2", 2e-2),
        ("bundle_adjustment.depth_sigma=.5", 0.5),
        ("bundle_adjustment.depth_sigma=1", 1.0),
        ("nonrigid.depth_sigma=null", None),
        ("nonrigid.bridge_gaps=false", False),
        ("nonrigid.annealing=[10, 1]", (10.0, 1.0)),
        ("normalization=sum", "sum"),
        (" camera_init . window = 7", 7),
    ],
)
def test_override_values_are_yaml(override: str, expected: object) -> None:
    value: object = load_config(None, [override])
    for name in override.partition("=")[0].split("."):
        value = getattr(value, name.strip())
    assert value == expected


def test_an_override_can_give_a_whole_section() -> None:
    config = load_config(None, ["nonrigid={arap_weight: 3, solver: {max_iterations: 4}}"])
    assert config.nonrigid.solver.max_iterations == 4
    assert config.nonrigid.neighbors == Config().nonrigid.neighbors


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("camera_init.windw=3", ["--set", "camera_init.windw", "unknown field", "camera_init.window?"]),
        ("max_tracks_per_pair=3", ["max_tracks_per_pair: unknown field", "camera_init.max_tracks_per_pair?"]),
        ("zzz.qqq=3", ["zzz.qqq: unknown field", "closest"]),
        ("energy.x=3", ["energy.x: unknown field"]),
        ("output={cloud: true}", ["output.cloud: unknown field", "output.clouds?"]),
        ("camera_init.window=1", ["camera_init.window: got 1", "an integer at least 2"]),
        ("tracking.max_drift_px=-1", ["got -1", "a number above 0, or null"]),
        ("labels.band_weight=2", ["got 2", "at least 0 and at most 1"]),
        ("camera_init.window=true", ["camera_init.window: got true", "an integer"]),
        ("camera_init.window='4'", ['camera_init.window: got "4"', "an integer"]),
        ("camera_init.window=1.5", ["camera_init.window: got 1.5", "an integer"]),
        ("output.clouds=1", ["output.clouds: got 1", "true or false"]),
        ("energy=both", ['got "both"', "one of map, paper"]),
        ("nonrigid.annealing=[1, x]", ["nonrigid.annealing", '"x" in the list', "a list of numbers"]),
        ("nonrigid.depth_sigma=.nan", ["nonrigid.depth_sigma: got nan", "finite"]),
        ("input.max_depth_m=.inf", ["input.max_depth_m: got inf", "finite"]),
        ("camera_init.window=2024-01-01", ["camera_init.window: got"]),
        ("fusion=4", ["fusion: got 4", "a section with the fields", "neighbors"]),
        ("energy", ["--set energy", "section.field=VALUE"]),
        ("=3", ["section.field=VALUE"]),
        ("energy=[", ["--set energy", "not a YAML value"]),
        ("output={clouds: true, clouds: false}", ["given twice"]),
    ],
)
def test_a_wrong_override_says_where_what_and_what_is_allowed(override: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, [override])
    for part in parts:
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("nonrigd:\n  neighbors: 3\n", ["nonrigd: unknown field", "nonrigid?"]),
        ("nonrigid:\n  neighbors: -3\n", ["nonrigid.neighbors: got -3"]),
        ("- 1\n- 2\n", ["holds list", "mapping"]),
        ("a: [1\n", ["not valid YAML", "line 2"]),
        ("energy: map\nenergy: map\n", ["line 2", "given twice"]),
        ("energy: !!python/object/apply:os.system ['true']\n", ["not valid YAML"]),
        ("preset: papr\n", ["papr: no such preset", "paper?"]),
        ("preset: 3\n", ["preset: got 3"]),
        ("1: 2\n", ["a field name must be a text"]),
        ("solver: z\nenergy: x\nnormalization: y\n", ["solver: got", "energy: got", "normalization: got"]),
    ],
)
def test_a_wrong_file_is_named_with_the_mistake(text: str, parts: list[str], tmp_path: Path) -> None:
    path = write(tmp_path / "mine.yaml", text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    for part in parts:
        assert part in str(caught.value)
    assert str(path) in str(caught.value) or "preset" in str(caught.value)


def test_the_message_says_which_layer_a_value_came_from(tmp_path: Path) -> None:
    path = write(tmp_path / "mine.yaml", "camera_init:\n  window: -1\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml: camera_init\.window: got -1"):
        load_config(path, ["energy=map"])
    with pytest.raises(ConfigError, match=r"--set: camera_init\.window: got -2"):
        load_config(path, ["camera_init.window=-2"])


@pytest.mark.parametrize("name", ["nosuch", "papr", "nosuch.yaml", "folder/nosuch.yaml"])
def test_what_is_neither_preset_nor_file_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"no such (preset or )?file"):
        load_config(name)


def test_a_folder_and_a_binary_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder, but a YAML file is expected"):
        load_config(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ConfigError, match="is not text in UTF-8"):
        load_config(tmp_path / "binary.yaml")


def test_scenes_take_overrides_and_report_contradictions() -> None:
    scene = with_overrides(SyntheticSceneConfig(), ["num_frames=4", "noise.depth_flicker=0.0"])
    assert (scene.num_frames, scene.noise.depth_flicker) == (4, 0.0)
    with pytest.raises(ConfigError, match="margin_px 100 leaves nothing"):
        with_overrides(SyntheticSceneConfig(), ["margin_px=100", "height=64"])


def test_limits_of_depth_leave_some() -> None:
    assert load_config("default", ["input.min_depth_m=90", "input.max_depth_m=200"]).input.min_depth_m == 90
    for value in (80, 90):
        message = rf"input: min_depth_m \({value}\) must be below max_depth_m \(80\): all depth would be missing"
        with pytest.raises(ConfigError, match=message):
            load_config("default", [f"input.min_depth_m={value}"])


def test_every_field_says_what_it_means_and_takes() -> None:
    for field in describe_fields(Config()):
        assert field.description, field.path
        assert field.allowed, field.path
        assert "class" not in field.allowed, field.path
        assert find_field(Config, tuple(field.path.split("."))) is not None
    assert "nonrigid.solver.max_iterations" in set(field_paths(Config))


@pytest.mark.parametrize(
    ("preset", "override", "found"),
    [
        (
            "default",
            "energy=paper",
            ["camera_init.kernel.kind=huber", "bundle_adjustment.reprojection_kernel.kind=huber"]
            + [f"nonrigid.{term}_kernel.kind=huber" for term in ("reprojection", "smoothness", "arap")]
            + ["measure_noise=true", "bundle_adjustment.depth_prior=true", "nonrigid.depth_prior=true"],
        ),
        ("default", "nonrigid.depth_kernel.kind=norm", ["energy 'map'", "nonrigid.depth_kernel.kind=norm"]),
        ("paper", "energy=map", ["camera_init.kernel.kind=norm", "nonrigid.arap_kernel.kind=norm"]),
        ("paper", "nonrigid.depth_prior=true", ["energy 'paper'", "nonrigid.depth_prior=true"]),
        ("paper", "nonrigid.arap_kernel.kind=cauchy", ["nonrigid.arap_kernel.kind=cauchy"]),
        ("paper", "camera_init.kernel.kind=huber", ["camera_init.kernel.kind=huber"]),
        (
            "paper",
            "bundle_adjustment.reprojection_kernel.kind=quadratic",
            ["bundle_adjustment.reprojection_kernel.kind=quadratic"],
        ),
    ],
)
def test_a_mixture_of_the_energies_is_one_error_that_lists_what_contradicts(
    preset: str, override: str, found: list[str]
) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(preset, [override])
    for part in [*found, "--config paper"]:
        assert part in str(caught.value)
    assert str(caught.value).count("kind=") == sum("kind=" in part for part in found) or preset == "paper"
    assert "\n" not in str(caught.value)


def test_either_energy_may_lose_a_term_and_change_its_numbers() -> None:
    paper = load_config("paper", ["nonrigid.arap_weight=0", "nonrigid.arap_kernel.threshold=0.01"])
    paper = with_overrides(paper, ["nonrigid.annealing=[1]", "nonrigid.depth_kernel.kind=cauchy", "solver=adam"])
    assert (paper.energy, paper.nonrigid.arap_weight, paper.nonrigid.annealing) == ("paper", 0.0, (1.0,))
    squared = load_config("paper", ["camera_init.kernel={kind: quadratic}"])
    assert (squared.camera_init.kernel.kind, squared.energy) == ("quadratic", "paper")
    robust = load_config("default", ["nonrigid.depth_prior=false", "nonrigid.arap_kernel.kind=cauchy"])
    assert not robust.nonrigid.depth_prior


def test_one_text_is_no_list_of_overrides() -> None:
    said = r"a list of section.field=VALUE is expected, such as \['nonrigid.neighbors=3'\], not one text"
    with pytest.raises(ConfigError, match=said):
        load_config("fast", "nonrigid.neighbors=3")
    with pytest.raises(ConfigError, match=said):
        with_overrides(Config(), "nonrigid.neighbors=3")


def test_a_configuration_is_opened_by_name_or_taken_as_it_is(tmp_path: Path) -> None:
    fast = load_config("fast")
    assert opened_config(fast) is fast
    assert opened_config("fast") == opened_config(write(tmp_path / "mine.yaml", "preset: fast")) == fast
    assert opened_config(None, ["nonrigid.neighbors=3"]).nonrigid.neighbors == 3
    with pytest.raises(ConfigError, match="built already takes none"):
        opened_config(fast, ["nonrigid.neighbors=3"])


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=30), st.text(max_size=30))
def test_any_text_as_override_is_taken_or_refused_with_a_message(name: str, value: str) -> None:
    for override in (f"{name}={value}", f"camera_init.window={value}", f"nonrigid={value}", f"energy={value}"):
        with contextlib.suppress(ConfigError):
            assert isinstance(load_config(None, [override]), Config)
