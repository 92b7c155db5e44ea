from __future__ import annotations

import math
from dataclasses import replace

import pytest

from uni4d_fg.pipeline.compare.benchmark import Benchmark, Performance, Reach
from uni4d_fg.pipeline.compare.comparison import Comparison
from uni4d_fg.pipeline.compare.markdown import accuracy_table, markdown, ratio, ratio_table
from uni4d_fg.pipeline.compare.ratios import losses, stage_ratios
from uni4d_fg.pipeline.compare.whole_run import WholeRun


def performance(
    energy: float, own: float, other: float, missed: int = 0, higher: int = 0, name: str = "lm"
) -> Performance:
    opponent = "adam" if name == "lm" else "lm"
    reach = {name: Reach(own, 0), opponent: Reach(other, missed)}
    return Performance({"term": energy}, own, 3, 2, 12.0, reach, {opponent: higher}, [(0.0, 9.0), (own, energy)])


def benchmark(kind: str, start: str, lm: tuple[float, float, float], adam: tuple[float, float]) -> Benchmark:
    """LM (energy, own time, time to Adam's energy; never if infinite) against Adam (energy, own time)."""
    missed = int(math.isinf(lm[2]))
    mine = performance(lm[0], lm[1], lm[1] if missed else lm[2], missed, int(lm[0] > adam[0]))
    theirs = performance(adam[0], adam[1], adam[1], int(adam[0] > lm[0]), int(adam[0] > lm[0]), name="adam")
    return Benchmark(kind, start, 1, {"lm": mine, "adam": theirs})


def run(seconds: float, ate: float) -> WholeRun:
    stages = dict.fromkeys(("camera_init", "bundle_adjustment", "nonrigid"), seconds)
    return WholeRun({**stages, "fusion": 9.0}, 100.0, {"ATE, m": ate})


GOOD = Comparison(
    "scene",
    "default",
    30,
    {"static": 5},
    {"lm": run(1.0, 0.01), "adam": run(20.0, 0.03)},
    {"lm": {"term": 1.0}, "adam": {"term": 2.0}},
    [
        benchmark("camera_init", "common", (1.0, 0.2, 0.1), (2.0, 10.0)),
        benchmark("bundle_adjustment", "lm", (1.0, 0.2, 0.1), (2.0, 5.0)),
        benchmark("structure", "lm", (1.0, 0.2, 0.3), (2.0, 5.0)),
        benchmark("nonrigid", "lm", (1.0, 0.2, 0.1), (2.0, 4.0)),
    ],
)


def test_ratios_add_the_kinds_of_a_stage_and_all_stages() -> None:
    found = {(r.stage, r.start): r for r in stage_ratios(GOOD, "adam")}
    assert found["1", "common"].time == pytest.approx(0.1 / 10)
    assert found["2", "lm"].time == pytest.approx(0.4 / 10)
    assert found["3", "lm"].time == pytest.approx(0.1 / 4)
    assert found["1-3", "lm"].time == pytest.approx(0.6 / 24)
    assert all(r.energy == pytest.approx(0.5) for r in found.values())
    assert all(math.isinf(r.back) for r in found.values())


def test_a_clean_win_has_no_losses() -> None:
    assert losses(GOOD) == []


def test_every_loss_is_said() -> None:
    benchmarks = [
        benchmark("camera_init", "common", (3.0, 0.2, math.inf), (2.0, 10.0)),
        benchmark("nonrigid", "lm", (1.0, 20.0, 12.0), (2.0, 4.0)),
    ]
    bad = replace(
        GOOD,
        benchmarks=benchmarks,
        runs={"lm": run(30.0, 0.05), "adam": run(20.0, 0.03)},
        camera_init_energy={"lm": {"term": 2.2}, "adam": {"term": 2.0}},
    )
    assert losses(bad) == [
        "camera_init from common: LM ends 50 % above adam",
        "nonrigid from lm: LM needs 3 times as long as adam to reach its energy",
        "stage 1 as a whole: LM ends 10 % above adam",
        "accuracy of the whole run: ATE, m is 0.05 with LM, 0.03 with adam",
        "whole run: stages 1 to 3 take LM longer than adam",
    ]
    assert math.isinf(stage_ratios(bad, "adam")[0].time)
    assert "never" in markdown([bad], {}, "command")


def test_energies_missed_in_some_of_many_solves_are_counted() -> None:
    windows = Benchmark(
        "camera_init",
        "common",
        59,
        {
            "lm": performance(1.0, 0.5, 0.2, missed=2, higher=2),
            "adam": performance(2.0, 10.0, 10.0, missed=57, name="adam"),
        },
    )
    partly = replace(GOOD, benchmarks=[windows, *GOOD.benchmarks[1:]])
    first, last = (r for r in stage_ratios(partly, "adam") if r.stage in ("1", "1-3"))
    assert math.isinf(first.time)
    assert (first.missed, first.tasks, first.spent) == (2, 59, pytest.approx(0.2 / 10))
    assert (last.missed, last.tasks, last.spent) == (2, 62, pytest.approx(0.7 / 24))
    assert "| 1 | common | adam | 1/50, 2 of 59 never | 0.50000 | never |" in ratio_table(partly)
    assert "camera_init from common: LM ends above adam in 2 of 59 solves" in losses(partly)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.02, "1/50"), (2.5, "2.5"), (1.0, "1"), (math.inf, "never"), (math.nan, "not lowered"), (0.0, "0")],
)
def test_ratios_in_words(value: float, text: str) -> None:
    assert ratio(value) == text


def test_accuracy_is_compared_across_presets() -> None:
    paper = replace(GOOD, preset="paper", runs={"lm": run(1.0, 0.5), "adam": run(2.0, 0.04)})
    rows = accuracy_table([GOOD, paper])
    assert rows[2:] == ["| scene | ATE, m | 0.01 | 0.04 | 0.25 |"]
    assert accuracy_table([GOOD]) == []
