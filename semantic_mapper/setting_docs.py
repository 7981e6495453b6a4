"""What the declarations of settings say of them: name, type, bounds, default, and the comment there.

The options of the command line and ``docs/settings.md`` are made from it, so that each setting is described once.
"""

import ast
import functools
import inspect
import io
import textwrap
import tokenize
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

BOUNDLESS = 1e6  # an upper bound that only keeps out what nothing can be computed with


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting."""

    name: str  # dotted, as TOML and ``--set`` name it
    type: Any  # without its bounds
    # low, high: Bounds, both included; None = none.
    low: float | None
    high: float | None
    default: Any  # ``msgspec.NODEFAULT`` where it has to be given
    text: str  # what is said where it is declared

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


def settings_of(kind: type[msgspec.Struct], prefix: str = "", made: object = None) -> Iterator[Setting]:
    """The settings of a struct, and those of the structs in it; defaults are those of ``made``, if there is one."""
    texts = comments_of(kind)
    hints = get_type_hints(kind, include_extras=True)
    for item in msgspec.structs.fields(kind):
        declared, low, high = without_bounds(hints[item.name])
        default = item.default
        if item.default_factory is not msgspec.NODEFAULT:
            default = item.default_factory()
        default = getattr(made, item.name, default)
        if isinstance(declared, type) and issubclass(declared, msgspec.Struct) and not item.required:
            yield from settings_of(declared, f"{prefix}{item.name}.", default)
            continue
        yield Setting(prefix + item.name, declared, low, high, default, texts.get(item.name, ""))


def without_bounds(declared: Any) -> tuple[Any, float | None, float | None]:
    """A declared type without its bounds and ``None``, and these bounds; None = none."""
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
            declared, least, most = without_bounds(inner[0])
            return declared, low if least is None else least, high if most is None else most
    return declared, low, high


@functools.cache
def comments_of(kind: type[msgspec.Struct]) -> dict[str, str]:
    """The comments above and behind the fields of a struct, by field; those that it inherits, too."""
    found: dict[str, str] = {}
    for part in reversed(kind.__mro__):
        if part is msgspec.Struct or not issubclass(part, msgspec.Struct):
            continue
        source, declared = _parse(part)
        assert isinstance(declared, ast.ClassDef)
        for node in declared.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                found |= _comment(source, node, node.target.id)
    return found


def comments_of_parameters(function: Callable[..., Any]) -> dict[str, str]:
    """The comments above and behind the parameters of a function, by parameter."""
    source, declared = _parse(function)
    assert isinstance(declared, ast.FunctionDef)
    found: dict[str, str] = {}
    for node in (*declared.args.args, *declared.args.kwonlyargs):
        found |= _comment(source, node, node.arg)
    return found


def _parse(declared: Any) -> tuple[str, ast.stmt]:
    source = textwrap.dedent(inspect.getsource(declared))
    return source, ast.parse(source).body[0]


def _comment(source: str, node: ast.AnnAssign | ast.arg, name: str) -> dict[str, str]:
    """What the comments above and behind a declaration say, by its name."""
    comments, lines = _comments_by_line(source), source.splitlines()
    above = node.lineno - 1
    while above in comments and lines[above - 1].lstrip().startswith("#"):
        above -= 1
    numbers = range(above + 1, (node.end_lineno or node.lineno) + 1)
    text = " ".join(comments[number] for number in numbers if number in comments)
    return {name: text} if text else {}


@functools.cache
def _comments_by_line(source: str) -> dict[int, str]:
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {t.start[0]: t.string.lstrip("#").strip() for t in tokens if t.type == tokenize.COMMENT}
