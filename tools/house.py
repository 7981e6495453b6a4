"""How large the project is, against the limits that keep it readable: ``python -m tools.house``.

Counts what git tracks. The exit code is 1 where a limit is passed.
"""

from __future__ import annotations

import ast
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer.main
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup

from semantic_mapper.nodes.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ("semantic_mapper", "drivers", "nodes", "replay")
PACKAGE = "semantic_mapper"
LINKED = ("drivers", "nodes", "replay")  # at the top level, and part of the package
_PYTHON = [f"{folder}/**/*.py" for folder in SHIPPED]
LIMITS = {
    "shipped lines": 58_000,
    "shipped modules": 300,
    "lines of tests": 33_300,
    "lines of research, tests included": 34_000,
    "settings": 300,
    "commands": 24,
    "import circles": 0,
    "imports of ours inside functions": 40,
    "words of docs that ship": 20_000,
    "minutes of the last .ci/run here": 20,
    "MB of the last wheel in dist/": 38,
}


@dataclass(slots=True)
class Module:
    """What one module of the package imports of the package, and its settings."""

    name: str
    imports: set[str] = field(default_factory=set[str])
    inside_functions: int = 0
    settings: int = 0


def main() -> int:
    """Print the table; 1 where a limit is passed."""
    found = measure()
    table = Table("", "now", "limit")
    for name, limit in LIMITS.items():
        count = found.get(name)
        passed = count is not None and count > limit
        table.add_row(
            name, "not measured" if count is None else f"{count:,}", f"{limit:,}", style="red" if passed else ""
        )
    Console().print(table)
    return int(any(count > LIMITS[name] for name, count in found.items()))


def measure() -> dict[str, int]:
    """All figures by name; those of the last CI run and wheel only where there is one."""
    modules = [_module(path) for path in _tracked(*_PYTHON)]
    minutes, wheels = ROOT / "runs" / "ci-minutes", sorted((ROOT / "dist").glob("*x86_64.whl"))
    last = {"minutes of the last .ci/run here": int(minutes.read_text())} if minutes.exists() else {}
    if wheels:
        last["MB of the last wheel in dist/"] = math.ceil(wheels[-1].stat().st_size / 1e6)
    return {
        "shipped lines": _lines(*_PYTHON),
        "shipped modules": sum(path.name != "__init__.py" for path in _tracked(*_PYTHON)),
        "lines of tests": _lines("tests/**/*.py"),
        "lines of research, tests included": _lines("research/**/*.py"),
        "settings": sum(module.settings for module in modules),
        "commands": _commands(typer.main.get_command(app)),
        "import circles": len(circles({module.name: module.imports for module in modules})),
        "imports of ours inside functions": sum(module.inside_functions for module in modules),
        "words of docs that ship": sum(len(p.read_text().split()) for p in _tracked("README.md", "docs/**/*.md")),
        **last,
    }


def circles(imports: dict[str, set[str]]) -> list[set[str]]:
    """Groups of modules of which each one reaches each other one (Tarjan, 1972, by depth-first search)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[set[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in sorted(imports[name] & imports.keys()):
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            group = set(stack[stack.index(name) :])
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(group)

    sys.setrecursionlimit(10_000)
    for name in sorted(imports):
        if name not in index:
            visit(name)
    return found


def _tracked(*patterns: str) -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--", *(f":(glob){pattern}" for pattern in patterns)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return [ROOT / name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def _lines(*patterns: str) -> int:
    return sum(path.read_text(encoding="utf-8").count("\n") for path in _tracked(*patterns))


def _module(path: Path) -> Module:
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[:-1] if parts[-1] == "__init__" else parts
    module = Module(".".join((PACKAGE, *parts) if parts[0] in LINKED else parts))
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node, in_function in _imports(tree, in_function=False):
        names = [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{name}" for name in names)]
        ours = {name for name in names if name.split(".")[0] == PACKAGE}
        module.imports |= ours - {module.name}
        module.inside_functions += in_function and bool(ours)
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and any(getattr(base, "id", "").endswith("Config") for base in node.bases):
            module.settings += sum(
                isinstance(line, ast.AnnAssign) and "ClassVar" not in ast.unparse(line.annotation) for line in node.body
            )
    return module


def _imports(tree: ast.AST, *, in_function: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Each import that runs, and whether it does so within a function."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, in_function
        elif not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            inside = in_function or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from _imports(node, in_function=inside)


def _commands(command: object) -> int:
    if not isinstance(command, TyperGroup):
        return 1
    context: Any = None
    names = command.list_commands(context)
    return sum(_commands(command.get_command(context, name)) for name in names)


if __name__ == "__main__":
    sys.exit(main())
