"""What the declarations of settings say of them: name, type, bounds, default, and the comment there.

The options of the command line and ``docs/settings.md`` are made from it, so that each setting is described once.
"""

from __future__ import annotations

import ast
import functools
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

BOUNDLESS = 1e6  # an upper bound that only keeps out what nothing can be computed with


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Args:
        name: Dotted, as TOML and ``--set`` name it.
        type: Without its bounds.
        low, high: Bounds, both included; None = none.
        default: ``msgspec.NODEFAULT`` where it has to be given.
        text: What is said where it is declared.
    """

    name: str
    type: Any
    low: float | None
    high: float | None
    default: Any
    text: str

    @property
    def kind(self) -> str:
        """Its type, for people."""
        if get_origin(self.type) is Literal:
            return " or ".join(f'"{value}"' for value in get_args(self.type) if value != "")
        names = {bool: "true or false", int: "whole number", float: "number", str: "text"}
        if self.type in names:
            low = "" if self.low is None else f" from {self.low:g}"
            high = "" if self.high is None or self.high >= BOUNDLESS else f" to {self.high:g}"
            return names[self.type] + low + high
        return "list" if get_origin(self.type) in (tuple, list) else "table or text"


def settings_of(kind: type[msgspec.Struct], prefix: str = "") -> Iterator[Setting]:
    """The settings of a struct, and those of the structs in it."""
    texts = comments_of(kind)
    hints = get_type_hints(kind, include_extras=True)
    for item in msgspec.structs.fields(kind):
        declared, low, high = _without_bounds(hints[item.name])
        if isinstance(declared, type) and issubclass(declared, msgspec.Struct) and not item.required:
            yield from settings_of(declared, f"{prefix}{item.name}.")
            continue
        default = item.default
        if item.default_factory is not msgspec.NODEFAULT:
            default = item.default_factory()
        yield Setting(prefix + item.name, declared, low, high, default, texts.get(item.name, ""))


def _without_bounds(declared: Any) -> tuple[Any, float | None, float | None]:
    low = high = None
    while get_origin(declared) is Annotated:
        declared, *notes = get_args(declared)
        for note in notes:
            if isinstance(note, msgspec.Meta):
                low = note.ge if note.ge is not None else note.gt if low is None else low
                high = note.le if note.le is not None else note.lt if high is None else high
    if get_origin(declared) in (Union, UnionType):
        inner = [part for part in get_args(declared) if part is not type(None)]
        if len(inner) == 1:
            return _without_bounds(inner[0])
    return declared, low, high


@functools.cache
def comments_of(kind: type[msgspec.Struct]) -> dict[str, str]:
    """The comments above and behind the fields of a struct, by field; those that it inherits, too."""
    found: dict[str, str] = {}
    for part in reversed(kind.__mro__):
        if part is msgspec.Struct or not issubclass(part, msgspec.Struct):
            continue
        source = textwrap.dedent(inspect.getsource(part))
        comments = {
            token.start[0]: token.string.lstrip("#").strip()
            for token in tokenize.generate_tokens(io.StringIO(source).readline)
            if token.type == tokenize.COMMENT
        }
        lines = source.splitlines()
        (body,) = ast.parse(source).body
        assert isinstance(body, ast.ClassDef)
        for node in body.body:
            if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
                continue
            above = node.lineno - 1
            while above in comments and lines[above - 1].lstrip().startswith("#"):
                above -= 1
            numbers = range(above + 1, (node.end_lineno or node.lineno) + 1)
            if text := " ".join(comments[number] for number in numbers if number in comments):
                found[node.target.id] = text
    return found
