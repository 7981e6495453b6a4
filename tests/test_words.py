"""Plain words: terms of the field in names, messages and pages, not a dialect of our own."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("semantic_mapper", "drivers", "replay", "nodes")
# Say instead: reported, requested, fix, odometry sessions, pose in map, virtual view, continue, resume, timeout,
# pruned, uncertainty, method, next to, upsample, again, is missing, another process, registered, missing frames.
DIALECT = re.compile(
    r"(?<![a-z])(told|asked|mend(s|ed|ing)?|worlds|whereabouts|look(s|ed|ing)? around|carr(y|ies|ied) on|"
    r"take(s|n)? up|took up|overstay(s|ed)?|faint(er|est)?|doubt(s|ed|ful)?|arms?|beside|shots?|placed|gaps|"
    r"lift(s|ed|ing)?|anew|(?-i:is none|are none)|a stranger)(?![a-z])",
    re.IGNORECASE,
)
THIRD_PARTY = {  # words of others, by file
    "replay/importers/models.py": {"Shot", "shot", "shots"},  # keys of OpenSfM's files
    "docs/layouts.md": {"shots"},
    "replay/sfm/colmap.py": {"ARM"},  # processors
}


def words_of(name: str) -> str:
    """An identifier as words: ``SomeName`` and ``some_name`` are "some name"."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_", " ", name)


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Lines of a page; or names that a module defines, and its strings; each with its line."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        yield from enumerate(text.splitlines(), 1)
        return
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.AsyncFunctionDef(name=name):
                yield node.lineno, words_of(name)
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield node.lineno, words_of(name)
            case ast.Constant(value=str(string)):
                yield node.lineno, string
            case _:
                pass


def test_names_messages_and_pages_are_in_plain_words() -> None:
    modules = (path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py")))
    found: list[str] = []
    for path in (*modules, *ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))):
        name = path.relative_to(ROOT).as_posix()
        hits = [(line, hit.group()) for line, text in texts(path) for hit in DIALECT.finditer(text)]
        found += [f"{name}:{line}: {word}" for line, word in hits if word not in THIRD_PARTY.get(name, ())]
    assert not found, "\n".join(found)
