"""The verb ``graph``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json


def graph(
    run: options.RunPath,
    stage: Annotated[
        str | None, typer.Option(help="Kind of stage, such as bundle_adjustment; all if not given.")
    ] = None,
    dot: Annotated[Path | None, typer.Option(help="Write the graph of --stage in Graphviz's language.")] = None,
    g2o: Annotated[Path | None, typer.Option(help="Write the poses of --stage as g2o.")] = None,
    worst: Annotated[int, typer.Option(help="Largest residuals to list.", min=0)] = 5,
    json: options.Json = False,
) -> None:
    """Show the factor graphs that a run solved: variables, factors, energies, the largest residuals."""
    from uni4d_fg.errors import ConfigError
    from uni4d_fg.results.graph_summary import stage_graphs, summarize_graph, write_dot, write_g2o
    from uni4d_fg.results.shot_list import refuse_split

    refuse_split(run)
    graphs = stage_graphs(run)
    if stage is not None and stage not in graphs:
        raise ConfigError(f"--stage {stage}: the run has {', '.join(graphs)}")
    if (dot is not None or g2o is not None) and stage is None:
        raise ConfigError(f"--dot and --g2o write one graph: choose it with --stage ({', '.join(graphs)})")
    chosen = graphs if stage is None else {stage: graphs[stage]}
    if dot is not None:
        write_dot(chosen[str(stage)], dot)
    if g2o is not None:
        write_g2o(chosen[str(stage)], g2o)
    summaries = [summarize_graph(found, worst) for found in chosen.values()]
    if json:
        print_json([summary.to_dict() for summary in summaries])
        return
    for summary in summaries:
        typer.echo(f"{summary.kind}: {summary.degrees_of_freedom} degrees of freedom")
        for name, (count, free) in summary.variables.items():
            typer.echo(f"    {name:22s} {count:8d} variables, {free} entries free")
        for name, term in summary.terms.items():
            typer.echo(
                f"    {name:22s} {term.factors:8d} factors, energy {term.initial_energy:.6g} -> {term.final_energy:.6g}"
            )
        for name, missing in summary.left_out.items():
            typer.echo(f"    {name:22s} {missing:8d} factors not stored: they exist as Python functions alone")
        for name, residual, variables in summary.worst:
            typer.echo(f"    {residual:8.2f} sigma  {name} on {variables}")
