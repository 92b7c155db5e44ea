"""The page about the public names, generated from their docstrings, signatures and fields.

What is shown is read from the source and not from the objects, so that it does not depend on the version of Python,
and so that the sentences below the fields of a class are found.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

_HEAD = """# API

What `import uni4d_fg` gives, generated from the docstrings by `python -m uni4d_fg.cli.docs`. These names are kept; what
is not here may change. `examples/` uses them in whole programs.

"""
_SECTION = re.compile(r"^(Args|Returns|Raises|Yields):$")
_ENTRY = re.compile(r"^(\**[\w]+): (.*)$")
_ROLE = re.compile(r":\w+:`~?([^`]+)`")


def api_page() -> str:
    """Return the page as Markdown."""
    package = import_module("uni4d_fg")  # its front door, which no module inside depends on
    names = sorted(package.__all__, key=str.lower)
    parts = [_HEAD + " · ".join(f"[`{name}`](#{name.lower()})" for name in names) + "\n"]
    parts += [_entry(name, getattr(package, name)) for name in names]
    return "\n".join(parts)


def _entry(name: str, value: Any) -> str:
    if isinstance(value, ModuleType):
        return f"## {name}\n\n`{value.__name__}`\n\n{_markdown(inspect.getdoc(value) or '')}"
    module = inspect.getmodule(value)
    assert module is not None
    node = next(
        node
        for node in ast.parse(inspect.getsource(module)).body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == value.__name__
    )
    if isinstance(node, ast.FunctionDef):
        return f"## {name}\n\n{_signature(node)}\n{_markdown(ast.get_docstring(node) or '')}"
    return f"## {name}\n\n{_class(node)}"


def _class(node: ast.ClassDef) -> str:
    """Return what a class is, its fields and its public methods."""
    parts = [_markdown(ast.get_docstring(node) or "")]
    fields = list(_fields(node))
    if fields:
        parts.append("Fields:\n\n" + "\n".join(fields) + "\n")
    for method in node.body:
        if isinstance(method, ast.FunctionDef) and method.name == "__init__":
            parts.insert(0, _signature(method, node.name))
    for method in node.body:
        if isinstance(method, ast.FunctionDef) and (not method.name.startswith("_") or method.name == "__call__"):
            title = f"### {node.name}.{method.name}"
            text = _markdown(ast.get_docstring(method) or "")
            if _is_property(method):
                text = f"`{ast.unparse(method.returns)}`\n\n{text}" if method.returns else text
                parts.append(f"{title}\n\n{text}")
            else:
                parts.append(f"{title}\n\n{_signature(method)}\n{text}")
    return "\n".join(parts)


def _fields(node: ast.ClassDef) -> Iterator[str]:
    """Yield a line per public field: its name, type, default and the sentence below it."""
    following = [*node.body[1:], None]
    for item, after in zip(node.body, following, strict=True):
        if not isinstance(item, ast.AnnAssign) or not isinstance(item.target, ast.Name):
            continue
        if item.target.id.startswith("_"):
            continue
        text = ""
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
            text = " " + " ".join(_inline(inspect.cleandoc(after.value.value)).split())
        default = _default(item.value)
        yield f"- `{item.target.id}: {ast.unparse(item.annotation)}{default}`{text}"


def _default(value: ast.expr | None) -> str:
    """Return a default as it is written; an empty container for a factory, nothing for what is long."""
    if value is None:
        return ""
    if isinstance(value, ast.Call) and ast.unparse(value.func) == "field":
        given = {keyword.arg: ast.unparse(keyword.value) for keyword in value.keywords}
        text = f"{given['default_factory']}()" if "default_factory" in given else given.get("default", "")
    else:
        text = ast.unparse(value)
    return f" = {text}" if text and len(text) < 40 else ""


def _signature(node: ast.FunctionDef, name: str = "") -> str:
    """Return the call as a block of code; one argument per line where it is long."""
    arguments = _arguments(node.args)
    returns = "" if node.returns is None or name else f" -> {ast.unparse(node.returns)}"
    line = f"{name or node.name}({', '.join(arguments)}){returns}"
    if len(line) > 110:
        inner = "".join(f"    {argument},\n" for argument in arguments)
        line = f"{name or node.name}(\n{inner}){returns}"
    return f"```python\n{line}\n```\n"


def _arguments(args: ast.arguments) -> list[str]:
    plain = [*args.posonlyargs, *args.args]
    defaults: list[ast.expr | None] = [None] * (len(plain) - len(args.defaults)) + list(args.defaults)
    out = [_argument(argument, default) for argument, default in zip(plain, defaults, strict=True)]
    if plain and plain[0].arg in ("self", "cls"):
        out = out[1:]
    if args.vararg is not None:
        out.append("*" + _argument(args.vararg, None))
    elif args.kwonlyargs:
        out.append("*")
    out += [_argument(argument, default) for argument, default in zip(args.kwonlyargs, args.kw_defaults, strict=True)]
    if args.kwarg is not None:
        out.append("**" + _argument(args.kwarg, None))
    return out


def _argument(argument: ast.arg, default: ast.expr | None) -> str:
    text = argument.arg if argument.annotation is None else f"{argument.arg}: {ast.unparse(argument.annotation)}"
    return text if default is None else f"{text} = {ast.unparse(default)}"


def _is_property(node: ast.FunctionDef) -> bool:
    return any(ast.unparse(decorator) in ("property", "cached_property") for decorator in node.decorator_list)


def _markdown(text: str) -> str:
    """Return a docstring in Google style as Markdown: its sections become lists."""
    out: list[str] = []
    in_section = False
    for line in text.splitlines():
        if _SECTION.match(line):
            out += [f"{line}", ""]
            in_section = True
        elif in_section and line.startswith("    ") and not line.startswith("     "):
            entry = _ENTRY.match(line.strip())
            bullet = f"`{entry[1]}`: {_inline(entry[2])}" if entry else _inline(line.strip())
            continues = entry is None and bool(out) and bool(out[-1])
            out.append(f"  {bullet}" if continues else f"- {bullet}")
        elif in_section and line.strip():
            out.append(f"  {_inline(line.strip())}")
        else:
            out.append(_inline(line))
    return "\n".join(out) + "\n"


def _inline(text: str) -> str:
    """Return text whose code and references are marked as Markdown has it."""
    return _ROLE.sub(r"`\1`", text).replace("``", "`").replace("\\*", "*")
