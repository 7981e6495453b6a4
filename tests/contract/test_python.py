"""Names that the README, the how-tos and the examples import, and how they are called."""

import ast
import importlib
import inspect
import re
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from tests.contract import entry_points as api
from tests.contract.golden import read

_BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)
OWN = ("semantic_mapper", "replay", "nodes", "drivers")
# Not in a code block, but named in the text of the how-tos and CONTRIBUTING.
NAMED = (
    ("semantic_mapper.fields.learned", "build_field"),
    ("semantic_mapper.labels", "ROOMS"),
    ("semantic_mapper.testing", "LogReplays"),
    ("semantic_mapper.testing", "ReplayedMap"),
    ("semantic_mapper.types", "PosedFrame"),
    ("semantic_mapper.types", "CameraIntrinsics"),
    ("semantic_mapper.mapping.pipeline", "MappingPipeline"),
    ("semantic_mapper.errors", "SemanticMapperError"),
)


def imported() -> set[tuple[str, str]]:
    """Module and name of each import of ours in what users read."""
    found: set[tuple[str, str]] = set()
    for path in sorted((api.REPOSITORY / "examples").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OWN:
                found |= {(str(node.module), alias.name) for alias in node.names}
    for path in (api.REPOSITORY / "README.md", *sorted((api.REPOSITORY / "docs").glob("*.md"))):
        for block in _BLOCK.findall(path.read_text(encoding="utf-8")):  # some leave things out, and are no Python
            for module, names in re.findall(r"^from (\S+) import (.+)$", block, re.MULTILINE):
                if module.split(".")[0] in OWN:
                    found |= {(module, name.strip()) for name in names.split(",")}
    return found


def importable(module: str, name: str) -> Any:
    """What ``from module import name`` gives; the name may have dots."""
    return attrgetter(name)(importlib.import_module(module))


def observe(_: Path) -> dict[str, Any]:
    """Each name with what can be called: itself, and of a class the public methods and attributes."""
    return {f"{module}:{name}": calls(importable(module, name)) for module, name in sorted(imported() | set(NAMED))}


def calls(value: Any) -> dict[str, list[list[str]]]:
    """Arguments by callable, as [name, "given" or "may be left out"]; attributes have none."""
    found = {"": _arguments(value)} if callable(value) else {"": []}
    if inspect.isclass(value):
        public = [name for name in dir(value) if not name.startswith("_")]
        found |= {name: _arguments(getattr(value, name)) for name in public}
        found |= {name: [] for name in getattr(value, "__annotations__", {}) if not name.startswith("_")}
    return found


def _arguments(value: Any) -> list[list[str]]:
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return []
    named = [p for p in parameters if p.name[0] != "_" and p.kind is not p.POSITIONAL_ONLY]  # 3.13 tells of such
    return [[p.name, "given" if p.default is p.empty else "left out"] for p in named]


_GOLDEN: dict[str, dict[str, list[list[str]]]] = read("python")


@pytest.mark.parametrize("name", _GOLDEN)
def test_a_name_can_be_imported_and_called_as_then(name: str) -> None:
    now = calls(importable(*name.split(":")))
    for call, arguments in _GOLDEN[name].items():
        assert call in now, f"{name} has no {call} any more"
        has = dict(map(tuple, now[call]))  # type: ignore[arg-type]
        takes_any = "kwargs" in has
        assert [n for n, _ in arguments if n not in has and not takes_any] == [], f"{name}.{call} took these"
        demanded = {n for n, how in now[call] if how == "given" and n not in ("args", "kwargs")}
        assert demanded <= {n for n, how in arguments if how == "given"}, f"{name}.{call} could do without"
        order = [n for n, _ in now[call] if n in dict(map(tuple, arguments))]  # type: ignore[arg-type]
        assert takes_any or order == [n for n, _ in arguments], f"{name}.{call}: another order"


def test_what_documents_import_now_is_there() -> None:
    assert len(imported()) > 15
    for module, name in sorted(imported()):
        importable(module, name)


def test_the_readme_maps_a_log(tmp_path: Path) -> None:
    """The first code block of the README, on the golden log."""
    from tests.contract.golden import LOG, REFUSED_SEQ, WEIGHTS

    text = next(block for block in _BLOCK.findall((api.REPOSITORY / "README.md").read_text()) if "Mapper.load" in block)
    text = text.replace('"kitchen.safetensors"', repr(str(WEIGHTS)))
    text = text.replace('"runs/kitchen/kitchen.mcap"', repr(str(LOG)))
    text = text.replace("for frame in log:", f"for frame in (f for f in log if f.seq < {REFUSED_SEQ - 3}):")
    known: dict[str, Any] = {}
    exec(compile(text, "README.md", "exec"), known)
    assert len(known["points"].xyz) > 1000 and known["update"].label.shape == (72, 96)
