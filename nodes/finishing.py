"""The end of a mapping session, however it came."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from replay.artifacts import write_json
from replay.session import MapSession


def finish_session(session: MapSession, out: Path, stopped_by: str) -> dict[str, Any]:
    """Write the artefacts; the summary says what ended the session early (null = it came to its end).

    Raises:
        MapError: the map cannot be written.
    """
    summary = {**session.finish(out), "stopped_by": stopped_by or None}
    write_json(out / "summary.json", summary)
    return summary
