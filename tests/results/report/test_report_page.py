from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from viewing_samples import NUM_FRAMES, copied, opened

from uni4d_fg.cli import main
from uni4d_fg.errors import InputError
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.report.build import report_page
from uni4d_fg.results.report.overview import nearest_preset
from uni4d_fg.results.run import Run

VOID = {"meta", "img", "br", "hr"}


class StrictParser(HTMLParser):
    """Refuses elements that are not closed in order; collects what the tests ask about."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert all(value is not None for _, value in attrs), f"an attribute of {tag} has no value"
        assert len({name for name, _ in attrs}) == len(attrs), f"{tag} has an attribute twice"
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text.append(data)

    def of(self, tag: str) -> Iterator[dict[str, str]]:
        return (attributes for name, attributes in self.tags if name == tag)


def parsed(page: str) -> StrictParser:
    parser = StrictParser()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def text_of(page: str) -> str:
    return " ".join(" ".join(parsed(page).text).split())


@pytest.fixture(scope="module")
def run(finished_run: Path) -> Run:
    return opened(finished_run)


@pytest.fixture(scope="module")
def page(run: Run) -> str:
    return report_page(run)


def cells(page: str, caption: str) -> dict[str, list[str]]:
    """The rows of the table with this caption: heading to cells."""
    table = next(t for t in re.findall(r"<table>.*?</table>", page, re.S) if f"<caption>{caption}" in t)
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', table, re.S)
    return {name: re.findall(r"<td>(.*?)</td>", rest) for name, rest in rows}


def value(text: str) -> float:
    return float(text.replace(",", ""))


def test_the_page_is_well_formed_and_can_be_read_aloud(page: str) -> None:
    assert page.startswith("<!doctype html>\n")
    parser = parsed(page)
    ids = [attributes["id"] for _, attributes in parser.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    for _, attributes in parser.tags:
        for name in ("aria-labelledby", "aria-describedby"):
            assert set(attributes.get(name, "").split()) <= set(ids)
    assert all(attributes["href"][1:] in ids for attributes in parser.of("a"))
    assert all(len(attributes["alt"]) > 10 for attributes in parser.of("img"))
    assert next(parser.of("html"))["lang"] == "en"
    levels = [int(tag[1]) for tag, _ in parser.tags if re.fullmatch(r"h\d", tag)]
    assert levels.count(1) == 1
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    for attributes in parser.of("svg"):
        assert attributes.get("aria-hidden") == "true" or attributes["role"] == "img"


def test_the_page_asks_for_nothing(page: str) -> None:
    parser = parsed(page)
    for tag, attributes in parser.tags:
        assert tag not in ("script", "link", "iframe", "object", "embed", "base")
        for name in ("src", "href", "srcset", "data", "poster", "xlink:href"):
            assert attributes.get(name, "#").startswith(("#", "data:")), (tag, name)
    bare = re.sub(r"data:image/jpeg;base64,[A-Za-z0-9+/=]+", "", page)
    assert re.findall(r"https?:|//[a-z]|@import|url\(", bare) == []
    assert len(page) < 2_000_000


def test_numbers_are_those_of_the_summary(run: Run, page: str) -> None:
    stages = run.summary["stages"]
    times = cells(page, "Time and memory of the stages")
    assert set(times) == {name.replace("_", " ") for name in stages}
    for name, stage in stages.items():
        assert value(times[name.replace("_", " ")][0]) == pytest.approx(stage["seconds"], abs=0.051)
        assert value(times[name.replace("_", " ")][1]) == pytest.approx(stage["peak_memory_mb"], rel=1e-3)
    tracks = stages["tracks"]["tracks"]
    assert {n: int(r[0]) for n, r in cells(page, "What the").items()} == {
        n.replace("_", " "): c for n, c in tracks.items()
    }
    dropped = {r: n for stage in stages.values() for r, n in stage.get("dropped", {}).items() if n}
    assert dropped
    assert {reason: int(row[1]) for reason, row in cells(page, "Left out by the stages").items()} == dropped
    solve = stages["nonrigid"]["solves"][-1]
    terms = cells(page, "nonrigid:")
    for name, energy in solve["final_energies"].items():
        assert value(terms[name.replace("_", " ")][1]) == pytest.approx(energy, rel=1e-3)
    assert value(terms["total"][0]) == pytest.approx(solve["initial_energy"], rel=1e-3)
    text = text_of(page)
    for package, version in run.summary["versions"].items():
        assert f"{package} {version}" in text
    for fact in stages["bundle_adjustment"]["facts"]:
        assert fact in text


def test_accuracy_is_that_of_evaluate(run: Run, page: str) -> None:
    report = evaluate_run(run.folder.root, run.sequence)  # type: ignore[arg-type]
    assert report.trajectory is not None
    assert report.depth is not None
    assert value(cells(page, report.trajectory.protocol)["ATE"][0]) == pytest.approx(report.trajectory.ate_m, rel=1e-3)
    section = page[page.index("Depth, fused") :]
    for metrics in report.depth.metrics.values():
        row = cells(section, metrics.protocol)["all"]
        assert value(row[0]) == pytest.approx(metrics.regions["all"].abs_rel, rel=1e-3)


def test_the_configuration_is_the_preset_and_what_differs(run: Run, page: str, tmp_path: Path) -> None:
    found = nearest_preset(run.folder.config)
    assert found is not None
    assert found[0] == "fast"
    assert set(found[1]) == {"fusion.static_stride"} | ({"output.clouds"} & set(found[1]))
    assert cells(page, "Changed fields")["fusion.static_stride"][1] == "3"
    (tmp_path / "config.yaml").write_text("a: [")
    assert nearest_preset(tmp_path / "config.yaml") is None
    (tmp_path / "config.yaml").write_text("field_of_the_past: 7")
    old = nearest_preset(tmp_path / "config.yaml")
    assert old is not None
    assert old[1]["field_of_the_past"] == (None, 7)


def test_warnings_come_first(run: Run) -> None:
    cues = {"metric": False, "warnings": ["masks are a guess"], "sources": {"depth": "geometry"}, "facts": []}
    summary = {**run.summary, "warnings": ["the camera moves by only 0.1 %"], "cues": cues}
    page = report_page(run.with_parts(summary=summary))
    text = text_of(page)
    places = [
        text.index(words)
        for words in (
            "What to distrust",
            "not metric",
            "Masks are a guess.",
            "The camera moves by only 0.1 %.",
            "What was run",
        )
    ]
    assert places == sorted(places)
    assert "Depth: geometry" in text
    assert "[units]" in text
    assert "[m]" not in text


def test_text_of_others_is_escaped(run: Run) -> None:
    sequence = {**run.summary["sequence"], "name": "<script>x</script> & more"}
    page = report_page(run.with_parts(summary={**run.summary, "sequence": sequence, "warnings": ["<img src=x>"]}))
    assert "<script" not in page
    assert "<script>x</script> & more" in text_of(page)
    assert "<img src=x>." in text_of(page)


def test_a_run_alone_is_reported_with_what_is_missing(run: Run) -> None:
    alone = run.with_parts(sequence=InputError("gone"), labelled=None, depth=None)
    text = text_of(report_page(alone))
    assert "Not at hand: images are not shown: gone" in text
    assert "The sequence is not at hand." in text
    reconstruction = replace(run.reconstruction, pose_covariance=None)
    assert "The run has no covariances" in text_of(report_page(alone.with_parts(reconstruction=reconstruction)))


def test_a_scene_without_points_is_reported(run: Run) -> None:
    empty = {"landmarks": 3, "landmark_track": 0, "landmark_color": 3, "landmark_error": 0}
    values = {name: getattr(run.reconstruction, name)[:0] for name in empty}
    moving = ("dynamic_points", "dynamic_observed", "dynamic_track", "dynamic_instance", "dynamic_color")
    values |= {name: getattr(run.reconstruction, name)[:0] for name in moving}
    bare = run.with_parts(reconstruction=replace(run.reconstruction, **values))
    assert "There is no static landmark" in text_of(report_page(bare))


def test_a_run_of_stream_is_reported(run: Run, tmp_path: Path) -> None:
    assert run.sequence is not None
    words = ["stream", str(run.sequence.root), "--out", str(tmp_path / "s"), "--config", "fast", "--quiet"]
    assert main.run(words) == 0
    assert main.run(["report", str(tmp_path / "s")]) == 0
    text = text_of((tmp_path / "s" / "report.html").read_text())
    seconds = json.loads((tmp_path / "s" / "summary.json").read_text())["stages"]["stream"]["seconds"]["total"]
    assert f"{seconds:.1f} s" in text
    assert "labels.npz" in text


def test_the_verb_writes_where_it_is_told(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = copied(finished_run, tmp_path)
    assert main.run(["report", str(copy)]) == 0
    assert capsys.readouterr().out == f"report: {copy / 'report.html'}\n"
    assert main.run(["report", str(copy), "--out", str(tmp_path / "deep" / "page.html")]) == 0
    assert (tmp_path / "deep" / "page.html").read_text() == (copy / "report.html").read_text()
    capsys.readouterr()
    assert main.run(["report", str(copy), "--out", str(copy)]) == 6
    assert capsys.readouterr().err.count("\n") == 1


def test_strips_and_maps_are_of_the_frames(page: str) -> None:
    alternatives = [attributes["alt"] for attributes in parsed(page).of("img")]
    for kind in ("Image of frame 0", "Depth cue of frame 0", "Fused depth of frame 0", "Residual map of frame 0"):
        assert any(text.startswith(kind) for text in alternatives), kind
    assert any(f"frame {NUM_FRAMES - 1}" in text for text in alternatives)
    counts = re.findall(r"Residual map of frame \d+: (\d+) observations, median ([\d.]+) px", " ".join(alternatives))
    assert len(counts) == 4
    assert np.array([int(n) for n, _ in counts]).min() > 100
