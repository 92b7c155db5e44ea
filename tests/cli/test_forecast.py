from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from uni4d_fg.cli.expected_time import expected_time
from uni4d_fg.cli.forecast import Forecast, ForecastReporter, Share, expected_shares
from uni4d_fg.cli.main import application
from uni4d_fg.cli.progress import left, progress_reporter
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.cues.plan import CuePlan
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.progress import SilentReporter

SIZE = (480, 640)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def simulated(shares: list[Share], really: list[float], measured: set[str]) -> list[tuple[float, float | None]]:
    """Play a run whose tasks take so long; return its moments: the part of the time, and the total that was told."""
    clock = Clock()
    reporter = ForecastReporter(SilentReporter(), Forecast(shares, clock))
    whole, told = sum(really), []
    for share, seconds in zip(shares, really, strict=True):
        reporter.begin(share.task, 50 if share.task in measured else None)
        for step in range(1, 51):
            clock.now += seconds / 50
            reporter.advance(step)
            passed = clock.now - 100.0
            rest = reporter.forecast.state()[1]
            told.append((passed / whole, None if rest is None else passed + rest))
        reporter.end()
    return told


@pytest.mark.parametrize("pace", [0.2, 1.0, 7.0])
def test_a_run_of_the_expected_shares_is_told_at_any_pace(pace: float) -> None:
    shares = expected_shares(60, SIZE, Config(), CuePlan(depth="geometry", masks="motion"), None)
    really = [pace * share.seconds for share in shares]
    told = simulated(shares, really, {"tracks", "fusion", "depth maps"})
    later = [total for part, total in told if part > 0.1]
    assert len(later) > 100
    assert all(total is not None for total in later)
    ratio = np.array([total for total in later if total is not None]) / sum(really)
    assert ratio.max() < 1.5
    assert ratio.min() > 1 / 1.5


def test_shares_that_are_off_by_a_third_each_still_tell_the_time(rng: np.random.Generator) -> None:
    shares = expected_shares(60, SIZE, Config(), CuePlan(), None)
    for _ in range(20):
        really = [share.seconds * float(np.exp(rng.uniform(-0.25, 0.25))) for share in shares]
        told = simulated(shares, really, {"tracks", "fusion"})
        for part, total in told:
            if part > 0.1:
                assert total is not None
                assert 1 / 1.7 < total / sum(really) < 1.7


def test_tasks_that_are_left_out_or_unknown_do_no_harm() -> None:
    clock = Clock()
    forecast = Forecast([Share("a", 10), Share("b", 30), Share("a", 20), Share("c", 40)], clock)
    assert forecast.state() == (0.0, None)
    forecast.begin("a", 10)
    clock.now += 5
    forecast.advance(0.5)
    assert forecast.state() == (pytest.approx(0.05), None)
    forecast.begin("unheard of", None)
    clock.now += 500
    assert forecast.state() == (pytest.approx(0.1), pytest.approx(45.0))
    forecast.begin("a", 10)
    # The share between is left out: it will not come any more.
    assert forecast.state()[0] == pytest.approx(10 / 70)
    clock.now += 10
    forecast.advance(1.0)
    forecast.end()
    assert forecast.state() == (pytest.approx(30 / 70), pytest.approx(20.0))
    forecast.begin("c", None)
    clock.now += 1000
    part, rest = forecast.state()
    assert part < 1.0
    assert rest is not None
    assert rest > 0
    forecast.end()
    assert forecast.state()[0] == pytest.approx(1.0)


def test_a_task_that_takes_three_times_as_long_corrects_itself_and_not_those_behind_it() -> None:
    clock = Clock()
    forecast = Forecast([Share("a", 10), Share("b", 10), Share("c", 10)], clock)
    forecast.begin("a", None)
    clock.now += 10
    forecast.begin("b", 10)
    # Preparation, which no part of the work stands for.
    clock.now += 6
    assert forecast.state()[1] == pytest.approx(20.0)
    forecast.advance(0.1)
    for part in range(2, 6):
        clock.now += 3
        forecast.advance(part / 10)
    rest = forecast.state()[1]
    assert rest is not None
    # Own pace: 15 s for the second half; the pace of all, which c takes, is (10 + 12) s for 10 + 4 expected ones.
    assert rest == pytest.approx(15.0 + 10 * 22 / 14)


def test_what_passes_between_two_tasks_belongs_to_the_second() -> None:
    clock = Clock()
    forecast = Forecast([Share("a", 10), Share("b", 20), Share("c", 10)], clock)
    forecast.begin("a", None)
    clock.now += 10
    forecast.end()
    clock.now += 30
    forecast.begin("b", None)
    clock.now += 10
    forecast.end()
    assert forecast.state() == (pytest.approx(0.75), pytest.approx(10 * 50 / 30))


def test_given_tracks_say_how_large_bundle_adjustment_is() -> None:
    def seconds(count: int) -> float:
        visible = np.ones((count, 60), bool)
        uv, start = np.zeros((count, 60, 2), np.float32), np.zeros(count, np.int32)
        shares = expected_shares(60, SIZE, Config(), CuePlan(), Tracks(uv, visible, start))
        return next(share.seconds for share in shares if share.task == "bundle adjustment")

    assert seconds(4000) - seconds(2000) == pytest.approx(seconds(6000) - seconds(4000))
    assert seconds(4000) > 1.5 * seconds(2000)


def test_a_lens_is_looked_for_once() -> None:
    def tasks(plan: CuePlan) -> list[str]:
        return [share.task for share in expected_shares(60, SIZE, Config(), plan, None)]

    assert tasks(CuePlan()).count("lens") == 1
    assert tasks(CuePlan(depth="geometry", masks="motion")).count("lens") == 0


@pytest.mark.parametrize("plan", [CuePlan(), CuePlan(depth="geometry", masks="motion")])
def test_a_rolling_shutter_is_forecast_where_it_is_looked_for(plan: CuePlan) -> None:
    def count(*changes: str) -> int:
        shares = expected_shares(60, SIZE, load_config("default", list(changes)), plan, None)
        return [share.task for share in shares].count("rolling shutter")

    assert count() == 1
    assert count("camera.rolling_shutter=off") == 0
    assert count("input.poses=fixed") == 0


def test_lines_say_how_long_it_will_take(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    forecast = Forecast([Share("a", 10), Share("b", 30)], clock)
    with progress_reporter(False, forecast) as reporter:
        reporter.begin("a", 10)
        clock.now += 20
        reporter.end("fine")
    assert left(forecast) == "about 1 min 0 s left"
    assert capsys.readouterr().err.endswith("fine, about 1 min 0 s left\n")


def test_doctor_says_where_time_will_go(tmp_path: Path) -> None:
    sequence = make_synthetic_sequence(SyntheticSceneConfig(num_frames=3, width=64, height=48, focal=60.0))
    write_native(sequence, tmp_path / "clip")
    found = expected_time(tmp_path / "clip", None)
    tasks = [task["task"] for task in found["tasks"]]
    assert tasks == [
        "tracks", "rolling shutter", "lens", "camera init", "bundle adjustment", "nonrigid", "fusion",
        "clouds and pictures",
    ]  # fmt: skip
    assert found["num_frames"] == 3
    assert sum(task["share"] for task in found["tasks"]) == pytest.approx(1.0)
    assert found["seconds"] == pytest.approx(sum(task["seconds"] for task in found["tasks"]))
    answer = CliRunner().invoke(application(), ["doctor", "--time", str(tmp_path / "clip")])
    assert answer.exit_code == 0
    assert answer.output.startswith("clip: 3 frames of 64 x 48 px, about ")
    assert len(answer.output.splitlines()) == 1 + len(tasks)
