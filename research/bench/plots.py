"""What the long walk has found, as a picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from research.bench.walk import SETTLED_MINUTE
from research.plots import Curve, Panel, draw_panels
from semantic_mapper.types import UInt8

_WALK_PANELS = (
    (
        "time of a step",
        "ms",
        {"minute_step_p95_ms": "p95", "minute_step_p50_ms": "p50", "minute_fuse_p50_ms": "fusion"},
    ),
    ("resident memory", "MB", {"minute_rss_mb": "each minute"}),
    ("blocks of the map", "blocks", {"minute_blocks_on_disk": "on disk", "minute_blocks_in_memory": "in memory"}),
)


def draw_walk(found: Mapping[str, Any]) -> UInt8:
    """What ``bench_walk`` found against the minute of the walk, (H, W, 3) RGB."""
    title = f"{found['rooms']} rooms, {found['minutes']:g} minutes at {found['hz']:g} Hz, {found['size']}"
    curves = [[Curve(name, list(enumerate(found[key]))) for key, name in lines.items()] for _, _, lines in _WALK_PANELS]
    if found["rss_minute_5_mb"] is not None:  # else the walk was too short for these levels
        ends = SETTLED_MINUTE, len(found["minute_rss_mb"]) - 1
        levels = {"minute 5": found["rss_minute_5_mb"], "most after it": found["rss_max_after_minute_5_mb"]}
        curves[1] += [Curve(name, [(end, mb) for end in ends]) for name, mb in levels.items()]
    panels = zip(_WALK_PANELS, curves, strict=True)
    return draw_panels(title, [Panel(name, unit, "minute of the walk", lines) for (name, unit, _), lines in panels])
