"""What an examination of ``doctor`` finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from semantic_mapper.errors import SemanticMapperError


@dataclass(frozen=True, slots=True)
class Check:
    """One finding: ``note`` = works, but worth knowing; ``bad`` = something will fail, ``fix`` says what to do."""

    name: str
    state: Literal["ok", "note", "bad"]
    found: str
    fix: str = ""


def failed(name: str, error: SemanticMapperError) -> Check:
    """Errors say what is wrong; and after a semicolon, how to fix it."""
    found, _, fix = str(error).partition("; ")
    return Check(name, "bad", found, fix)
