"""Tables: averages as the protocols weigh them, failures counted, four forms, printed numbers marked."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.errors import ConfigError
from uni4d_fg.pipeline.benchmark.grid import PAPER, READY_MADE, configurations, read_grid, ready_made
from uni4d_fg.pipeline.benchmark.published import read_published
from uni4d_fg.pipeline.benchmark.short import short_table
from uni4d_fg.pipeline.benchmark.table import Column, Row, Table, latex_text
from uni4d_fg.pipeline.benchmark.tables import Method, all_tables
from uni4d_fg.pipeline.benchmark.task import RESULT_VERSION, Configuration, Task, TaskResult, stored_result


def depth_scores(abs_rel: float, pixels: int) -> dict[str, object]:
    part = {"abs_rel": abs_rel, "delta_125": 1.0 - abs_rel, "pixels": pixels, "missing": 0}
    return {"protocol": "uni4d-scale", "text": "how", "scale": 1.0, "shift": 0.0, "regions": {"all": part}}


def result(video: str, ate: float, abs_rel: float, pixels: int) -> TaskResult:
    poses = {"ate": ate, "rpe_translation": ate / 2, "rpe_rotation_deg": 1.0, "poses": 5, "missing": 0}
    scores = {"poses": {"sim3": poses}, "depth": {"uni4d-scale": depth_scores(abs_rel, pixels)}}
    scores |= {"stages": {"camera_init": {"poses": {"sim3": poses | {"ate": 2 * ate}}}}}
    scores |= {"depth_cue": {"depth": {"uni4d-scale": depth_scores(2 * abs_rel, pixels)}}}
    return TaskResult("", video, "ours", None, 10, scores, {"nonrigid": 2.0, "fusion": 1.0}, 100.0)


@pytest.fixture
def tables() -> dict[str, Table]:
    results = {
        "a": result("a", 0.1, 0.2, 100), "b": result("b", 0.3, 0.4, 300), "c": TaskResult("", "c", "ours", "no depth")
    }  # fmt: skip
    found = all_tables("sintel", "Sintel", [Method("ours", results)], ("sim3",), ("uni4d-scale",), read_published())
    return {table.name: table for table in found}


def row_of(table: Table, name: str) -> Row:
    return next(row for row in table.rows if row.name == name)


def test_averages_count_failures_and_weigh_as_the_protocol_says(tables: dict[str, Table]) -> None:
    poses, depth = row_of(tables["poses-sim3"], "ours"), row_of(tables["depth-uni4d-scale"], "ours")
    assert poses.values["ATE"] == pytest.approx(0.2)
    assert (poses.values["videos"], poses.values["failed"]) == (2, 1)
    assert depth.values["AbsRel"] == pytest.approx((0.2 * 100 + 0.4 * 300) / 400)
    assert (depth.values["videos"], depth.values["failed"]) == (2, 1)
    assert row_of(tables["depth-uni4d-scale"], "depth cue").values["AbsRel"] == pytest.approx(0.7)
    assert row_of(tables["stages-sim3"], "ours, after camera init").values["ATE"] == pytest.approx(0.4)
    assert row_of(tables["runtime"], "ours").values["all"] == pytest.approx(3.0)
    assert row_of(tables["depth-uni4d-scale"], "depth cue").values["failed"] == 1
    assert row_of(tables["poses-sim3-videos"], "c").values == {"ours": None}
    assert "tracks" not in tables  # counts alone make no table


def test_frames_without_a_pose_are_counted_wherever_errors_of_poses_stand() -> None:
    def scored(video: str, ate: float | None, posed: int) -> TaskResult:
        poses = {} if ate is None else {"sim3": {"ate": ate, "rpe_translation": ate, "rpe_rotation_deg": 1.0}}
        return TaskResult("", video, "x", None, 6, {"poses": poses, "posed": {"posed": posed, "frames": 6}})

    whole = Method("whole", {"a": scored("a", 0.2, 6), "b": scored("b", 0.4, 6)})
    part = Method("part", {"a": scored("a", 0.0, 3), "b": scored("b", None, 1), "c": TaskResult("", "c", "x", "none")})
    found = {t.name: t for t in all_tables("sintel", "Sintel", [whole, part], ("sim3",), (), read_published())}
    poses, videos = found["poses-sim3"], found["poses-sim3-videos"]
    assert poses.cells()[-1] == ["part", "0.000", "0.000", "1.000", "4", "12", "1", "1"]
    assert poses.cells()[-2] == ["whole", "0.300", "0.300", "1.000", "12", "12", "2", "0"]
    assert "| Uni4D (published) | 0.110 | 0.032 | 0.338 | – | – | – | – |" in poses.markdown()
    assert r"\textbf{0.000} & 1.000 & 4 & 12 & 1 & 1 \\" in poses.latex().replace(r"\textbf{1.000}", "1.000")
    read = {row["method"]: row for row in csv.DictReader(io.StringIO(poses.comma_separated()))}
    assert (read["part"]["posed"], read["part"]["of frames"]) == ("4", "12")
    assert poses.data()["rows"][-1]["values"]["posed"] == 4
    assert videos.names() == ["video", "whole ↓", "part ↓", "part, posed", "of frames"]
    assert videos.cells() == [
        ["a", "0.2000", "0.0000", "3", "6"], ["b", "0.4000", "–", "1", "6"], ["c", "–", "–", "–", "–"]
    ]  # fmt: skip
    short = short_table("Sintel", list(found.values()))
    assert short is not None
    assert short.cells()[1][:5] == ["part", "0.000", "1.000", "4", "12"]
    alone = {t.name: t for t in all_tables("sintel", "Sintel", [whole], ("sim3",), (), [])}
    assert alone["poses-sim3-videos"].names() == ["video", "whole ↓"]
    short = short_table("Sintel", list(alone.values()))
    assert short is not None
    assert "posed" not in short.names()


def test_printed_numbers_are_marked_and_say_where_they_are_from(tables: dict[str, Table]) -> None:
    text = tables["poses-sim3"].markdown()
    assert "| Uni4D (published) | 0.110 | 0.032 | 0.338 | – | – | – | – |" in text
    assert "CasualSAM, MonST3R, Uni4D, Uni4D*: Uni4D (arXiv 2503.21761), table 1" in text
    assert "| MonST3R (published) | 0.344 | 0.559 |" in tables["depth-uni4d-scale"].markdown()


@pytest.mark.parametrize(
    ("dataset", "printed"), [("sintel-clean", "sintel"), ("bonn-associated", "bonn"), ("bonn", None), ("kitti", None)]
)
def test_numbers_that_were_printed_for_another_variant_say_so(dataset: str, printed: str | None) -> None:
    results = {"a": result("a", 0.1, 0.2, 100)}
    found = all_tables(dataset, "x", [Method("ours", results)], ("sim3",), ("uni4d-scale",), read_published())
    tables = [t for t in found if any(row.kind == "published" for row in t.rows)]
    assert "depth-uni4d-scale" in {t.name for t in tables}
    for table in tables:
        row = next(row for row in table.rows if row.kind == "published")
        said = f"; printed for `{printed}`, not for `{dataset}`" if printed else "table"
        assert said in row.source
        assert all(said in text for text in (table.markdown(), table.latex(), table.comma_separated()))
        assert ("printed for" in row.source) == (printed is not None)


def test_four_forms_hold_the_same() -> None:
    rows = [Row("a_1 & 50%", {"ATE": 0.12345, "n": 3}), Row("b", {"ATE": 0.2, "n": None}, "read", "x")]
    table = Table("t", "Title", "method", [Column("ATE"), Column("n", better="")], rows)
    assert "| a_1 & 50% | 0.123 | 3 |" in table.markdown()
    latex = table.latex()
    assert r"a\_1 \& 50\% & \textbf{0.123} & 3 \\" in latex
    assert latex.count(r"\toprule") == latex.count(r"\bottomrule") == 1
    read = list(csv.DictReader(io.StringIO(table.comma_separated())))
    assert (read[0]["method"], float(read[0]["ATE"]), read[1]["kind"]) == ("a_1 & 50%", 0.12345, "read")
    assert table.data()["rows"][0]["values"] == {"ATE": 0.12345, "n": 3}
    assert latex_text("δ<1.25 {x}") == r"δ$<$1.25 \{x\}"


def test_the_package_has_every_number_of_the_papers_tables() -> None:
    found = read_published()
    assert len(found) == 3 * 7 + 3 * 8 + 3 * 2 + 2
    uni4d = {(p.dataset, p.protocol): p.values for p in found if p.method == "Uni4D"}
    assert uni4d["kitti", "uni4d-scale-shift"] == pytest.approx({"AbsRel": 0.098, "δ<1.25": 0.897})
    assert uni4d["tum-dynamics", "sim3"] == {"ATE": 0.012, "RPE trans": 0.004, "RPE rot": 0.335}


@pytest.mark.parametrize(
    "text",
    [
        "a: [1", "- {dataset: x}",
        "- {dataset: s, protocol: p, columns: [A, B], source: x, percent: [], rows: {m: [1]}}",
    ],
)  # fmt: skip
def test_a_damaged_file_of_printed_numbers_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"p\.yaml"):
        read_published(path)


def test_a_grid_gives_rows_and_all_combinations(tmp_path: Path) -> None:
    path = tmp_path / "grid.yaml"
    path.write_text(
        "base: {set: [output.clouds=false]}\nrows: {whole: {}, known: {intrinsics: known}}\n"
        "grid: {preset: [default, fast], nonrigid.arap_weight: [0, 5.0]}\n"
    )
    found = {c.name: c for c in read_grid(path)}
    assert list(found)[:2] == ["whole", "known"]
    assert len(found) == 6
    assert found["known"].intrinsics == "known"
    both = found["preset fast, arap_weight 5.0"]
    assert (both.preset, both.changes) == ("fast", ("output.clouds=false", "nonrigid.arap_weight=5.0"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rows: {a: {presets: x}}", "presets"),
        ("rows: {a: {preset: nosuch}}", "nosuch"),
        ("rows: {a: {set: [nonrigid.nosuch=1]}}", "nosuch"),
        ("rows: {a: {masks: maybe}}", "masks"),
        ("rows: {}", "neither rows nor a grid"),
        ("rows: [1]", "rows"),
        ("rows: {'.a': {}}", "name of a folder"),
        ("rows: {a: {}}\nmore: 1", "more"),
    ],
)
def test_a_wrong_grid_is_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "grid.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_grid(path)


def test_the_papers_ablations_are_valid() -> None:
    assert len(configurations(list(PAPER.items()), {}, "ablate")) == len(PAPER)


@pytest.mark.parametrize("name", READY_MADE)
def test_every_row_that_is_ready_made_is_another_way_to_run(name: str) -> None:
    rows, missing = ready_made(name, {"set": ["output.pictures=false"]})
    assert ([row.name for row in rows], missing) == (list(READY_MADE[name]), [])
    ways = {
        json.dumps([
            load_config(row.preset, row.changes).model_dump(mode="json"),
            row.intrinsics, row.depth, row.masks, row.tracks, row.poses,
        ])
        for row in rows
    }  # fmt: skip
    assert len(ways) == len(rows)
    assert all("output.pictures=false" in row.changes for row in rows)


def test_the_full_rows_vary_terms_cues_solver_and_preset() -> None:
    rows = {row.name: row for row in ready_made("full", {})[0]}
    configs = {name: load_config(row.preset, row.changes) for name, row in rows.items()}
    assert {(row.preset, configs[name].solver) for name, row in rows.items()} >= {
        ("default", "lm"), ("default", "adam"), ("paper", "lm"), ("paper", "adam"), ("fast", "lm"),
    }  # fmt: skip
    assert {row.masks for row in rows.values()} == {"cue", "true", "motion", "none"}
    assert {row.tracks for row in rows.values()} == {"cue", "built_in"}
    assert {row.depth for row in rows.values()} == {"cue", "motion"}
    acceleration = configs["without E_cam"].bundle_adjustment.acceleration
    assert (acceleration.linear, acceleration.angular) == (None, None)
    text = configs["preset paper, formulas of the text"]
    assert (text.camera_init.kernel.kind, text.normalization, text.fusion.distance_power) == ("quadratic", "sum", 1)


def test_no_row_by_adam_is_run_unasked_or_without_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(load_config(r.preset, r.changes).solver == "lm" for r in ready_made("standard", {})[0])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    rows, missing = ready_made("full", {})
    assert missing == ["Adam", "preset paper, Adam"]
    assert len(rows) == len(READY_MADE["full"]) - 2


def test_a_list_of_rows_that_is_not_there_and_a_change_that_a_row_refuses_are_named() -> None:
    with pytest.raises(ConfigError, match="--rows most: choose one of paper, standard, full"):
        ready_made("most", {})
    with pytest.raises(ConfigError, match=r"--rows standard: preset paper: .*arap_kernel\.kind=cauchy"):
        ready_made("standard", {"set": ["nonrigid.arap_kernel.kind=cauchy"]})


def test_a_stored_result_counts_only_for_its_own_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = Task("sintel", "root", "a", Configuration("x"), str(tmp_path))
    assert stored_result(task) is None
    TaskResult(task.key, "a", "x", notes=("n",)).save(task.result_file)
    found = stored_result(task)
    assert found is not None
    assert found.notes == ("n",)
    other = Task("sintel", "root", "a", Configuration("x", changes=("solver=adam",)), str(tmp_path))
    assert stored_result(other) is None
    with monkeypatch.context() as patch:
        patch.setattr("uni4d_fg.pipeline.benchmark.task.RESULT_VERSION", RESULT_VERSION - 1)
        assert stored_result(task) is None  # scores of another version came out otherwise
    TaskResult(task.key, "a", "x", failed="why").save(task.result_file)
    assert stored_result(task) is None
    task.result_file.write_text("{")
    assert stored_result(task) is None


def test_small_numbers_keep_two_digits_and_the_first_table_has_one_line_per_method() -> None:
    rows = [Row("x", {"a": 0.00123, "b": 0.4}), Row("y", {"a": 0.5})]
    shown = Table("t", "t", "row", [Column("a"), Column("b", 0)], rows)
    assert shown.cells() == [["x", "0.0012", "0"], ["y", "0.500", "–"]]
    assert Table("t", "t", "row", [Column("a")], [Row("x", {"a": 1e-9})]).cells() == [["x", "0.000"]]
    poses = Table(
        "poses-sim3", "", "method", [Column("ATE"), Column("RPE trans")],
        [Row("printed", {"ATE": 1.0}, "published"), Row("mine", {"ATE": 0.25, "RPE trans": 3.0})],
    )  # fmt: skip
    rows = [Row("mine", {"SC": 0.5}), Row("depth cue", {"SC": 2.0})]
    consistency = Table("consistency", "", "method", [Column("SC")], rows)
    found = short_table("Scenes", [poses, consistency])
    assert found is not None
    assert found.names() == ["method", "ATE, m ↓", "SC ↓"]
    assert found.cells() == [["mine", "0.250", "0.500"], ["depth cue", "–", "2.000"]]
    assert found.notes == ["poses: `sim3`"]
    assert short_table("Nothing", []) is None
