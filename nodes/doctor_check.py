"""What an examination of ``doctor`` finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Check:
    """One finding: ``note`` = works, but worth knowing; ``bad`` = something will fail, ``mend`` says what to do."""

    name: str
    state: Literal["ok", "note", "bad"]
    found: str
    mend: str = ""
