"""The figures of a long walk, minute by minute, as one picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from semantic_mapper.evaluation.plot import Curve, Panel, draw_panels
from semantic_mapper.evaluation.sheet import write_picture
from semantic_mapper.replay.bench.walk import SETTLED_MINUTE

_PANELS = (
    ("milliseconds a step", {"minute_step_p95_ms": "p95", "minute_step_p50_ms": "p50", "minute_fuse_p50_ms": "fusion"}),
    ("resident memory, MB", {"minute_rss_mb": "each minute"}),
    ("blocks", {"minute_blocks_on_disk": "on disk", "minute_blocks_in_memory": "in memory"}),
)


def write_walk_plot(found: Mapping[str, Any], path: Path) -> None:
    """Draw what ``bench_walk`` found against the minute of the walk into a PNG, whole or not at all."""
    title = f"{found['rooms']} rooms, {found['minutes']:g} minutes at {found['hz']:g} Hz, {found['size']}"
    panels = [
        Panel(name, tuple(_by_minute(line, found[key]) for key, line in lines.items()), "minute of the walk")
        for name, lines in _PANELS
    ]
    panels[1] = replace(panels[1], curves=(*panels[1].curves, *_levels(found)))
    write_picture(path, draw_panels(title, panels))


def _levels(found: Mapping[str, Any]) -> tuple[Curve, ...]:
    """Memory of the settled minute and the most after it, level to the end; nothing of a walk too short for them."""
    if found["rss_minute_5_mb"] is None:
        return ()
    ends = SETTLED_MINUTE, len(found["minute_rss_mb"]) - 1
    levels = {"minute 5": found["rss_minute_5_mb"], "most after it": found["rss_max_after_minute_5_mb"]}
    return tuple(Curve(name, tuple((float(x), float(mb)) for x in ends)) for name, mb in levels.items())


def _by_minute(name: str, values: Sequence[float]) -> Curve:
    return Curve(name, tuple((float(minute), float(value)) for minute, value in enumerate(values)))
