"""One small finished run per session, made from the truth of a synthetic scene, and its exports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from export_samples import write_run

from uni4d_fg.cli.runs import stored_input
from uni4d_fg.results.export import ExportOptions, ExportReport, export_run
from uni4d_fg.results.run import Run


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("open3d")
    folder = tmp_path_factory.mktemp("export")
    write_run(folder / "room", folder / "run")
    return folder / "run"


@pytest.fixture(scope="session")
def source(finished_run: Path) -> Run:
    return Run(finished_run, lambda: stored_input(finished_run).read())


@pytest.fixture
def exported(source: Run, tmp_path: Path) -> Callable[..., tuple[Path, ExportReport]]:
    """Export the run in one format; returns its folder and the report."""

    def run(name: str, **options: object) -> tuple[Path, ExportReport]:
        (report,) = export_run(source, [name], tmp_path / "out", ExportOptions(**options))  # type: ignore[arg-type]
        assert report.folder == tmp_path / "out" / name
        return report.folder, report

    return run
