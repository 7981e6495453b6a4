"""The end of a mapping session, however it came."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from semantic_mapper.nodes.cli.report import write_replay_report
from semantic_mapper.replay.session import MapSession


def finish_session(
    session: MapSession,
    out: Path,
    stopped_by: str,
    restarted: str = "",
    progress: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Write map, summary, pictures and report; the summary says what ended the session early (null = it came to its
    end).

    Args:
        session: To be finished; it counts what came since this process began.
        out: Folder for the results.
        stopped_by: What ended it early; empty = nothing.
        restarted: What became of the map of a process before this one; empty = there was none.
        progress: Called after each step.

    Raises:
        MapError: the map cannot be written.
        ConfigError: the report cannot be written.
    """
    more = {"stopped_by": stopped_by or None, "restarted": restarted or None}
    summary = session.finish(out, more, progress)
    write_replay_report(session, summary, out)
    progress()
    return summary
