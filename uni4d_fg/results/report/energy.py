"""What every stage minimized: energy per term at the start and at the end, and against iterations."""

from __future__ import annotations

import math
from typing import Any

from uni4d_fg.results.report.chart import Line, line_chart
from uni4d_fg.results.report.markup import Markup, element, figure, join, number, section, table
from uni4d_fg.results.run import Run

_MANY_SOLVES = 8


def energies(run: Run) -> Markup:
    """Return the section about the solves of all stages."""
    parts: list[Markup] = []
    for name, stage in run.summary.get("stages", {}).items():
        solves = stage.get("solves", [])
        if not solves:
            continue
        parts.append(element("h3", name.replace("_", " ").capitalize()))
        parts.append(_windows(name, solves) if len(solves) > _MANY_SOLVES else _solves(name, solves))
    if not parts:
        parts = [element("p", "The run recorded no solve.", class_="muted")]
    return section("energy", "Energy per stage", *parts)


def _solves(stage: str, solves: list[dict[str, Any]]) -> Markup:
    out: list[Markup] = [_terms(solve) for solve in solves]
    curves = []
    names = [str(solve.get("name", "")).replace("_", " ") for solve in solves]
    for index, solve in enumerate(solves):
        curve = solve.get("energy_curve") or []
        if not curve:
            continue
        initial = solve.get("initial_energy")
        start = [] if initial is None or "rounds" in solve.get("notes", {}) else [[0, initial]]
        points = [*start, *curve]
        name = names[index]
        if names.count(name) > 1:
            name += f" {names[: index + 1].count(name)}"
        curves.append(Line(name, [p[0] for p in points], [p[1] for p in points]))
    if not curves:
        out.append(element("p", "This run did not record energies against iterations.", class_="muted"))
        return join(out)
    chart = line_chart(
        f"energy-{stage}", f"Energy against iterations, stage {stage.replace('_', ' ')}", curves,
        x_label="iteration", y_label="energy", log=True,
    )  # fmt: skip
    caption = "Energy against iterations"
    if any("rounds" in solve.get("notes", {}) for solve in solves):
        caption += "; a warm-up works on an easier energy, so that the curve may jump where it ends"
    out.append(element("div", figure(chart, caption), class_="charts"))
    return join(out)


def _terms(solve: dict[str, Any]) -> Markup:
    initial, final = solve.get("initial_energies", {}), solve.get("final_energies", {})
    rows = [[name.replace("_", " "), number(initial.get(name)), number(final.get(name))] for name in final]
    rows.append(["total", number(solve.get("initial_energy")), number(solve.get("final_energy"))])
    caption = (
        f"{str(solve.get('name')).replace('_', ' ')}: {solve.get('num_iterations')} iterations, "
        f"{solve.get('termination')}, {solve.get('num_factors')} factors, {solve.get('num_variables')} variables"
    )
    return table(caption, ("term", "start", "end"), rows)


def _windows(stage: str, solves: list[dict[str, Any]]) -> Markup:
    """Many small solves in a row: their energies per factor, one point each."""
    x = list(range(1, len(solves) + 1))

    def per_factor(field: str) -> list[float]:
        energies = [solve.get(field) for solve in solves]
        factors = [max(int(solve.get("num_factors", 0)), 1) for solve in solves]
        return [math.nan if e is None else float(e) / n for e, n in zip(energies, factors, strict=True)]

    chart = line_chart(
        f"energy-{stage}", f"Energy per factor at the start and at the end of {len(solves)} windows",
        [Line("start", x, per_factor("initial_energy")), Line("end", x, per_factor("final_energy"))],
        x_label="window", y_label="energy per factor", log=True,
    )  # fmt: skip
    iterations = sum(int(solve.get("num_iterations", 0)) for solve in solves)
    done = sum(str(solve.get("termination", "")).startswith(("converged", "nothing")) for solve in solves)
    text = f"{len(solves)} windows, {iterations} iterations, {done} converged. The last window:"
    return join([
        element("p", text), _terms(solves[-1]),
        element("div", figure(chart, "Energy per factor of each window"), class_="charts"),
    ])  # fmt: skip
