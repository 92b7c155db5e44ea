"""The wings of the package and what each may import.

A wing imports only wings above it in ``WINGS`` and the root modules. Within a wing, and within every package in it, the
packages side by side do not import each other in a circle, not even in a function or for a type checker. Modules side
by side may name each other in such places, but do not load each other in a circle.
"""

from __future__ import annotations

import ast
from collections import Counter, defaultdict
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE = CHECKOUT / "uni4d_fg"
ROOT_MODULES = {"allocation", "arrays", "counted", "errors", "files", "optional", "progress", "reading", "robust"}
FRONT_DOORS = {"", "__main__"}
"""What a user imports, or starts, may come from anywhere."""
WINGS = ("geometry", "config", "factors", "optim", "frontend", "slam", "cues", "results", "pipeline", "cli")
MAX_LINES = 500


def module_name(path: Path) -> str:
    parts = path.relative_to(CHECKOUT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def inside(tree: ast.Module) -> set[ast.AST]:
    """What is not run when a module is loaded: bodies of functions, and of ``if TYPE_CHECKING``."""
    late: set[ast.AST] = set()
    for node in ast.walk(tree):
        checked = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if checked or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            late |= {below for statement in node.body for below in ast.walk(statement)}
    return late


def imports(module: str) -> dict[str, bool]:
    """The modules of the package that a module names in imports, and whether it loads them when it is loaded."""
    tree = ast.parse(FILES[module].read_text(encoding="utf-8"))
    late = inside(tree)
    found: dict[str, bool] = {}
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            full = {f"{node.module}.{alias.name}" for alias in node.names}
            names = [name if name in FILES else str(node.module) for name in full]
        for name in names:
            if name.split(".")[0] == "uni4d_fg":
                found[name] = found.get(name, False) or node not in late
    return found


IMPORTS = {module: imports(module) for module in FILES}


def wing(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_every_wing_is_known() -> None:
    found = {wing(module) for module in FILES} - FRONT_DOORS
    assert found == ROOT_MODULES | set(WINGS)
    assert all(f"uni4d_fg.{name}" in FILES and (PACKAGE / name).is_dir() for name in WINGS)


def test_wings_import_only_what_is_above_them() -> None:
    wrong = []
    for module, names in IMPORTS.items():
        here = wing(module)
        if here in FRONT_DOORS:
            continue
        allowed = ROOT_MODULES if here in ROOT_MODULES else ROOT_MODULES | set(WINGS[: WINGS.index(here) + 1])
        wrong += [f"{module} imports {name}" for name in names if wing(name) not in allowed]
    assert sorted(wrong) == []


PACKAGES = sorted(module for module, path in FILES.items() if path.name == "__init__.py")


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_has_no_circles(package: str) -> None:
    depth = package.count(".") + 1
    graph: dict[str, set[str]] = defaultdict(set)

    def child(module: str) -> str | None:
        if module == package:
            return "__init__"
        return module.split(".")[depth] if module.startswith(package + ".") else None

    packages = {child(module) for module in PACKAGES}
    for module, names in IMPORTS.items():
        here = child(module)
        for name, at_load in names.items():
            there = child(name)
            counts = at_load or here in packages or there in packages
            if counts and here is not None and there is not None and here != there:
                graph[here].add(there)
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(f"{package}: {' <- '.join(error.args[1])}")


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_says_what_lives_there(package: str) -> None:
    assert ast.get_docstring(ast.parse(FILES[package].read_text(encoding="utf-8")))


def test_no_file_is_long() -> None:
    folders = [CHECKOUT / name for name in ("uni4d_fg", "tests", "benchmarks", "examples", "cpp_factors")]
    sources = (path for folder in folders for kind in ("*.py", "*.hpp", "*.cpp") for path in folder.rglob(kind))
    lengths = {str(path): len(path.read_text(encoding="utf-8").splitlines()) for path in sources}
    assert {path: length for path, length in lengths.items() if length > MAX_LINES} == {}


def bound(statement: ast.stmt) -> list[str]:
    """The names that a statement of a module assigns, or defines."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [statement.name]
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
    return [node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]


def test_no_name_of_a_module_is_bound_twice() -> None:
    """A second constant of the same name would silently replace the first one where both are read."""
    twice = []
    for module, path in FILES.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        count = Counter(name for statement in tree.body for name in bound(statement))
        twice += [f"{module}.{name}" for name, times in count.items() if times > 1]
    assert twice == []


def test_names_of_test_modules_are_unique() -> None:
    seen: dict[str, list[str]] = defaultdict(list)
    for path in (CHECKOUT / "tests").rglob("*.py"):
        if path.name != "conftest.py":
            seen[path.name].append(str(path.relative_to(CHECKOUT)))
    assert {name: paths for name, paths in seen.items() if len(paths) > 1} == {}


READERS = {
    "reading", "files", "frontend.sequence.containers", "frontend.sequence.decode", "frontend.sequence.display",
    "results.clouds", "results.export.frames", "cues.session", "cli.comparison", "cli.docs", "config.docs",
    "factors.tables", "pipeline.compare.machine", "pipeline.compare.memory", "pipeline.workers.memory",
    "results.view.page",
}  # fmt: skip
"""Modules that open files themselves: after a look at them, or files of the package, of the system or their own."""


def reads_a_file(call: ast.Call) -> bool:
    """Tell whether a call opens a file for reading without :mod:`uni4d_fg.reading`."""
    words = [arg.value for arg in call.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)]
    if isinstance(call.func, ast.Name):  # read_text and read_bytes are those of uni4d_fg.reading then
        return call.func.id == "open" and not any(set(word) & set("wax+") for word in words)
    if not isinstance(call.func, ast.Attribute):
        return False
    if call.func.attr == "open":
        named = {keyword.arg for keyword in call.keywords}
        return bool(named & {"encoding", "newline"} or set(words) & {"r", "rb"}) and not set(words) & {"w", "wb", "a"}
    return call.func.attr in ("read_text", "read_bytes", "loadtxt", "genfromtxt", "fromfile")


def test_files_of_others_are_read_by_way_of_one_module() -> None:
    """A pipe or a device in place of a file would hang what opens it without a look."""
    found = {
        module.removeprefix("uni4d_fg.")
        for module, path in FILES.items()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and reads_a_file(node)
    }
    assert found == READERS
