from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from uni4d_fg.results.report.chart import Line, line_chart, nice_ticks
from uni4d_fg.results.report.markup import number, picture, table

finite = st.floats(-1e6, 1e6, allow_nan=False)


@given(finite, st.floats(1e-6, 1e6), st.booleans())
def test_ticks_are_round_and_within_the_range(low: float, length: float, whole: bool) -> None:
    high = low + length
    if not high > low:
        return
    ticks = nice_ticks(low, high, whole=whole)
    assert len(ticks) <= 6
    slack = 1e-6 * max(length, 1.0 if whole else 0.0)
    assert all(low - slack <= tick <= high + slack for tick in ticks)
    if whole:
        assert all(tick == round(tick) for tick in ticks)
    elif length > 1e-3 * abs(low):
        assert len(ticks) >= 2


@example([5e-324], False)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=40), st.booleans())
def test_any_values_give_a_well_formed_chart_inside_its_frame(values: list[float], log: bool) -> None:
    chart = line_chart("c", "A <chart>", [Line("a & b", range(len(values)), values)], x_label="x", y_label="y", log=log)
    root = ElementTree.fromstring(chart)
    if root.tag == "p":
        return
    for path in root.iter("path"):
        for x, y in re.findall(r"[ML]([-\d.e+]+) ([-\d.e+]+)", path.get("d", "")):
            assert 69.9 <= float(x) <= 428.1
            assert 13.9 <= float(y) <= 188.1


def test_the_curve_is_drawn_to_scale_and_broken_where_unknown() -> None:
    chart = line_chart("c", "t", [Line("a", [0, 1, 2, 3], [0.0, 10.0, np.nan, 5.0])], x_label="x", y_label="y")
    path = next(ElementTree.fromstring(chart).iter("path")).get("d")
    assert path is not None
    assert [m for m in path if m in "ML"] == ["M", "L", "M"]
    points = [(float(x), float(y)) for x, y in re.findall(r"[ML]([\d.]+) ([\d.]+)", path)]
    assert points[0] == (70.0, 188.0)
    assert abs((points[0][1] - points[2][1]) - 0.5 * (points[0][1] - points[1][1])) < 0.11
    assert points[2][0] == 428.0


def test_a_logarithmic_axis_spaces_decades_alike() -> None:
    chart = line_chart("c", "t", [Line("a", [0, 1, 2], [1.0, 10.0, 100.0])], x_label="x", y_label="y", log=True)
    path = next(ElementTree.fromstring(chart).iter("path")).get("d") or ""
    ys = [float(y) for _, y in re.findall(r"[ML]([\d.]+) ([\d.]+)", path)]
    assert abs((ys[0] - ys[1]) - (ys[1] - ys[2])) < 0.11
    texts = [text.text for text in ElementTree.fromstring(chart).iter("text")]
    assert {"1", "10", "100"} <= set(texts)


def test_curves_are_described_in_words() -> None:
    chart = line_chart(
        "c", "Error", [Line("a", [0, 1], [3.0, 1.0]), Line("b", [0], [np.nan])], x_label="x", y_label="y"
    )
    description = next(ElementTree.fromstring(chart).iter("desc")).text
    assert description == "Error. a: from 3 to 1, lowest 1, highest 3. b: no values."


def test_numbers_are_short_and_large_ones_whole() -> None:
    assert [number(v) for v in (None, float("nan"), 0.0, 1.23456, 98765.4, 1.6e-21)] == [
        "–",
        "–",
        "0",
        "1.235",
        "98,765",
        "1.6e-21",
    ]


def test_markup_is_escaped_and_pictures_hold_their_data() -> None:
    assert "&lt;b&gt;" in table("<b>", ("a",), [["<b>"]])
    image = picture(np.zeros((4, 6, 3), np.uint8), 'a "b"')
    assert 'alt="a &quot;b&quot;"' in image
    assert 'width="6" height="4"' in image
    assert 'src="data:image/jpeg;base64,/9j/' in image
